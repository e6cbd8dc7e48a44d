"""The scoreboard: its tables, comparisons, resuming, and small real runs."""

import json
import math
import sys
from itertools import count, pairwise
from unittest.mock import patch

import numpy as np
import pytest

from benchmarks.buildings import DEVELOPMENT_SEEDS, BuildingConfig, generate_building
from benchmarks.scoreboard import __main__ as program
from benchmarks.scoreboard import drives
from benchmarks.scoreboard.cases import (
    BUILDINGS,
    DEGRADED,
    BuildingCase,
    LogCase,
    all_cases,
)
from benchmarks.scoreboard.measure import Task, _disturbed, measure
from benchmarks.scoreboard.page import against, case_tables
from benchmarks.scoreboard.played import Played, consistency
from thinmap_ros.core import se2
from thinmap_ros.core.errors import ConfigError
from thinmap_ros.evaluation.trajectory_errors import aligned_rms
from thinmap_ros.sim.robot import PRESETS

COSTS = {
    'scans': 100,
    'unmapped': 0.125,
    'ms_median': 1.0,
    'ms_mean': 2.0,
    'ms_99': 3.0,
    'stall_ms': 40.0,
    'mb': 250.0,
    'mb_more': 20.0,
    'cpu_s': 10.0,
}
DRIVES = [BuildingCase(seed, '2dx', 1.0) for seed in range(18)]
LOGS = [LogCase('hall'), LogCase('hall', 'slip')]
CASES = [*LOGS, *DRIVES]


def of_building(case, live_m):
    given = {'inside_95': 0.9, 'sigma_of_rms': 1.25, 'wrong_and_sure': 7, 'final_m': live_m}
    return {'name': case.name, 'options': {}, 'live_m': live_m, **COSTS, **given}


def of_log(case):
    return {'name': case.name, 'options': {}, **COSTS}


@pytest.fixture
def reports():
    found = [of_log(case) for case in LOGS]
    return found + [of_building(case, 0.01 * (1 + k)) for k, case in enumerate(DRIVES)]


def test_the_tables_have_each_case_with_all_its_numbers(reports):
    text = case_tables(reports)
    assert '| hall | 100 |  | 12.5% | 1.00 | 2.00 | 3.0 | 40 | 250 | 20 |' in text
    row = '0.010 | 0.010 | 12.5% | 90% | 1.2 | 7 | 1.00 | 2.00 | 3.0 | 40 | 250 | 20 |'
    assert f'| building_000.2dx_x1 | 100 | {row}' in text
    for title in (
        'in 95 %',
        'sigma / rms',
        'overconfident',
        'longest step (ms)',
        'unmapped',
        '99 %',
    ):
        assert f'| {title} |' in text
    assert 'failed' not in text


def test_a_case_that_failed_is_named(reports):
    reports[5] = {'name': CASES[5].name, 'error': 'no scan'}
    assert f'| {CASES[5].name} |  | failed: no scan |' in case_tables(reports)


def test_another_run_beside_it(reports):
    others = [dict(report) for report in reports]
    others[4]['live_m'] = 2.0 * reports[4]['live_m']
    others[6] = of_building(CASES[6], 20.0)
    others[7] = None
    others[8] = {'name': CASES[8].name, 'error': 'no scan'}
    text = against(reports, others)
    assert '(19 of 20 cases)' in text
    assert 'median of the ratios 1.000' in text
    assert '10 m or failed: 0 (other run 2)' in text
    rows = [line for line in text.splitlines() if line.startswith('| building')]
    assert rows == [
        f'| {CASES[4].name} | 0.030 | 0.060 | 0.50 |',
        f'| {CASES[8].name} | 0.070 | 10.000 | 0.01 |',
        f'| {CASES[6].name} | 0.050 | 10.000 | 0.01 |',
    ]


def test_options_of_the_localizer_have_the_types_of_their_defaults():
    words = ['slam=ekf_ti', 'initial_x_m=2', 'mode=localization', 'association.gate=4']
    options = {
        'slam': 'ekf_ti',
        'initial_x_m': 2.0,
        'mode': 'localization',
        'association.gate': 4.0,
    }
    assert program._options(words) == options
    assert program._options(['matching.noise_m=0.1']) == {'matching.noise_m': 0.1}
    with pytest.raises(ConfigError, match=r'association\.gate=4 \(only with slam: ekf_ti or'):
        program._options(['association.gate=4'])
    with pytest.raises(ConfigError, match=r'noise_m=0\.1 \(only with slam: scan_matching'):
        program._options([*words, 'matching.noise_m=0.1'])
    for word in (
        'slan=off',
        'initial_x_m=far',
        'mode=maps',
        'slam=full_of_hope',
        'square_walls=no',
    ):
        with pytest.raises(ConfigError):
            program._options([word])


def logs_in(folder, names):
    for name in names:
        (folder / name).mkdir(parents=True)
        (folder / name / 'log.clf').touch()
    return folder


