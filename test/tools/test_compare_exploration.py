"""Table of strategies x worlds x starts: resumable, paired, and the same on a cluster."""

import json
import subprocess
from pathlib import Path

import pytest
import yaml
from support.forks import forked
from support.timeouts import PROGRAM_S

from benchmarks.exploration.page import page
from thinmap_ros.evaluation.strategy_comparison import markdown, relative_saving
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.world import World
from thinmap_ros.tools.compare_exploration import _starts

ROOT = Path(__file__).resolve().parents[2]
WORLD = {
    'resolution': 0.05,
    'wall_thickness': 0.1,
    'start': [1.0, 1.0, 0.0],
    'walls': [[[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]], [[2.2, 0], [2.2, 1.6]]],
}


def report(strategy: str, world: str, start: int, distance: float) -> dict[str, object]:
    return {
        'strategy': strategy,
        'world': world,
        'start_number': start,
        'distance': distance,
        'time': 2.0 * distance,
        'turned_rad': 5.0,
        'coverage': 0.995,
        'finished': True,
        'collisions': 0,
        'reversals': 2,
        'cpu_s': 1.0,
        'decision_ms': {'median': 0.5, 'max': 7.0},
        'curve': [[1.0, 0.9 * distance, 0.995], [2.0, distance, 0.995]],
    }


def test_savings_are_paired_by_world_and_start() -> None:
    ours = {('a', 0): report('x', 'a', 0, 50.0), ('a', 1): report('x', 'a', 1, 90.0)}
    ours['b', 0] = report('x', 'b', 0, 1.0)
    others = {('a', 0): report('y', 'a', 0, 100.0), ('a', 1): report('y', 'a', 1, 100.0)}
    assert relative_saving(ours, others, 'distance').tolist() == pytest.approx([-0.5, -0.1])


def test_a_run_that_stopped_early_is_no_pair() -> None:
    ours = {('a', 0): report('x', 'a', 0, 50.0), ('a', 1): report('x', 'a', 1, 90.0)}
    others = {('a', 0): report('y', 'a', 0, 100.0), ('a', 1): report('y', 'a', 1, 1.0)}
    others['a', 1]['coverage'] = 0.3
    assert relative_saving(ours, others, 'distance').tolist() == pytest.approx([-0.5])


def test_the_table_has_a_row_for_each_strategy_and_says_what_ours_saves() -> None:
    reports = [report('position_probability', 'a', i, 80.0) for i in range(3)]
    reports += [report('nearest_frontier', 'a', i, 100.0) for i in range(3)]
    table = markdown(reports)
    assert '| nearest_frontier | 3 | 3 | 99.50% / 99.50% | 0 | 100.0 ± 0.0 |' in table
    assert '| 5.0 ± 0.0 | 2.0 | 0.50 | 200 |' in table
    assert '| nearest_frontier | 3 | -20.0% ± 0.0% | -20.0% ± 0.0% | +0.0% ± 0.0% | 3 |' in table


def test_the_page_has_a_section_for_each_way_of_exploring_and_names_every_fault() -> None:
    laser = {'beams': 181, 'field_of_view_deg': 180.0, 'range_max_m': 8.0}
    options = {'localization': 'truth', 'speed_m_s': 0.5, 'laser': laser}
    reports = [
        report('position_probability', f'dungeon-d{i}', 0, 80.0) | {'options': options}
        for i in range(3)
    ]
    for i in range(3):
        reports.append(
            report('nearest_frontier', f'dungeon-d{i}', 0, 60.0 + 30.0 * i) | {'options': options}
        )
    far = options | {'laser': laser | {'range_max_m': 20.0}}
    stuck = {'finished': False, 'reason': 'time limit of 20000 s', 'coverage': 0.5, 'options': far}
    reports.append(report('position_probability', 'kth-a', 1, 50.0) | stuck)
    text = page([each | {'made': 'Commit 1234567'} for each in reports])
    assert text.count('\nCommit 1234567.\n') == 2
    assert (
        '## Random worlds of 50 x 50 m (3): 181 beams over 180 degrees, 8 m, 0.5 m/s, poses known'
        in text
    )
    assert 'position_probability: 3 of 3 runs stopped by themselves' in text
    assert 'After a coverage of 99.5%, position_probability drove 10.0% of its path (mean).' in text
    assert (
        'nearest_frontier has a shorter path in 1 of 3 pairs; '
        'that of position_probability is up to 33% longer.' in text
    )
    assert '## Real floors of a university (1): 181 beams over 180 degrees, 20 m' in text
    assert '**kth-a, start 1**: time limit of 20000 s; coverage 50.00%, 0 collisions.' in text


