"""The closed loop treats a strategy as the node does."""

import math
from dataclasses import replace

import numpy as np
import pytest

from thinmap_ros.closed_loop.loop import make_loop
from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.core.exploration.strategy import Decision, EndNode, FinishCode
from thinmap_ros.core.grid.edits import KeepOut, inside
from thinmap_ros.core.planning.navigator import NavigatorConfig
from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.coverage import observable_cells
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import LASERS, PRESETS
from thinmap_ros.sim.world import World

NODE = EndNode(1, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, True, np.zeros(3))


class Repeats:
    """A strategy that does not see that the robot is there; it ends after a failure."""

    def __init__(self, goal):
        self.goal = goal
        self.failures = []

    def step(self, topology, patch, scan, T_map_base):
        is_over = bool(self.failures)
        target = None if is_over else NODE._replace(goal=self.goal)
        code = FinishCode.UNREACHABLE if is_over else FinishCode.NONE
        return Decision(target, is_over, '', code, [], [], 0.0)

    def target_failed(self, reason):
        self.failures.append(reason)


def test_a_target_that_stays_although_it_was_reached_has_failed():
    world = World.from_patch(*read_world(package_data.world_path('room_10x10')))
    start = np.asarray(world.start)
    strategy = Repeats(start + (0.8, 0.0, 0.0))
    loop = make_loop(world, [start], Options(speed_m_s=0.5))
    loop.robots[0].mission.strategy = strategy
    goal = observable_cells(world, start, 0.25, 8.0)
    outcome = loop.run(goal, 60.0, lambda seconds, coverage: None)
    assert outcome.finished
    assert strategy.failures == ['reached, but the target stays']


def explored(beams, limit_s):
    """Outcome and path length (m) of an exploration with a laser of a number of beams."""
    world = World.from_patch(*read_world(package_data.world_path('room_10x10')))
    start = np.asarray(world.start)
    laser = LaserScannerConfig(beams=beams, field_of_view_deg=360.0)
    loop = make_loop(world, [start], Options(localization='slam', laser=laser))
    outcome = loop.run(observable_cells(world, start, 0.25, 8.0), limit_s, lambda *shown: None)
    steps = np.diff([pose[:2] for pose in loop.robots[0].log.true_poses], axis=0)
    return outcome, float(np.hypot(*steps.T).sum())


def test_with_too_few_beams_the_robot_stands_still_and_nothing_is_explored():
    outcome, path_m = explored(8, 30.0)
    assert not outcome.finished and path_m == 0.0
    assert '8 valid beams of 8: expected at least 10' in outcome.reason


def test_between_a_few_beams_the_robot_looks_by_turning():
    """At the start, no place between twelve beams is free enough to drive to."""
    _, path_m = explored(12, 100.0)
    assert path_m > 0.5


def test_a_large_robot_with_a_laser_at_two_corners_explores():
    """It starts amid cells that its lasers do not see: those below its body."""
    world = World.from_patch(*read_world(package_data.world_path('office')))
    start = np.asarray(world.start)
    options = Options(robot='mir100', laser=LASERS['mir100'], localization='slam', speed_m_s=0.5)
    loop = make_loop(world, [start], options)
    (robot,) = loop.robots
    frames = []
    step = robot.pipeline.step

    def steps(scan, T_odom_base):
        frames.append(scan.frame)
        return step(scan, T_odom_base)

    robot.pipeline.step = steps
    outcome = loop.run(observable_cells(world, start, 0.6, 8.0), 15.0, lambda *shown: None)
    errors = np.array(robot.log.poses) - np.array(robot.log.true_poses)
    assert outcome.collisions == 0
    assert frames[:4] == 2 * ['front_laser', 'rear_laser']
    assert frames.count('front_laser') == pytest.approx(frames.count('rear_laser'), abs=1)
    assert loop.coverage[-1][1] > 0.7
    assert math.dist(robot.log.true_poses[-1][:2], start[:2]) > 1.0
    assert np.hypot(*errors[:, :2].T).max() < 0.02


