"""What stays at one place of the laser's frame while the robot drives and turns is its body."""

from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, drive, ranges_in, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.sensing.beams import LaserMonitor

START = se2.pose(2.0, 2.0, 0.0)
PERIOD_NS = 200_000_000
ROUND = np.linspace(-np.pi, np.pi, 360, endpoint=False)


def with_part(scan, rng, low_deg, high_deg, range_m, sway_m=0.0):
    """The scan with a part of the robot between two bearings, which moves a little."""
    bearings = np.degrees(scan.angles_rad)
    is_part = (bearings > low_deg) & (bearings < high_deg)
    range_m += sway_m * np.sin(scan.stamp_ns)
    ranges = np.where(is_part, rng.normal(range_m, 0.005, is_part.size), scan.ranges_m)
    return replace(scan, ranges_m=ranges)


def driven(spoil, scans=400):
    """The monitor after a drive round the room, and the last scan before and after its check."""
    rng = np.random.default_rng(7)
    monitor = LaserMonitor()
    for k, (truth, odom) in zip(range(scans), drive(scans, rng, START), strict=False):
        scan = spoil(scan_in(ROOM, truth, rng, k * PERIOD_NS), rng)
        checked = monitor.checked(scan, odom)
    return monitor, scan, checked


@pytest.mark.parametrize(
    ('part', 'text'),
    [
        ((60.1, 89.9, 0.22), '59.5 90.5'),
        ((-4.1, 4.1, 0.2), '-5.5 5.5'),
        ((-50.1, -42.9, 0.6), '-51.5 -41.5'),
        ((60.1, 66.9, 0.3, 0.02), '59.5 67.5'),
    ],
)
def test_a_part_of_the_robot_is_left_out(part, text):
    monitor, scan, checked = driven(lambda scan, rng: with_part(scan, rng, *part))
    assert f'set body_sectors to "{text}"' in monitor.warnings['body']
    bearings = np.degrees(scan.angles_rad)
    is_part = (bearings > part[0]) & (bearings < part[1])
    assert np.isnan(checked.ranges_m[is_part]).all()
    np.testing.assert_array_equal(checked.ranges_m[~is_part], scan.ranges_m[~is_part])


def test_an_obstacle_before_a_part_of_the_robot_is_seen():
    monitor, scan, _ = driven(lambda scan, rng: with_part(scan, rng, 40.0, 60.0, 0.6))
    near = with_part(scan, np.random.default_rng(1), 45.0, 55.0, 0.35)
    checked = monitor.checked(near, se2.pose(30.0, 0.0, 0.0))
    bearings = np.degrees(scan.angles_rad)
    is_near = (bearings > 45.0) & (bearings < 55.0)
    assert checked.hit[is_near].all()


def test_a_part_that_was_taken_off_is_forgotten():
    monitor = LaserMonitor()
    rng = np.random.default_rng(7)
    for k, (truth, odom) in zip(range(450), drive(450, rng, START), strict=False):
        scan = scan_in(ROOM, truth, rng, k * PERIOD_NS)
        monitor.checked(with_part(scan, rng, 40.0, 60.0, 0.3) if k < 400 else scan, odom)
        assert k != 399 or 'body' in monitor.warnings
    assert not monitor.warnings


def test_bearings_of_a_laser_that_hangs_are_those_of_its_own_frame():
    def spoil(scan, rng):
        return replace(with_part(scan, rng, 60.1, 66.9, 0.3), is_mirrored=True)

    monitor, _, _ = driven(spoil)
    assert '"-67.5 -59.5"' in monitor.warnings['body']


def along(way):
    """Poses of a robot that drives along some points (N, 2), and turns in place at them."""
    T = se2.pose(*way[0], 0.0)
    for goal in way[1:]:
        bearing = np.arctan2(goal[1] - T[1], goal[0] - T[0])
        while abs(turn := se2.wrap(bearing - T[2])) > 1e-3:
            T = se2.compose(T, se2.pose(0.0, 0.0, np.clip(turn, -0.12, 0.12)))
            yield T
        while (away := np.hypot(*(goal - T[:2]))) > 0.01:
            T = se2.compose(T, se2.pose(min(away, 0.05), 0.0, 0.0))
            yield T


