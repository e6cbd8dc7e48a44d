"""Robots in one world see and touch each other."""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.other_robots import simulations_in, starts_in, starts_side_by_side
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World

RADIUS_M = PRESETS['2dx'].radius_m
LASER = LaserScannerConfig(range_noise_m=0.0, mixed_pixel_ratio=0.0)


def room(rows=80, cols=80):
    cells = np.zeros((rows, cols), dtype=np.uint8)
    cells[[0, -1]] = 1
    cells[:, [0, -1]] = 1
    return World('room', cells, GridFrame(0.0, 0.0, 0.1), se2.pose(2.0, 4.0, 0.0))


def two(place):
    """Simulations of a robot at (2, 4) that faces +x, and of another one at a pose."""
    return simulations_in(room(), [se2.pose(2.0, 4.0, 0.0), place], PRESETS['2dx'], LASER, 1)


def test_a_laser_sees_the_other_robot_and_the_wall_beside_it():
    one, _ = two(se2.pose(5.0, 4.0, math.pi))
    (scan,) = one.read_sensors().scans
    ahead = scan.ranges_m.size // 2
    assert scan.ranges_m[ahead] == pytest.approx(3.0 - RADIUS_M, abs=0.002)
    off = math.asin(RADIUS_M / 3.0)
    is_robot = np.abs(scan.angles_rad) < off
    assert (scan.ranges_m[is_robot] < 3.0).all()
    assert (scan.ranges_m[np.abs(scan.angles_rad) > off + 0.01] > 3.5).all()


def test_a_robot_that_drives_into_another_one_stops_and_counts_one_contact():
    one, other = two(se2.pose(4.0, 4.0, math.pi))
    for _ in range(200):
        one.step(0.5, 0.0)
        other.step(0.0, 0.0)
    assert one.robot.collisions == 1
    assert other.robot.collisions == 0
    gap_m = math.dist(one.robot.T_world_base[:2], other.robot.T_world_base[:2])
    assert 2.0 * RADIUS_M <= gap_m < 2.0 * RADIUS_M + 0.03


def test_starts_are_apart_and_fit():
    world = room()
    starts = starts_side_by_side(world, se2.pose(2.0, 4.0, 0.0), 5, RADIUS_M)
    assert starts[0].tolist() == [2.0, 4.0, 0.0]
    assert starts[1].tolist() == pytest.approx([2.0, 4.8, 0.0])
    for number, start in enumerate(starts):
        assert world.is_clear(*start[:2], RADIUS_M)
        assert all(math.dist(start[:2], other[:2]) > 0.79 for other in starts[:number])


def test_a_start_without_room_is_refused():
    with pytest.raises(InputError, match='expected room for 3 robots'):
        starts_side_by_side(room(8, 20), se2.pose(0.6, 0.4, 0.0), 3, RADIUS_M)


def test_no_robot_starts_behind_a_wall():
    world = room()
    world.occupied[:, 25] = 1
    starts = starts_side_by_side(world, se2.pose(2.0, 4.0, 0.0), 4, RADIUS_M)
    assert max(start[0] for start in starts) < 2.5


def test_a_robot_does_not_start_on_another_one():
    with pytest.raises(InputError, match=r'start \[2.3, 4.0\]: expected a place'):
        two(se2.pose(2.3, 4.0, 0.0))


def test_listed_starts_come_before_those_side_by_side():
    world = room()
    listed = np.array([[5.0, 5.0, 1.0], [2.0, 2.0, 0.0]])
    for count, expected in ((2, listed.tolist()), (1, [world.start.tolist()])):
        starts = starts_in(world, world.start, listed, count, RADIUS_M)
        assert [start.tolist() for start in starts] == expected
    side_by_side = starts_in(world, world.start, listed, 3, RADIUS_M)
    assert side_by_side[0].tolist() == world.start.tolist()


def test_robots_are_the_same_alone_and_beside_another_one_but_for_what_they_see():
    """The noise of each is that of its own seed."""
    one, other = two(se2.pose(2.0, 1.0, 0.0))
    (alone,) = simulations_in(room(), [se2.pose(2.0, 4.0, 0.0)], PRESETS['2dx'], LASER, 1)
    for _ in range(40):
        one.step(0.3, 0.1)
        other.step(0.3, 0.1)
        alone.step(0.3, 0.1)
    assert one.robot.T_odom_base.tolist() == alone.robot.T_odom_base.tolist()
    assert other.robot.T_odom_base.tolist() != alone.robot.T_odom_base.tolist()
