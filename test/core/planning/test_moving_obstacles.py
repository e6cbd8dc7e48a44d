"""Two robots that do not know each other touch nothing, although their commands are late."""

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.planning.obstacles import BlindSectors
from thinmap_ros.core.planning.path_follower import PathFollowerConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.other_robots import simulations_in
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World

FRAME = GridFrame(0.0, 0.0, 0.1)
STEP_S = 0.1
MARGIN_M = 0.35
APART_M = 0.8


def room():
    """A room of 6 x 5 m with a table."""
    cells = np.zeros((50, 60), dtype=np.uint8)
    cells[[0, -1]] = 1
    cells[:, [0, -1]] = 1
    cells[20:26, 24:34] = 1
    return World('room', cells, FRAME, np.zeros(3))


def place_in(world, rng):
    while True:
        x, y, theta = rng.uniform((0.5, 0.5, -3.0), (5.5, 4.5, 3.0))
        if world.is_clear(x, y, MARGIN_M):
            return se2.pose(x, y, theta)


def starts_in(world, rng):
    first = place_in(world, rng)
    while True:
        second = place_in(world, rng)
        if np.hypot(*(second - first)[:2]) > APART_M:
            return [first, second]


class Driver:
    """Drives a robot to one random goal after another; each command comes a step late."""

    def __init__(self, simulation, rng):
        self.simulation = simulation
        self.rng = rng
        self.navigator = Navigator(
            NavigatorConfig(controller=PathFollowerConfig(max_speed_m_s=0.5))
        )
        self.state = 'idle'
        self.command = (0.0, 0.0)
        self.scan = None
        self.driven_m = 0.0
        self.sense(simulation.read_sensors())

    def sense(self, moment):
        for scan in moment.scans:
            self.scan = scan

    def decide(self, patch):
        """The command for the step after the next one."""
        robot = self.simulation.robot
        if self.state not in ('driving', 'blocked'):
            self.navigator.set_goal(*place_in(room(), self.rng)[:2].tolist())
        command = self.navigator.step(robot.T_world_base, patch, self.scan, STEP_S)
        self.state = command.state
        self.driven_m += robot.v * STEP_S
        return command.v, command.w


def rove(seed, seconds=60.0):
    """Contacts of two robots, and the distance that both have driven."""
    rng = np.random.default_rng(seed)
    world = room()
    laser = LaserScannerConfig()
    simulations = simulations_in(world, starts_in(world, rng), PRESETS['2dx'], laser, seed)
    drivers = [Driver(simulation, rng) for simulation in simulations]
    patch = GridPatch(FRAME, np.where(world.occupied, 100, 0).astype(np.int8))
    for _ in range(round(seconds / STEP_S)):
        following = [driver.decide(patch) for driver in drivers]
        for _ in range(2):
            for driver in drivers:
                driver.sense(driver.simulation.step(*driver.command))
        for driver, command in zip(drivers, following, strict=True):
            driver.command = command
    contacts = sum(driver.simulation.robot.collisions for driver in drivers)
    return contacts, sum(driver.driven_m for driver in drivers)


@pytest.mark.parametrize('seed', range(6))
def test_robots_that_do_not_know_each_other_do_not_touch(seed):
    contacts, driven_m = rove(seed)
    assert contacts == 0
    assert driven_m > 15.0


def seen(ns, ranges):
    return Scan.create(ns, np.asarray(ranges, dtype=np.float64), -0.2, 0.01, 0.05, 8.0)


def test_what_stands_where_a_scan_saw_free_space_lately_has_moved():
    sectors = BlindSectors()
    ranges = np.full(41, 4.0)
    pose = np.zeros(3)
    sectors.add_scan(pose, seen(0, ranges))
    ranges[15:26] = 2.0
    sectors.add_scan(pose, seen(200_000_000, ranges))
    points = np.array([(2.0, 0.0), (3.95, 0.0), (2.0, 1.0), (5.0, 0.0)])
    assert sectors.have_moved(points, '').tolist() == [True, False, False, False]
    for k in range(2, 5):
        sectors.add_scan(pose, seen(k * 200_000_000, ranges))
    assert not sectors.have_moved(points, '').any()  # it stands


def test_an_edge_that_noise_has_moved_by_a_beam_has_not_moved():
    sectors = BlindSectors()
    ranges = np.full(41, 4.0)
    ranges[:20] = 2.0
    sectors.add_scan(np.zeros(3), seen(0, ranges))
    ranges[20] = 2.0
    sectors.add_scan(np.zeros(3), seen(200_000_000, ranges))
    assert not sectors.have_moved(np.array([(2.0, 0.0)]), '').any()