def around_pillar(distance_m):
    """Poses round a pillar of 0.4 m at the origin, with some looks aside."""
    radius_m = 0.4 + distance_m
    for k in range(400):
        angle = 0.05 * k / radius_m
        T = se2.pose(radius_m * np.cos(angle), radius_m * np.sin(angle), angle + 0.5 * np.pi)
        aside = [0.0, 0.15, 0.3, 0.0, -0.3, -0.15, 0.0] if k % 25 == 0 else [0.0]
        yield from (se2.compose(T, se2.pose(0.0, 0.0, turn)) for turn in aside)


def rectangle(x0, y0, x1, y1):
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]], dtype=float)
    return np.hstack([corners[:-1], corners[1:]])


ANGLES = np.linspace(0.0, 2.0 * np.pi, 41)
PILLAR = 0.4 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
INSIDE = np.array([[0.4, 0.4], [3.6, 0.4], [3.6, 2.6], [0.4, 2.6]] * 3)
CORRIDOR = np.array([[0.5, 0.4], [7.5, 0.4]] * 4)


@pytest.mark.parametrize(
    ('walls', 'poses'),
    [
        (rectangle(0.0, 0.0, 4.0, 3.0), along(INSIDE)),
        (rectangle(0.0, 0.0, 8.0, 0.8), along(CORRIDOR)),
        (np.vstack([np.hstack([PILLAR[:-1], PILLAR[1:]]), ROOM - 4.0]), around_pillar(0.3)),
    ],
)
def test_a_wall_that_the_robot_follows_is_no_body(walls, poses):
    rng = np.random.default_rng(1)
    monitor = LaserMonitor()
    for k, T in enumerate(poses):
        ranges = ranges_in(walls, T, ROUND) + rng.normal(0.0, 0.01, ROUND.size)
        monitor.checked(Scan.create(k * PERIOD_NS, ranges, -np.pi, np.pi / 180.0, 0.05, 8.0), T)
        assert not monitor.warnings


def test_a_person_who_follows_is_no_body():
    monitor, _, _ = driven(lambda scan, rng: with_part(scan, rng, -8.0, 8.0, 0.75))
    assert not monitor.warnings


def test_equal_ranges_of_a_frozen_driver_are_no_body():
    near = scan_in(np.array([[0.5, -9.0, 0.5, 9.0]]), se2.pose(0.0, 0.0, 0.0))
    monitor, _, _ = driven(lambda scan, rng: replace(near, stamp_ns=scan.stamp_ns))
    assert not monitor.warnings


def test_a_jump_of_the_odometry_is_no_drive():
    rng = np.random.default_rng(3)
    monitor = LaserMonitor()
    wall = np.array([[0.5, -9.0, 0.5, 9.0]])
    for k in range(300):
        odom = se2.pose(3.0 * (k % 2), 0.0, 3.0 * (k % 2))
        monitor.checked(scan_in(wall, np.zeros(3), rng, k * PERIOD_NS), odom)
    assert 'body' not in monitor.warnings


def test_a_body_that_was_found_stays_over_a_gap_in_the_scans():
    monitor, scan, _ = driven(lambda scan, rng: with_part(scan, rng, 60.1, 89.9, 0.22))
    known = monitor.warnings['body']
    far = monitor.checked(replace(scan, stamp_ns=scan.stamp_ns + 1), se2.pose(30.0, 0.0, 0.0))
    assert np.isnan(far.ranges_m).any()
    assert monitor.warnings['body'] == known


def test_a_surface_that_is_measured_once_in_a_dead_sector_is_no_body():
    def dead(scan, rng):
        range_m = 0.65 if 50 <= scan.stamp_ns // PERIOD_NS < 56 else np.nan
        return with_part(scan, rng, 60.1, 89.9, range_m)

    monitor, _, _ = driven(dead)
    assert 'body' not in monitor.warnings