def test_all_that_was_asked_for_is_a_case(tmp_path):
    names = ['aces', 'intel', 'intel_raw', 'mrpt_office', 'sena']
    cases = all_cases(logs_in(tmp_path / 'logs', names))
    assert len({case.name for case in cases}) == len(cases)
    logs = {case.name: case for case in cases if isinstance(case, LogCase)}
    assert {f'aces.{version}' for version in DEGRADED} | {*names} <= logs.keys()
    for name in ('intel', 'sena', 'mrpt_office'):
        assert {f'{name}.every_2', f'{name}.every_5', f'{name}.rate_1hz'} <= logs.keys()
    # Poses are interpolated at the stamps of relations if these are exact.
    assert {name for name, case in logs.items() if case.exact_s < 0.1} == {
        name for name in logs if name.startswith('intel_raw') or name == 'intel.rate_1hz'
    }
    assert len(BUILDINGS) >= 30
    assert set(BUILDINGS) <= set(DEVELOPMENT_SEEDS)
    runs = [case for case in cases if isinstance(case, BuildingCase)]
    assert {(case.robot, case.noise) for case in runs} == {
        (robot, noise) for robot in ('2dx', '3at') for noise in (1.0, 3.0)
    }
    assert len(runs) == 4 * len(BUILDINGS)


def test_every_real_log_is_a_case(shared_data):
    names = {case.name for case in all_cases(shared_data / 'logs')}
    assert {path.name for path in (shared_data / 'logs').iterdir() if path.is_dir()} <= names


def test_a_covariance_that_is_right_is_found_to_be():
    rng = np.random.default_rng(0)
    truth = np.zeros((4000, 3))
    covariance = np.diag([0.04, 0.01, 1.0])
    poses = rng.normal(size=(4000, 3)) * (0.2, 0.1, 0.0)
    right = Played(poses=list(poses), covariances=[covariance] * 4000, lost=[False] * 4000)
    found = consistency(right, truth)
    assert found['inside_95'] == pytest.approx(0.95, abs=0.015)
    assert found['sigma_of_rms'] == pytest.approx(1.0, abs=0.03)
    assert found['wrong_and_sure'] <= 60
    right.covariances[:5] = [9e4 * np.eye(3)] * 5
    right.lost[:5] = [True] * 5
    assert consistency(right, truth)['sigma_of_rms'] == pytest.approx(1.0, abs=0.03)
    lost = Played(poses=list(100.0 + poses), covariances=[covariance] * 4000, lost=[True] * 4000)
    found = consistency(lost, truth)
    assert found['inside_95'] == 1.0 and found['wrong_and_sure'] == 0, 'it claims no place'
    sure = Played(poses=list(10.0 * poses), covariances=[covariance] * 4000, lost=[False] * 4000)
    found = consistency(sure, truth)
    assert found['sigma_of_rms'] == pytest.approx(0.1, abs=0.003)
    metres = 10.0 * np.hypot(*poses[:, :2].T)
    assert found['wrong_and_sure'] == np.count_nonzero(metres > 0.6)


def test_a_map_that_is_turned_as_a_whole_has_no_error_once_aligned():
    rng = np.random.default_rng(7)
    truth = np.column_stack([rng.uniform(0.0, 30.0, (500, 2)), np.zeros(500)])
    T = se2.pose(4.0, -2.0, 0.6)
    turned = np.array([se2.compose(T, pose) for pose in truth])
    assert aligned_rms(turned, truth) < 1e-9
    turned[:, :2] += rng.normal(0.0, 0.2, (500, 2))
    assert aligned_rms(turned, truth) == pytest.approx(0.2 * math.sqrt(2.0), rel=0.05)


def test_a_disturbed_run_has_noise_of_its_own_and_the_first_has_none():
    driven = [np.array([0.1 * k, 0.02 * k, 0.01 * k]) for k in range(2000)]

    def poses(run):
        return np.array([T for _, T in _disturbed(((None, T) for T in driven), run)])

    np.testing.assert_array_equal(poses(0), driven)
    np.testing.assert_array_equal(poses(1), poses(1))
    assert not np.array_equal(poses(1), poses(2))
    np.testing.assert_array_equal(poses(1)[0], driven[0])
    off = [
        se2.between(a, b) - se2.between(driven[k], driven[k + 1])
        for k, (a, b) in enumerate(pairwise(poses(1)))
    ]
    np.testing.assert_allclose(np.std(off, axis=0), 5e-4, rtol=0.1)


def called(*words):
    """Run the program in this process; returns the exit code."""
    with patch.object(sys, 'argv', ['scoreboard', *map(str, words)]):
        try:
            program.main()
        except SystemExit as end:
            return end.code
    return 0


def write_log(folder, scans):
    """A log of a stationary robot in a room of 6 x 6 m."""
    angles = np.radians(np.arange(-90.0, 90.0))
    ranges = 3.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    beams = ' '.join(f'{each:.3f}' for each in ranges)
    folder.mkdir(parents=True, exist_ok=True)
    stamps = [f'{0.2 * k:.3f}' for k in range(scans)]
    lines = [f'FLASER 180 {beams} 0 0 0 0 0 0 {stamp} x {stamp}\n' for stamp in stamps]
    (folder / 'log.clf').write_text(''.join(lines))


