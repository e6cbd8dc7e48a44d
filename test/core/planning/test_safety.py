"""The robot has no contact with obstacles, for any goal.

Real limits and a real laser in rooms full of pillars.
"""

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.planning.path_follower import PathFollowerConfig
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import Simulation
from thinmap_ros.sim.world import World

FRAME = GridFrame(0.0, 0.0, 0.1)


def pillars(rng):
    cells = np.zeros((70, 70), dtype=np.uint8)
    cells[[0, -1]] = 1
    cells[:, [0, -1]] = 1
    for row, col in rng.integers(2, 66, (16, 2)):
        height, width = rng.integers(1, 9, 2)
        cells[row : row + height, col : col + width] = 1
    return World('pillars', cells, FRAME, np.zeros(3))


def start_in(world, rng):
    while True:
        x, y, theta = rng.uniform((0.5, 0.5, -3.0), (6.5, 6.5, 3.0))
        if world.is_clear(x, y, 0.35):
            return se2.pose(x, y, theta)


def rove(seed, speed, knows_pillars, seconds=40.0):
    """Drive to random goals, which are often replaced before they are reached.

    Returns the number of contacts and the travelled distance.
    """
    rng = np.random.default_rng(seed)
    world = pillars(rng)
    robot = Simulation(world, start_in(world, rng), PRESETS['2dx'], LaserScannerConfig(), seed)
    known = (
        world.occupied
        if knows_pillars
        else np.pad(np.zeros((68, 68), dtype=np.uint8), 1, constant_values=1)
    )
    patch = GridPatch(FRAME, np.where(known, 100, 0).astype(np.int8))
    navigator = Navigator(NavigatorConfig(controller=PathFollowerConfig(max_speed_m_s=speed)))
    moment = robot.read_sensors()
    scan = None
    until = 0.0
    way_m = 0.0
    while moment.stamp_ns < seconds * 1e9:
        (scan,) = moment.scans or (scan,)
        if moment.stamp_ns >= until * 1e9:
            until += rng.uniform(0.5, 6.0)
            navigator.set_goal(*start_in(world, rng).tolist())
            if rng.random() < 0.2:
                navigator.cancel()
        command = navigator.step(robot.robot.T_world_base, patch, scan, 0.1)
        for _ in range(2):
            moment = robot.step(command.v, command.w)
            (scan,) = moment.scans or (scan,)
        way_m += robot.robot.v * 0.1
    return robot.robot.collisions, way_m


@pytest.mark.parametrize('seed', range(8))
@pytest.mark.parametrize('knows_pillars', [True, False])
@pytest.mark.parametrize('speed', [0.2, 0.5, 1.0])
def test_it_touches_nothing(seed, knows_pillars, speed):
    collisions, way_m = rove(seed, speed, knows_pillars)
    assert collisions == 0
    assert way_m > 1.0
