"""The board of the scoreboard: replay of recorded drives, its table, and small real runs."""

import json
import sys
from unittest.mock import patch

import numpy as np
import pytest

from benchmarks.scoreboard import __main__ as program
from benchmarks.scoreboard.board import WORLDS, board_cases, board_rows, board_table, cases_of
from benchmarks.scoreboard.cases import BuildingCase, DriveCase, LogCase, LoopCase
from benchmarks.scoreboard.measure import LASERS, record_drive
from benchmarks.scoreboard.recordings import RecordedSimulation, read_recording
from benchmarks.worlds import floor
from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.exploration_run import explore
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import Simulation

# Turns, a collision with a wall, and a return.
COMMANDS = [(0.3, 0.4)] * 60 + [(0.8, 0.0)] * 200 + [(0.0, -1.0)] * 40 + [(-0.3, 0.1)] * 60


@pytest.fixture(scope='module')
def lab(tmp_path_factory):
    """World, start, and the first 25 s of an exploration in a file."""
    folder = tmp_path_factory.mktemp('lab')
    numbers = record_drive('lab', folder, folder / 'lab.npz', 25.0)
    there = floor('lab', folder)
    return there.world, there.starts[0], folder / 'lab.npz', numbers


def driven(simulation):
    """Scan, odometry and true pose at all steps of the commands with a scan."""
    moments = [simulation.read_sensors()]
    poses = [simulation.robot.T_world_base]
    for command in COMMANDS:
        moments.append(simulation.step(*command))
        poses.append(simulation.robot.T_world_base)
    return [
        (scan, m.T_odom_base, T) for m, T in zip(moments, poses, strict=True) for scan in m.scans
    ]


@pytest.mark.parametrize('robot', ['2dx', '3at'])
@pytest.mark.parametrize('seed', [0, 5])
def test_a_replay_has_the_odometry_of_a_live_simulation_with_its_seed(lab, robot, seed):
    world, start, _, _ = lab
    recorded = RecordedSimulation(world, start, PRESETS[robot], LASERS['lms200'], 0)
    scans = [scan for scan, _, _ in driven(recorded)]
    assert recorded.robot.collisions > 0
    live = driven(Simulation(world, start, PRESETS[robot], LASERS['lms200'], seed))
    replayed = list(recorded.recording().replay(PRESETS[robot], seed))
    assert len(live) == len(replayed) > 80
    for sample, scan, (_, T_odom_base, T_world_base) in zip(replayed, scans, live, strict=True):
        np.testing.assert_array_equal(sample.T_odom_base, T_odom_base)
        np.testing.assert_array_equal(sample.T_world_base, T_world_base)
        np.testing.assert_array_equal(sample.scan.ranges_m, scan.ranges_m)
        assert sample.scan.stamp_ns == scan.stamp_ns
        assert sample.scan.angle_increment_rad == scan.angle_increment_rad


def test_a_recording_is_the_exploration_by_the_true_pose(lab):
    world, start, path, numbers = lab
    samples = list(read_recording(path).replay(PRESETS['2dx'], 0))
    assert numbers['scans'] == len(samples)
    robot, _ = explore(world, start, Options(speed_m_s=0.5, time_limit_s=25.0))
    truth = [sample.T_world_base for sample in samples]
    np.testing.assert_array_equal(truth[: len(robot.log.true_poses)], robot.log.true_poses)
    assert numbers['distance_m'] > 3.0


def test_a_damaged_or_missing_recording_is_named(lab, tmp_path):
    _, _, path, _ = lab
    damaged = tmp_path / 'lab.npz'
    damaged.write_bytes(path.read_bytes()[:1000])
    for file in (damaged, tmp_path / 'nowhere.npz'):
        with pytest.raises(InputError, match=str(file)):
            read_recording(file)
    np.savez(tmp_path / 'other.npz', stamps_ns=np.zeros(3))
    with pytest.raises(InputError, match='expected a recorded drive'):
        read_recording(tmp_path / 'other.npz')