@pytest.mark.programs
def test_it_resumes_and_a_failed_run_stops_no_other(tmp_path, capsys):
    logs = tmp_path / 'shared' / 'data' / 'logs'
    write_log(logs / 'try_1', 0)
    write_log(logs / 'try_2', 8)
    out = tmp_path / 'out'
    words = ['-o', out, '--shared', tmp_path / 'shared', '--only', 'try_?', '--jobs', 1]
    words.append('--quiet')
    assert called(*words) == 2
    assert '1 failed: try_1: ' in capsys.readouterr().err
    text = (out / 'cases.md').read_text()
    assert '| try_1 |  | failed: ' in text
    assert '| try_2 | 8 |' in text
    # Existing results are not computed again; failed ones are.
    file = out / 'board' / 'try_2.json'
    file.write_text(json.dumps(json.loads(file.read_text()) | {'scans': 12345}))
    write_log(logs / 'try_1', 6)
    assert called(*words) == 0
    text = (out / 'cases.md').read_text()
    assert '| try_1 | 6 |' in text
    assert '| try_2 | 12345 |' in text
    # Results of other options are not used.
    assert called(*words, '--set', 'slam=ekf_ti') == 2
    assert 'other options' in capsys.readouterr().err
    assert called(*words, '--against', out) == 0
    assert '## Comparison with another run (2 of 2 cases)' in (out / 'cases.md').read_text()
    assert called(*words, '--against', tmp_path) == 2
    capsys.readouterr()
    assert called(*words, '--runs', 0) == 2
    assert '--runs 0: expected 1 or more' in capsys.readouterr().err
    assert called(*words, '--runs', 2) == 0
    assert '| try_2.run_1 | 8 |' in (out / 'cases.md').read_text()


def test_a_drive_in_a_small_building(tmp_path, monkeypatch):
    small = BuildingConfig(area_m2=200.0, wings=1, clutter=0.0, people_per_1000_m2=0.0)
    monkeypatch.setattr(drives, 'generate_building', lambda seed: generate_building(seed, small))
    monkeypatch.setattr(drives, '_LENGTH_M', 12.0)
    case = BuildingCase(3, '2dx', 3.0)
    report = measure(Task(case, tmp_path, tmp_path, tmp_path, {'slam': 'ekf_ti'}))
    assert report['name'] == 'building_003.2dx_x3'
    assert report['options'] == {'slam': 'ekf_ti'}
    assert report['scans'] > 30
    assert 0.0 <= report['unmapped'] <= 1.0
    assert report['live_m'] < 0.3
    assert report['live_m'] <= report['live_most_m']
    assert 0.0 < report['live_aligned_m'] <= report['live_m']
    assert 0.0 < report['ms_median'] <= report['ms_99'] <= report['stall_ms']
    assert report['mb'] > report['mb_more'] >= 0.0
    assert '| building_003.2dx_x3 |' in case_tables([report])


def test_a_drive_ends_where_it_began_and_its_noise_is_what_is_asked_for():
    robot = drives.noisy(PRESETS['3at'], 3.0)
    assert robot.turn_noise == 3.0 * PRESETS['3at'].turn_noise
    assert robot.radius_m == PRESETS['3at'].radius_m
    made = generate_building(11)
    start = drives._start(made, robot)
    paths = list(drives.paths(made, start, robot, 11))
    assert len(paths) > 1
    np.testing.assert_allclose(paths[-1][-1], start[:2], atol=0.2)


@pytest.mark.programs
def test_a_piece_of_a_real_log_and_the_same_made_worse(shared_data, tmp_path):
    there = shared_data / 'logs' / 'aces'
    own = tmp_path / 'shared' / 'data' / 'logs' / 'aces'
    own.mkdir(parents=True)
    (tmp_path / 'shared' / 'tools').symlink_to(shared_data.parent / 'tools')
    lines = (there / 'log.clf').read_text().splitlines(keepends=True)
    scans = count()
    piece = [line for line in lines if not line.startswith('FLASER') or next(scans) < 60]
    (own / 'log.clf').write_text(''.join(piece))
    end = float(piece[-1].split()[-1])
    for name, stamps in (('odom.txt', 1), ('relations', 2)):
        kept = [
            line
            for line in (there / name).read_text().splitlines(keepends=True)
            if all(float(word) <= end for word in line.split()[:stamps])
        ]
        (own / name).write_text(''.join(kept))
    words = ['-o', tmp_path / 'out', '--shared', tmp_path / 'shared', '--jobs', 2]
    assert called(*words, '--only', 'aces.s*', '--quiet') == 0
    results = tmp_path / 'out' / 'board'
    reports = {path.stem: json.loads(path.read_text()) for path in results.iterdir()}
    assert set(reports) == {'aces.scale', 'aces.slip'}
    for report in reports.values():
        assert report['scans'] == 60
        assert report['live_m'] < 1.0
        assert report['exact_live_m'] < 1.0
    assert (tmp_path / 'out' / 'logs' / 'aces.slip' / 'slip.txt').exists()
