"""The program replay on what drivers record: late messages, other frames, parameter files."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bag_maker import ODOMETRY, SCAN, TF, Maker, write
from support.carmen_log import box_ranges, carmen_lines
from support.forks import forked

from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.logs.bag_writer import BagWriter

SCANS = 60
PERIOD_NS = SECOND_NS // 5
MOUNT = ('base_link', 'laser', (0.0, 0.0, 0.2))
Made = tuple[str, str, int, Any]


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return forked.run('thinmap_ros.tools.replay', *arguments, '--quiet')


def scan_of(make: Maker, k: int) -> Any:
    scan = make.scan(SECOND_NS + k * PERIOD_NS, box_ranges(0.03 * k, 0.0).tolist())
    scan.angle_min = -np.pi / 2
    scan.angle_max = np.pi / 2
    scan.angle_increment = np.pi / 180
    return scan


def bag(path: Path, messages: Callable[[Maker], list[Made]]) -> Path:
    """A bag of messages in the order of their log times, with the mount of the laser."""

    def fill(writer: BagWriter, make: Maker) -> None:
        writer.write('/tf_static', TF, 0, make.transform(*MOUNT))
        for topic, kind, ns, message in sorted(messages(make), key=lambda made: made[2]):
            writer.write(topic, kind, ns, message)

    return write(path, fill)


def scans(make: Maker, late_ns: int = 0) -> list[Made]:
    """A robot that drives through a room; late_ns: delay of every third scan."""
    return [
        (
            '/scan',
            SCAN,
            SECOND_NS + k * PERIOD_NS + 1 + (k % 3 == 1) * late_ns,
            scan_of(make, k),
        )
        for k in range(SCANS)
    ]


def odometry(make: Maker, every_ns: int, first_ns: int = SECOND_NS) -> list[Made]:
    made: list[Made] = []
    for ns in range(first_ns, SECOND_NS + SCANS * PERIOD_NS + every_ns, every_ns):
        x = 0.15 * (ns - SECOND_NS) / SECOND_NS
        made.append(('/odom', ODOMETRY, ns, make.odometry(ns, x)))
    return made


def replayed(
    tmp_path: Path, path: Path, *options: object
) -> tuple[subprocess.CompletedProcess[str], dict[str, Any]]:
    done = run(path, '-o', tmp_path / 'out', *options)
    assert done.returncode == 0, done.stderr
    return done, json.loads((tmp_path / 'out' / 'report.json').read_text())


@pytest.mark.programs
def test_late_scans_are_used_by_their_stamps(tmp_path: Path) -> None:
    path = bag(
        tmp_path / 'bag',
        lambda make: scans(make, late_ns=3 * SECOND_NS // 10) + odometry(make, SECOND_NS // 20),
    )
    _, report = replayed(tmp_path, path)
    assert (report['scans'], report['skipped']) == (SCANS, 0)
    assert report['distance'] == pytest.approx(0.03 * (SCANS - 1), abs=0.06)
    trajectory = np.loadtxt(tmp_path / 'out' / 'trajectory.tum')
    np.testing.assert_allclose(trajectory[:, 0], 1.0 + 0.2 * np.arange(SCANS), atol=1e-6)


@pytest.mark.programs
def test_a_trajectory_has_one_pose_for_each_stamp(tmp_path: Path) -> None:
    path = tmp_path / 'log.clf'
    lines = carmen_lines()
    path.write_text('\n'.join(lines[:20] + lines[18:20] + lines[20:]))
    _, report = replayed(tmp_path, path)
    assert report['scans'] == 31
    for name in ('trajectory.tum', 'trajectory_final.tum'):
        stamps = np.loadtxt(tmp_path / 'out' / name)[:, 0]
        assert (np.diff(stamps) > 0.0).all() and len(stamps) == 30


@pytest.mark.programs
def test_scans_of_a_coarse_clock_keep_their_poses(tmp_path: Path) -> None:
    path = tmp_path / 'log.clf'
    lines = carmen_lines()
    stamp = lines[18].split()[-3]
    lines[20] = lines[20].replace(lines[20].split()[-3], stamp)
    path.write_text('\n'.join(lines))
    replayed(tmp_path, path)
    trajectory = np.loadtxt(tmp_path / 'out' / 'trajectory.tum')
    assert len(trajectory) == 30
    assert (np.diff(trajectory[:, 0]) == 0.0).sum() == 1
    assert (np.diff(trajectory[:, 1]) > 0.01).all()


@pytest.mark.programs
@pytest.mark.parametrize('every_s', [1.0, 1.05])
def test_odometry_once_a_second_is_enough(tmp_path: Path, every_s: float) -> None:
    path = bag(
        tmp_path / 'bag', lambda make: scans(make) + odometry(make, round(every_s * SECOND_NS))
    )
    done, report = replayed(tmp_path, path)
    assert (report['scans'], report['without_odometry']) == (SCANS, 0)
    assert done.stderr == ''
    trajectory = np.loadtxt(tmp_path / 'out' / 'trajectory.tum')
    assert np.abs(trajectory[:, 1] - 0.03 * np.arange(SCANS)).max() < 0.05


@pytest.mark.programs
def test_scans_without_odometry_are_told_loudly_with_the_reason(tmp_path: Path) -> None:
    path = bag(tmp_path / 'bag', lambda make: scans(make) + odometry(make, 5 * SECOND_NS))
    done, report = replayed(tmp_path, path)
    used = report['scans']
    assert 0 < used < SCANS / 2
    reason = 'in gaps of the odometry of up to 5 s: expected at most 2 s'
    assert report['without_odometry'] == report['reasons'][reason] == SCANS - used
    assert f'replay: warning: only {used} of {SCANS} scans were used' in done.stderr
    assert f'{SCANS - used} scans {reason}' in done.stderr


@pytest.mark.programs
def test_clocks_that_do_not_fit_are_told_with_their_difference(tmp_path: Path) -> None:
    later_ns = SECOND_NS + round(3 * 365.25 * 86400) * SECOND_NS

    def messages(make: Maker) -> list[Made]:
        made = [
            ('/odom', ODOMETRY, SECOND_NS + ns, make.odometry(later_ns + ns, 1e-10 * ns))
            for ns in range(0, SCANS * PERIOD_NS, SECOND_NS // 20)
        ]
        return scans(make) + made

    done = run(bag(tmp_path / 'bag', messages), '-o', tmp_path / 'out')
    assert done.returncode == 2
    assert f'{SCANS} scans before the first odometry, by up to 3 years' in done.stderr


@pytest.mark.programs
def test_blind_scans_are_counted_and_told_loudly(tmp_path: Path) -> None:
    def messages(make: Maker) -> list[Made]:
        made = scans(make)
        for *_, message in made[10:]:
            message.ranges[:] = np.nan
        return made + odometry(make, SECOND_NS // 20)

    done, report = replayed(tmp_path, bag(tmp_path / 'bag', messages))
    assert (report['scans'], report['blind'], report['lost']) == (SCANS, SCANS - 10, 0)
    assert report['reasons'] == {'too few valid beams': SCANS - 10}
    assert f'only 10 of {SCANS} scans were used: {SCANS - 10} blind: too few' in done.stderr


@pytest.mark.programs
def test_a_good_bag_needs_no_note(tmp_path: Path) -> None:
    path = bag(tmp_path / 'bag', lambda make: scans(make) + odometry(make, SECOND_NS // 20))
    done, report = replayed(tmp_path, path)
    assert done.stderr == ''
    assert (report['notes'], report['reasons'], report['ended_by']) == ([], {}, '')


@pytest.mark.programs
@pytest.mark.parametrize('source', ['tf', 'none'])
def test_odometry_by_tf_or_none(tmp_path: Path, source: str) -> None:
    def messages(make: Maker) -> list[Made]:
        made: list[Made] = scans(make)
        for k in range(SCANS + 1) if source == 'tf' else ():
            ns = SECOND_NS + k * PERIOD_NS
            pose = make.transform('odom', 'base_link', (0.03 * k, 0.0, 0.0), ns=ns)
            made.append(('/tf', TF, ns, pose))
        return made

    _, report = replayed(tmp_path, bag(tmp_path / 'bag', messages), '--odom-source', source)
    assert (report['scans'], report['skipped']) == (SCANS, 0)
    trajectory = np.loadtxt(tmp_path / 'out' / 'trajectory.tum')
    assert np.abs(trajectory[:, 1] - 0.03 * np.arange(SCANS)).max() < 0.08


@pytest.mark.programs
def test_a_parameter_file_gives_what_options_do_not(tmp_path: Path) -> None:
    path = bag(tmp_path / 'bag', lambda make: scans(make) + odometry(make, SECOND_NS // 20))
    file = tmp_path / 'robot.yaml'
    file.write_text(
        '/**:\n  ros__parameters: {laser_pose: "-0.5,0.0,0.0", resolutoin_m: 0.1}\n'
        'grid_mapper:\n  ros__parameters: {resolution_m: 0.2}\n'
    )
    done, _ = replayed(tmp_path, path, '--params-file', file)
    assert 'replay: note: ' in done.stderr and 'resolutoin_m' in done.stderr
    assert 'resolution: 0.2' in (tmp_path / 'out' / 'map.yaml').read_text()
    wall = pgm_extent(tmp_path)
    replayed(tmp_path, path, '--params-file', file, '--laser-pose', '-0.5,0,0')
    assert pgm_extent(tmp_path) == wall
    replayed(tmp_path, path, '--params-file', file, '--resolution-m', '0.05')
    assert 'resolution: 0.05' in (tmp_path / 'out' / 'map.yaml').read_text()


@pytest.mark.programs
def test_the_option_slam_comes_before_that_of_the_file(tmp_path: Path) -> None:
    log = tmp_path / 'log.clf'
    log.write_text('\n'.join(carmen_lines()) + '\n')
    file = tmp_path / 'robot.yaml'
    file.write_text('localizer:\n  ros__parameters: {slam: ekf_ti, association: {gate: 4.0}}\n')
    done, report = replayed(tmp_path, log, '--params-file', file)
    assert report['features'] > 0 and 'note' not in done.stderr
    done, report = replayed(tmp_path, log, '--params-file', file, '--slam', 'scan_matching')
    assert report['features'] == 0
    assert 'association.gate (only with slam: ekf_ti or ekf_full)' in done.stderr
    file.write_text('localizer:\n  ros__parameters: {slam: magic}\n')
    done = run(log, '-o', tmp_path / 'out', '--params-file', file)
    assert done.returncode == 2
    assert "slam = 'magic': expected one of scan_matching, ekf_ti, ekf_full" in done.stderr


def pgm_extent(tmp_path: Path) -> bytes:
    return (tmp_path / 'out' / 'map.pgm').read_bytes()


@pytest.mark.programs
@pytest.mark.parametrize(
    ('options', 'said'),
    [
        (['--laser-pose', '1,2'], "laser_pose = '1,2': expected"),
        (['--odom-source', 'tf'], 'a CARMEN log has its own odometry'),
        (['--params-file', 'none.yaml'], 'none.yaml: No such file'),
    ],
)
def test_wrong_options_are_named_in_one_line(tmp_path: Path, options: list[str], said: str) -> None:
    (tmp_path / 'log.clf').write_text('\n'.join(carmen_lines()))
    done = run(tmp_path / 'log.clf', '-o', tmp_path / 'out', *options)
    assert done.returncode == 2
    assert said in done.stderr and len(done.stderr.splitlines()) == 1


@pytest.mark.programs
def test_scans_of_a_misaligned_laser_are_counted_and_told(tmp_path: Path) -> None:
    def backwards(make: Maker) -> list[Made]:
        made: list[Made] = []
        for k in range(3 * SCANS):
            ns = SECOND_NS + k * PERIOD_NS // 3
            scan = make.scan(ns, box_ranges(0.03 * k - 2.6, 0.0).tolist())
            scan.angle_min = -np.pi / 2
            scan.angle_max = np.pi / 2
            scan.angle_increment = np.pi / 180
            made.append(('/scan', SCAN, ns + 1, scan))
            made.append(('/odom', ODOMETRY, ns, make.odometry(ns, -0.03 * k)))
        return made

    done, report = replayed(tmp_path, bag(tmp_path / 'bag', backwards))
    assert 0 < report['misaligned'] < report['scans']
    assert f'{report["scans"]} scans ({report["misaligned"]} of a misaligned laser)' in done.stdout
    assert 'laser turned by' in done.stderr
