"""Robots that take each other for walls until their maps are joined: the maps against the world."""

from dataclasses import replace

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.grid.correction import CorrectableGrid
from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.scan import NearbyRobot
from thinmap_ros.core.slam.graph.keyframes import Keyframe, surface_points
from thinmap_ros.core.slam.joining.pieces import RobotKeyframes
from thinmap_ros.core.slam.joining.team import RobotMap, merged
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.other_robots import simulations_in
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World

CELL_M = 0.05
GHOST_M = 2.5 * CELL_M  # from the next wall
CUT_M = 0.38
STARTS = [se2.pose(2.0, 1.5, 0.3), se2.pose(3.6, 2.0, 0.1), se2.pose(3.0, 3.2, -0.2)]
STANDS = 30  # steps of 0.1 s in which all stand where they have started
STEPS = 90


def room():
    """A room of 7 x 5 m with a table."""
    cells = np.zeros((100, 140), dtype=np.uint8)
    cells[:2] = cells[-2:] = 1
    cells[:, :2] = cells[:, -2:] = 1
    cells[70:80, 30:60] = 1
    return World('room', cells, GridFrame(0.0, 0.0, CELL_M), STARTS[0])


class Robot:
    """A robot with a map of its own, whose frame is its start."""

    def __init__(self, simulation, start):
        self.simulation = simulation
        self.start = start
        self.grid = CorrectableGrid(OccupancyGrid(OccupancyConfig()))
        self.frames = []

    @property
    def pose(self):
        return se2.between(self.start, self.simulation.robot.T_world_base)

    def look(self, scan, others):
        scan = replace(scan, robots=tuple(others))
        T = self.pose
        self.grid.update(scan, T)
        if not self.frames or se2.are_apart(self.frames[-1].T_map_base, T, 0.5, 0.5):
            points = surface_points(scan)
            self.frames.append(Keyframe(scan, points, T, 0.0, np.zeros((3, 3)), submap=0))

    def map(self):
        """As a mapper publishes it."""
        patch = self.grid.shown.known_area()
        keyframes = RobotKeyframes(1, self.frames, [])
        return RobotMap(GridPatch(patch.frame, patch.trinary()), None, keyframes)


def explore(count, is_heard, from_step=0):
    """Robots that stand side by side, and drive off one after another; the last ones look on.

    is_heard: whether the mappers hear the others; from_step: at which the last robot begins to map.
    """
    laser = LaserScannerConfig(mixed_pixel_ratio=0.0)
    simulations = simulations_in(room(), STARTS[:count], PRESETS['2dx'], laser, 0)
    robots = [Robot(*each) for each in zip(simulations, STARTS, strict=False)]
    for step in range(STEPS):
        heard = [NearbyRobot(str(k), robot.pose, CUT_M) for k, robot in enumerate(robots)]
        for k, robot in enumerate(robots):
            drives = k > 0 and step >= STANDS * k
            moment = robot.simulation.step(0.4 if drives else 0.0, 0.0)
            others = [each for each in heard if each.name != str(k)] if is_heard else []
            is_there = k < count - 1 or step >= from_step
            for scan in moment.scans if is_there else ():
                robot.look(scan, others)
    return robots


def ghosts(patch, T_world_map):
    """Number of occupied cells of a map where the world is free."""
    world = room()
    walls = se2.transform_points(T_world_map, patch.frame.centres_of(np.argwhere(patch.occupied)))
    away_m = CELL_M * distance_cells(world.occupied.astype(np.bool_))
    rows, cols = world.frame.cells_of(walls).T
    return int((away_m[rows, cols] > GHOST_M).sum())


def joint(robots, order):
    maps = {str(k): robots[k].map() for k in order}
    places = {str(k): STARTS[k] for k in order}
    return merged(maps, places, None).patch


@pytest.mark.parametrize(('count', 'from_step'), [(2, 0), (3, 0), (3, STANDS // 2)])
def test_robots_are_no_walls_in_any_map_once_their_places_are_known(count, from_step):
    robots = explore(count, True, from_step)
    before = [ghosts(robot.grid.shown.known_area(), robot.start) for robot in robots]
    walls = [robot.grid.shown.known_area().occupied.sum() for robot in robots]
    assert max(before) > 5, 'they took each other for walls'
    for k, robot in enumerate(robots):
        places = {str(j): se2.between(robot.start, other.start) for j, other in enumerate(robots)}
        for known in (places, {}, places):  # map_joiner is started again
            robot.grid.place_mates(known)
        patch = robot.grid.shown.known_area()
        assert ghosts(patch, robot.start) == 0
        assert patch.occupied.sum() > 0.95 * (walls[k] - before[k])
    assert ghosts(joint(robots, range(count)), np.zeros(3)) == 0


@pytest.mark.parametrize('order', [(0, 1, 2), (2, 1, 0), (1, 0, 2)])
def test_the_joint_map_shows_no_robots_that_mappers_do_not_hear(order):
    robots = explore(3, False)
    own = [ghosts(robot.grid.shown.known_area(), robot.start) for robot in robots]
    assert sum(own) > 10
    assert ghosts(joint(robots, order), np.zeros(3)) == 0


def test_a_place_that_is_corrected_a_little_renders_nothing_again():
    robot, other = explore(2, True)
    T = se2.between(robot.start, other.start)
    robot.grid.place_mates({'1': T})
    shown = robot.grid.shown.known_area()
    robot.grid.place_mates({'1': T + (0.03, 0.0, 0.005)})
    assert robot.grid.shown.known_area() is shown
    robot.grid.place_mates({'1': T + (0.5, 0.0, 0.0)})
    assert robot.grid.shown.known_area() is not shown