def test_a_wide_robot_keeps_away_as_far_as_its_radius():
    """The 3-AT is wider than what paths are planned with by default."""
    world = World.from_patch(*read_world(package_data.world_path('room_10x10')))
    navigators = [
        make_loop(world, [world.start], Options(robot=name)).robots[0].navigator.config
        for name in ('2dx', '3at')
    ]
    assert navigators[0].planner == NavigatorConfig().planner
    assert navigators[0].stop_radius_m == NavigatorConfig().stop_radius_m
    assert PRESETS['3at'].radius_m < navigators[1].stop_radius_m
    assert navigators[1].stop_radius_m < navigators[1].planner.robot_radius_m


def test_an_exploration_that_reaches_nothing_is_not_finished():
    world = World.from_patch(*read_world(package_data.world_path('room_10x10')))
    start = np.asarray(world.start)
    strategy = Repeats(start + (100.0, 0.0, 0.0))
    loop = make_loop(world, [start], Options())
    loop.robots[0].mission.strategy = strategy
    outcome = loop.run(observable_cells(world, start, 0.25, 8.0), 60.0, lambda *shown: None)
    assert strategy.failures and not outcome.finished
    assert outcome.reason == f'no target was reached: {strategy.failures[-1]}'


def test_a_robot_stands_still_once_its_laser_has_slipped():
    """It notices after some metres: in a narrow room a wall may be nearer, whatever it does."""
    slip_s = 20.0
    world = World.from_patch(*read_world(package_data.world_path('warehouse')))
    start = np.asarray(world.start)
    loop = make_loop(world, [start], Options(speed_m_s=0.5, seed=2, localization='slam'))
    (robot,) = loop.robots
    simulation = robot.simulation
    read_sensors = simulation.read_sensors
    path_m = [0.0]

    def read():
        if simulation.stamp_ns >= slip_s * 1e9:
            turned = np.array([0.0, 0.0, math.radians(45.0)])
            simulation.lasers[0].mount = replace(simulation.lasers[0].mount, T_base_laser=turned)
            path_m.append(path_m[-1] + 0.05 * abs(simulation.robot.v))
        moment = read_sensors()
        as_given = (replace(scan, T_base_laser=np.zeros(3)) for scan in moment.scans)
        return replace(moment, scans=tuple(as_given))

    simulation.read_sensors = read
    goal = observable_cells(world, start, 0.25, 8.0)
    outcome = loop.run(goal, 60.0, lambda seconds, coverage: None)
    assert outcome.collisions == 0
    assert path_m[-1] < 8.0
    assert path_m[-1] == path_m[-100], 'it stands in the last seconds'
    assert any('laser turned by' in warning for warning in robot.pipeline.warnings)


def test_an_exploration_does_not_enter_a_keep_out_area():
    """The area is in the middle of the path of an exploration without it."""
    world = World.from_patch(*read_world(package_data.world_path('room_10x10')))
    start = np.asarray(world.start)
    goal = observable_cells(world, start, 0.25, 8.0)

    def path(keep_out):
        loop = make_loop(world, [start], Options(speed_m_s=0.5))
        (robot,) = loop.robots
        decide_on = robot.decide

        def decide(observation, T_map_odom):
            patch = keep_out.laid_on(observation.patch, observation.T_map_base)
            decide_on(observation._replace(patch=patch), T_map_odom)

        robot.decide = decide
        outcome = loop.run(goal, 600.0, lambda seconds, coverage: None)
        assert outcome.finished, outcome.reason
        return np.array(robot.log.true_poses)[:, :2]

    free = path(KeepOut())
    middle = free[np.hypot(*(free - start[:2]).T).argmax() // 2]
    square = middle + 0.5 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    assert inside(free, square).any() and not inside(start[None, :2], square).any()
    around = path(KeepOut().with_area(square, is_wall=False))
    assert not inside(around, square).any()