def test_all_that_is_asked_is_measured(shared_data):
    cases = board_cases(shared_data / 'logs')
    names = [case.name for case in cases]
    assert len(set(names)) == len(names)
    kinds = [sum(isinstance(case, kind) for case in cases) for kind in (DriveCase, BuildingCase)]
    assert kinds == [4 * len(WORLDS), 60]
    loops = [case for case in cases if isinstance(case, LoopCase)]
    assert sum(case.laser == 'lms200' for case in loops) == 2 * len(WORLDS)
    assert sum(case.laser != 'lms200' for case in loops) == 6
    for case in cases:
        if isinstance(case, DriveCase | LoopCase):
            floor(case.world, shared_data / 'worlds')
    covered = set()
    for row in board_rows():
        own = cases_of(row, names)
        assert own, row.title
        if row.patterns != ('*',):
            covered |= set(own)
    assert covered == set(range(len(names)))
    fhw = next(row for row in board_rows() if row.title.startswith('fhw, '))
    runs = [f'fhw.run_{run}' for run in range(1, 5)]
    assert [names[k] for k in cases_of(fhw, names)] == ['fhw', *runs]


def report(name, **numbers):
    common = {'step_ms': 40.0, 'ms_mean': 1.0, 'inside_95': 0.9, 'wrong_and_sure': 0}
    return {'name': name, 'options': {}, 'final_m': 0.05, **common, **numbers}


def verdicts(reports, names=None, others=None):
    """Cells of each row by its title, without the title."""
    text = board_table(reports, names or [each['name'] for each in reports], others)
    rows = [line.strip('| ').split(' | ') for line in text.splitlines()[2:]]
    return {row[0]: row[1:] for row in rows}


def test_a_row_is_met_or_missed():
    live = {'drive_kth_a.odometry_1': 0.02, 'drive_kth_a.odometry_2': 0.0804, 'drive_b': 0.15}
    reports = [report(name, live_m=metres) for name, metres in live.items()]
    title = 'recorded drives, live, m: median / worst'
    found = verdicts(reports)
    assert found[title] == ['0.08 / 0.15', '0.080 / 0.150 (drive_b)', 'met']
    assert found['kth drives, CPU ms a scan: mean'] == ['1.2', '1.00', 'met']
    assert found['longest step of localizer and grid, corrections included, CPU ms'][-1] == 'met'
    assert not any(title.startswith(('intel', 'closed', 'buildings')) for title in found)
    reports[2] |= {'live_m': 0.151, 'wrong_and_sure': 3, 'inside_95': 0.84, 'step_ms': 61.0}
    found = verdicts(reports)
    assert found[title][1:] == ['0.080 / 0.151 (drive_b)', '**missed**']
    sure = found['simulated: overconfident scans: sum']
    assert sure == ['0', '3 (most: drive_b)', '**missed**']
    inside = found['simulated: share in the 95 % ellipse: least / median']
    assert inside == ['85%', '84.0% (drive_b) / 90.0%', '**missed**']
    longest = found['longest step of localizer and grid, corrections included, CPU ms']
    assert longest == ['60', '61 (drive_b)', '**missed**']


def test_a_row_says_what_failed_and_what_was_not_run():
    title = 'recorded drives, live, m: median / worst'
    names = ['drive_a', 'drive_b', 'drive_c']
    reports = [report('drive_a', live_m=0.02), {'name': 'drive_b', 'error': 'no scan'}]
    cells = verdicts(reports, names, [report('drive_a', live_m=0.5), None])[title]
    here = '0.020 / 0.020 (drive_a) [1 failed, 2 of 3 cases]'
    assert cells[1:] == [here, '**missed**', '0.500 / 0.500 (drive_a) [1 of 2 cases]']
    cells = verdicts(reports[1:], names)[title]
    assert cells[1:] == ['[1 failed, 1 of 3 cases]', '**missed**']


def test_a_result_of_an_earlier_version_is_refused():
    old = report('drive_a', live_m=0.02)
    del old['step_ms']
    with pytest.raises(InputError, match='drive_a: no step_ms in its result'):
        verdicts([old])


