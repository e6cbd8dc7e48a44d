"""The program explore_world."""

import json
import subprocess
from pathlib import Path

import pytest
import yaml
from support.forks import forked
from support.timeouts import PROGRAM_S

import thinmap_ros

ROOT = Path(__file__).resolve().parents[2]
ROOM = {
    'name': 'closet',
    'resolution': 0.05,
    'wall_thickness': 0.1,
    'start': [1.0, 1.0, 0.0],
    'walls': [[[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]], [[2.2, 0], [2.2, 1.6]]],
}
FIELDS = {
    'finished',
    'reason',
    'coverage',
    'distance',
    'time',
    'distance_at',
    'time_at',
    'collisions',
    'end_nodes_seen',
    'end_nodes_visited',
    'pose_rmse',
    'pose_rmse_aligned',
}


def explore(*words: str) -> 'subprocess.CompletedProcess[str]':
    module = 'thinmap_ros.tools.explore_world'
    return forked.run(module, *words, '--quiet', folder=ROOT, timeout=PROGRAM_S)


@pytest.fixture
def world(tmp_path: Path) -> Path:
    path = tmp_path / 'closet.yaml'
    path.write_text(yaml.safe_dump(ROOM))
    return path


@pytest.mark.programs
def test_a_room_is_explored_and_everything_written(world: Path, tmp_path: Path) -> None:
    out = tmp_path / 'out'
    result = explore(
        str(world), '-o', str(out), '--localization', 'slam', '--seed', '2', '--speed-m-s', '0.3'
    )
    assert result.returncode == 0, result.stderr
    assert 'finished (all end nodes resolved)' in result.stdout
    report = json.loads((out / 'report.json').read_text())
    assert report.keys() >= FIELDS
    assert report['finished'] is True
    assert report['coverage'] >= 0.99
    assert report['collisions'] == 0
    assert (
        report['time_at'].keys() == report['distance_at'].keys() == {'0.90', '0.95', '0.98', '0.99'}
    )
    assert report['pose_rmse'] < 0.1
    for name in (
        'map.pgm',
        'map.yaml',
        'topology.geojson',
        'summary.png',
        'trajectory.tum',
        'report.html',
    ):
        assert (out / name).stat().st_size > 0
    compared = thinmap_ros.evaluate(out, out / 'true_trajectory.tum')
    rmse = compared['trajectory.tum'].errors['APE, m'].rmse
    assert rmse == pytest.approx(report['pose_rmse'], abs=1e-3)


@pytest.mark.programs
def test_two_robots_explore_together_and_everything_is_written(world: Path, tmp_path: Path) -> None:
    out = tmp_path / 'out'
    result = explore(str(world), '-o', str(out), '--robots', '2', '--speed-m-s', '0.3')
    assert result.returncode == 0, result.stderr
    report = json.loads((out / 'report.json').read_text())
    assert report['finished'] is True
    # Of 12 m2, 0.1 m2 are left: less than what counts as something to be seen.
    assert report['coverage'] >= 0.985
    assert report['collisions'] == 0
    assert [robot['name'] for robot in report['robots']] == ['robot1', 'robot2']
    assert sum(robot['distance'] for robot in report['robots']) == pytest.approx(
        report['distance'], abs=0.01
    )
    for name in ('map.pgm', 'topology.geojson', 'summary.png', 'report.html'):
        assert (out / name).stat().st_size > 0
    for robot in report['robots']:
        assert (out / f'trajectory_{robot["name"]}.tum').stat().st_size > 0
        assert (out / f'true_trajectory_{robot["name"]}.tum').stat().st_size > 0


@pytest.mark.programs
def test_a_map_without_a_start_can_be_explored_from_a_given_one(tmp_path: Path) -> None:
    # The output is a map_server map, which can be used as a world.
    assert explore('room_10x10', '-o', str(tmp_path / 'one')).returncode == 0
    result = explore(
        str(tmp_path / 'one' / 'map.yaml'), '-o', str(tmp_path / 'two'), '--start=1.0,1.0,1.5'
    )
    assert result.returncode == 0, result.stderr
    assert json.loads((tmp_path / 'two' / 'report.json').read_text())['coverage'] >= 0.99


@pytest.mark.programs
@pytest.mark.parametrize(
    ('words', 'said'),
    [
        (['nowhere.yaml'], 'nowhere.yaml'),
        (['atlantis'], "world 'atlantis': expected a file, or one of dead_end, "),
        (['WORLD', '--start=1'], '--start=1: expected X,Y or X,Y,THETA'),
        (['WORLD', '--start', '-1,-1,0,0'], '--start=-1,-1,0,0: expected X,Y or X,Y,THETA'),
        (['WORLD', '--sped-m-s', '1'], '--sped-m-s (did you mean --speed-m-s?)'),
        (['WORLD', '--strategy', 'neerest'], "strategy = 'neerest': expected one of"),
        (['WORLD', '--start=1,nan,0'], '--start=1,nan,0: expected finite numbers'),
        (['WORLD', '--start=2.2,0.5,0'], 'expected a place where a robot'),
        (['WORLD', '--range-max-m', '-1'], 'range_max_m = -1.0: expected'),
        (['WORLD', '--speed-m-s', '0'], 'speed_m_s = 0.0: expected'),
        (['WORLD', '--kidnap-at-s', '5'], 'expected --localization=slam'),
        (['WORLD', '--robots', '0'], '--robots=0: expected 1 to 9'),
        (['WORLD', '--robots', '9'], 'expected room for 9 robots 0.8 m apart, found room for'),
        (['WORLD', '--robots', '2', '--strategy', 'paper'], 'the only one that shares candidates'),
        (['WORLD', '--robots', '2', '--kidnap-at-s', '5'], '--robots=2: expected no --kidnap-at-s'),
        (
            ['WORLD', '--robots', '2', '--claim-delay-s', 'nan'],
            '--claim-delay-s=nan: expected 0 to',
        ),
        (['WORLD', '--own-maps'], '--own-maps: expected --robots of 2 or more'),
        (['WORLD', '--claim-delay-s', '3'], 'expected --robots of 2 or more'),
    ],
)
def test_bad_input_is_reported_in_one_line(
    world: Path, tmp_path: Path, words: list[str], said: str
) -> None:
    result = explore(
        *[str(world) if word == 'WORLD' else word for word in words], '-o', str(tmp_path / 'out')
    )
    assert result.returncode == 2
    assert said in result.stderr
    assert result.stderr.count('\n') == 1
    assert not (tmp_path / 'out').exists()
