"""Robots in one world see and touch each other."""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.other_robots import SharedWorld, starts_side_by_side
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import Simulation
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
    worlds = [SharedWorld.of(room()), SharedWorld.of(room())]
    poses = [se2.pose(2.0, 4.0, 0.0), place]
    simulations = [
        Simulation(world, pose, PRESETS['2dx'], LASER, 1)
        for world, pose in zip(worlds, poses, strict=True)
    ]
    worlds[0].others.append(simulations[1].robot)
    worlds[1].others.append(simulations[0].robot)
    return simulations


def test_a_laser_sees_the_other_robot_and_the_wall_beside_it():
    one, _ = two(se2.pose(5.0, 4.0, math.pi))
    scan = one.read_sensors().scan
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