def test_loops_logs_and_buildings_are_judged():
    loops = [
        report('loop_a.lms200_1', live_m=0.1, coverage=0.99, collisions=0),
        report('loop_a.lms200_3', live_m=0.2, coverage=0.97, collisions=2),
        report('loop_b.lms200_1', live_m=0.1, collisions=0),
        report('loop_a.turtlebot3_1', live_m=0.3, coverage=0.5, collisions=7),
    ]
    found = verdicts(loops)
    assert found['closed loop, pose error, m: worst'][1] == '0.200 (loop_a.lms200_3)'
    coverage = found['closed loop, coverage of all but the largest floor: least']
    assert coverage[1:] == ['97.0% (loop_a.lms200_3)', '**missed**']
    assert found['closed loop, collisions: sum'][1] == '2 (most: loop_a.lms200_3)'
    other = found['closed loop, other lasers, pose error, m: worst']
    assert other[1] == '0.300 (loop_a.turtlebot3_1)'
    logs = [report('fhw', live_m=0.05), report('fhw.run_1', live_m=0.06)]
    logs += [report('fhw.half_blind', live_m=0.08), report('intel_raw', live_m=0.02, ms_99=9.0)]
    found = verdicts(logs)
    assert found['fhw, live, m: mean / worst of 5 runs'][1:] == ['0.055 / 0.060', '**missed**']
    assert found['fhw.half_blind, live, m'] == ['0.08', '0.080', 'met']
    assert found['intel_raw, live, m'] == ['0.022', '0.020', 'met']
    assert found['intel_raw, CPU ms a scan: 99 %'] == ['8', '9.00', '**missed**']
    many = [report(f'building_{k}', live_aligned_m=0.01 * k) for k in range(20)]
    row = verdicts(many)['buildings, live after alignment, m: median / worst tenth']
    assert row == ['0.1 / 0.4', '0.095 / 0.185 (worst: building_19)', 'met']


def called(*words):
    """Run the program in this process; returns the exit code."""
    with patch.object(sys, 'argv', ['scoreboard', '--board', *map(str, words)]):
        try:
            program.main()
        except SystemExit as end:
            return end.code
    return 0


@pytest.fixture
def small_board(monkeypatch, tmp_path):
    """A board of one small world; the folder for its results."""
    drives = [DriveCase('room_10x10', run) for run in (1, 2)]
    cases = [LoopCase('room_10x10', 1, 'turtlebot3'), *drives]
    monkeypatch.setattr(program, 'board_cases', lambda logs: cases)
    return tmp_path / 'out'


@pytest.mark.programs
def test_a_small_board_is_resumed(small_board, capsys):
    words = ['-o', small_board, '--jobs', 1, '--quiet']
    assert called(*words, '--only', 'drive_*_1') == 0
    assert '[1 of 2 cases]' in (small_board / 'targets.md').read_text()
    assert (small_board / 'drives' / 'room_10x10.npz').exists()
    results = small_board / 'board'
    kept = results / 'drive_room_10x10.odometry_1.json'
    first = json.loads(kept.read_text())
    assert first['scans'] > 100
    assert first['live_m'] < 0.2
    kept.write_text(json.dumps(first | {'step_ms': 98765.0}))
    capsys.readouterr()
    assert called(*words) == 0
    text = (small_board / 'targets.md').read_text()
    assert '| 98765 (drive_room_10x10.odometry_1) | **missed** |' in text
    assert capsys.readouterr().out.splitlines()[2] in text
    assert '| closed loop, other lasers' in text
    second = json.loads((results / 'drive_room_10x10.odometry_2.json').read_text())
    assert second['scans'] == first['scans']
    assert second['live_m'] != first['live_m']
    loop = json.loads((results / 'loop_room_10x10.turtlebot3_1.json').read_text())
    assert loop['coverage'] > 0.9
    assert loop['live_m'] < 0.2
    cases = (small_board / 'cases.md').read_text()
    assert '| drive_room_10x10.odometry_1 |' in cases
    assert '| loop_room_10x10.turtlebot3_1 |' in cases
    # Other options need another folder with the same recordings; two folders are compared.
    assert called(*words, '--set', 'slam=ekf_ti') == 2
    assert 'other options' in capsys.readouterr().err
    other = ['-o', small_board / 'other', '--recordings', small_board / 'drives']
    other += ['--against', small_board, '--only', '*_1', '--set', 'slam=ekf_ti']
    assert called(*other, '--jobs', 1, '--quiet') == 0
    assert not (small_board / 'other' / 'drives').exists()
    text = (small_board / 'other' / 'targets.md').read_text()
    assert '| 98765 (drive_room_10x10.odometry_1) |' in text
    assert (
        '## Comparison with another run (2 of 2 cases)'
        in (small_board / 'other/cases.md').read_text()
    )


@pytest.mark.programs
def test_what_the_board_cannot_do_is_one_line(small_board, monkeypatch, capsys):
    words = ['-o', small_board, '--jobs', 1, '--quiet']
    assert called(*words, '--only', 'drive_[ab]*') == 2
    assert 'no case has such a name' in capsys.readouterr().err
    cases = [LogCase('try'), DriveCase('kth/nowhere', 1)]
    monkeypatch.setattr(program, 'board_cases', lambda logs: cases)
    assert called(*words, '--only', 'drive*') == 2
    error = capsys.readouterr().err
    assert "world 'kth/nowhere': expected a file" in error
    assert 'Traceback' not in error