def compare(*words: str) -> 'subprocess.CompletedProcess[str]':
    module = 'thinmap_ros.tools.compare_exploration'
    return forked.run(module, *words, '--quiet', folder=ROOT, timeout=PROGRAM_S)


@pytest.fixture
def world(tmp_path: Path) -> Path:
    path = tmp_path / 'worlds' / 'closet.yaml'
    path.parent.mkdir()
    path.write_text(yaml.safe_dump(WORLD))
    return path


@pytest.mark.programs
def test_it_runs_all_writes_all_and_resumes(world: Path, tmp_path: Path) -> None:
    out = tmp_path / 'out'
    words = [
        str(world),
        '-o',
        str(out),
        '--jobs',
        '1',
        '--strategies',
        'position_probability',
        'nearest_frontier',
    ]
    result = compare(*words)
    assert result.returncode == 0, result.stderr
    assert (out / 'coverage.png').stat().st_size > 0
    assert (out / 'table.md').read_text() in result.stdout
    files = sorted((out / 'runs').rglob('report.json'))
    assert len(files) == 2
    # Existing results are not computed again: the table is made from them.
    changed = json.loads(files[0].read_text()) | {'distance': 1234.5}
    files[0].write_text(json.dumps(changed))
    stamp = files[1].stat().st_mtime_ns
    files[1].unlink()
    again = compare(*words)
    assert '1234.5' in again.stdout
    assert files[1].stat().st_mtime_ns > stamp
    # Results of other options are not used.
    faster = compare(*words, '--speed-m-s', '0.3')
    assert faster.returncode == 2
    assert 'other options' in faster.stderr


@pytest.mark.programs
def test_a_world_without_start_is_reported_in_one_line(world: Path, tmp_path: Path) -> None:
    result = compare(str(tmp_path / 'nowhere.yaml'), '-o', str(tmp_path / 'out'))
    assert result.returncode == 2
    assert result.stderr.count('\n') == 1


@pytest.mark.programs
def test_a_cluster_gives_what_one_machine_gives(world: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip('distributed')
    words = [str(world), '--strategies', 'nearest_frontier']
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        there = compare(*words, '-o', str(tmp_path / 'there'), '--dask', cluster.scheduler_address)
    assert there.returncode == 0, there.stderr
    assert compare(*words, '-o', str(tmp_path / 'here'), '--jobs', '1').returncode == 0
    reports = [
        json.loads(next((tmp_path / name).rglob('report.json')).read_text())
        for name in ('there', 'here')
    ]
    for one in reports:
        for measured in ('wall_s', 'cpu_s', 'decision_ms'):
            del one[measured]
    assert reports[0] == reports[1]


def test_starts_are_those_of_the_world_file_or_its_only_one(world: Path) -> None:
    alone = World.from_patch(*read_world(world))
    assert [start.tolist() for start in _starts(world, alone, 3)] == [[1.0, 1.0, 0.0]]
    others = [[1.0, 1.0, 0.0], [3.0, 1.0, 1.5], [3.0, 2.0, 0.0]]
    world.write_text(yaml.safe_dump(WORLD | {'starts': others}))
    assert [start.tolist() for start in _starts(world, alone, 2)] == others[:2]
