"""Scans that a laser did not measure are blind: frozen ones, and those that lose all walls."""

from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, drive, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.sensing.beams import FROZEN, NO_RETURNS, LaserMonitor

START = se2.pose(2.0, 2.0, 0.0)
PERIOD_NS = 200_000_000


class Drive:
    """A robot that drives round a room, and whose scans a monitor checks."""

    def __init__(self):
        self.monitor = LaserMonitor()
        self.rng = np.random.default_rng(7)
        self._poses = drive(2000, self.rng, START)
        self._k = 0
        self.faults = []

    def step(self, spoil=lambda scan: scan, walls=ROOM):
        """The measured scan, spoiled, and the checked one."""
        truth, odom = next(self._poses)
        self._k += 1
        scan = spoil(scan_in(walls, truth, self.rng, self._k * PERIOD_NS))
        checked = self.monitor.checked(scan, odom)
        self.faults.append(checked.fault)
        return scan, checked

    def steps(self, count, spoil=lambda scan: scan, walls=ROOM):
        self.faults.clear()
        for _ in range(count):
            self.step(spoil, walls)
        return self.faults


def with_ranges(value, share=1.0):
    """Spoils a share of the beams of each scan."""
    rng = np.random.default_rng(1)

    def spoil(scan):
        ranges = scan.ranges_m.copy()
        ranges[rng.random(ranges.size) < share] = value
        return replace(scan, ranges_m=ranges)

    return spoil


def test_good_scans_pass_unchanged():
    robot = Drive()
    for _ in range(300):
        scan, checked = robot.step()
        assert checked is scan


@pytest.mark.parametrize('value', [np.inf, 8.0, 1e9])
def test_walls_do_not_vanish_from_one_scan_to_the_next(value):
    robot = Drive()
    robot.steps(50)
    assert set(robot.steps(400, with_ranges(value))) == {NO_RETURNS}
    assert set(robot.steps(50)) == {''}


def test_without_returns_from_most_walls_a_scan_is_blind():
    robot = Drive()
    robot.steps(50)
    assert robot.steps(20, with_ranges(np.inf, 0.8)).count(NO_RETURNS) >= 19
    assert set(robot.steps(50)) == {''}


def test_some_beams_without_returns_are_no_fault():
    robot = Drive()
    robot.steps(50)
    assert set(robot.steps(100, with_ranges(np.inf, 0.3))) == {''}


def test_frozen_ranges_are_noticed_once_the_robot_has_moved():
    robot = Drive()
    robot.steps(50)
    frozen, _ = robot.step()
    faults = robot.steps(15, lambda scan: replace(frozen, stamp_ns=scan.stamp_ns))
    assert set(faults[5:]) == {FROZEN}
    assert set(robot.steps(20)) == {''}


def test_equal_scans_of_a_robot_that_stands_are_no_fault():
    monitor = LaserMonitor()
    scan = scan_in(ROOM, START)
    for k in range(1000):
        drifting = se2.pose(1e-4 * k, 0.0, 1e-4 * k)
        checked = monitor.checked(replace(scan, stamp_ns=k * PERIOD_NS), drifting)
        assert not checked.fault


def test_a_hall_without_returns_is_no_fault():
    monitor = LaserMonitor()
    for k in range(50):
        empty = Scan.create(k * PERIOD_NS, np.full(181, np.inf), -1.57, 0.0175, 0.05, 8.0)
        assert not monitor.checked(empty, se2.pose(0.05 * k, 0.0, 0.0)).fault


def test_a_robot_that_leaves_the_walls_behind_is_no_fault():
    """Into a hall: the walls go out of range one by one."""
    walls = np.array([[0.0, -20.0, 0.0, 20.0]])
    monitor = LaserMonitor()
    for k in range(200):
        truth = se2.pose(0.1 * k + 0.5, 0.0, np.pi)
        assert not monitor.checked(scan_in(walls, truth, stamp_ns=k * PERIOD_NS), truth).fault


def test_a_robot_that_was_carried_to_a_hall_sees_again_after_a_while():
    """With few walls there, most of the surfaces of before have vanished for good."""
    monitor = LaserMonitor()
    rng = np.random.default_rng(3)
    for k in range(10):
        monitor.checked(scan_in(ROOM, START, rng, k * PERIOD_NS), START)
    short = np.array([[4.0, 1.5, 4.0, 2.5]])
    faults = []
    for k in range(10, 40):
        faults.append(monitor.checked(scan_in(short, START, rng, k * PERIOD_NS), START).fault)
    assert faults[0] == NO_RETURNS
    assert set(faults[12:]) == {''}


@pytest.mark.parametrize(
    ('step', 'count', 'fault'),
    [
        (0.0, 1, ''),
        (1e-30, 1, ''),
        (1e-30, 181, ''),
        (-1e-30, 181, ''),
        (0.0175, 181, NO_RETURNS),
    ],
)
def test_scans_of_odd_geometry_are_checked(step, count, fault):
    """A beam that no surface lies on says nothing."""
    monitor = LaserMonitor()
    monitor.checked(scan_in(ROOM, START), START)
    scan = Scan.create(PERIOD_NS, np.full(count, np.inf), -1.57, step, 0.05, 8.0)
    assert monitor.checked(scan, START).fault == fault


def test_a_laser_that_drops_out_misses_surfaces_and_is_not_blind_until_all_are_missed():
    """Two successive scans have returns from other surfaces, as of real lasers."""
    robot = Drive()
    robot.steps(200, with_ranges(np.inf, 0.6))
    assert 'dropouts' in robot.monitor.warnings
    halves = [np.arange(181) % 40 < 15, np.arange(181) % 40 >= 25]

    def half(scan):
        ranges = np.where(halves[scan.stamp_ns // PERIOD_NS % 2], scan.ranges_m, np.inf)
        return replace(scan, ranges_m=ranges)

    assert set(robot.steps(50, half)) == {''}
    _, checked = robot.step(with_ranges(np.inf))
    assert checked.is_blind
