"""Active localization: drives to where the hypotheses differ, faster than a random drive."""

import itertools

import numpy as np
import pytest
from support.small_floor import floor, map_of, world_of

from thinmap_ros.core import se2
from thinmap_ros.core.places.active_search import (
    ActiveSearch,
    best_viewpoint,
    common_patch,
)
from thinmap_ros.core.places.global_localizer import (
    GlobalLocalization,
    PoseHypothesis,
    Result,
    SearchState,
)
from thinmap_ros.core.places.place_database import GlobalLocalizationConfig, Places
from thinmap_ros.core.places.wall_field import FREE
from thinmap_ros.core.planning.navigator import NavigatorConfig
from thinmap_ros.core.planning.path_follower import PathFollowerConfig
from thinmap_ros.core.planning.wavefront import WavefrontConfig
from thinmap_ros.sim.drives import random_drive
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig
from thinmap_ros.sim.robot import RobotConfig
from thinmap_ros.sim.simulation import STEP_NS, Simulation

# Two identical rooms, and the corridor at their doors, which continues to one side.
_ROOM = ((0, 0, 70, 2), (70, 0, 72, 46), (70, 56, 72, 60), (20, 18, 34, 30), (50, 35, 53, 45))
TWINS = floor(
    *((r, c + left, e, d + left) for left in (0, 60) for r, c, e, d in _ROOM), rows=86, cols=135
)
TWINS[:72, 120:] = 100
STARTS = [(0.2, 3.0, 1.2), (3.5, 4.5, -2.0), (6.2, 3.2, 2.5), (10.0, 7.5, -1.0)]
LIMIT_S = 90.0
CONFIG = GlobalLocalizationConfig()


@pytest.fixture(scope='module')
def finder():
    return GlobalLocalization(*map_of(TWINS), seed=3)


def is_right(found, T):
    off = se2.between(T, found.T_map_base)
    return np.hypot(off[0], off[1]) < 0.3 and abs(off[2]) < np.radians(10.0)


def seconds_driven_by_itself(finder, start, seed):
    """Time until localized, and the travelled path; without contact with a wall."""
    finder.restart()
    simulation = Simulation(
        world_of(TWINS), se2.pose(*start), RobotConfig(), LaserScannerConfig(), seed
    )
    # As the random drives.
    search = ActiveSearch(
        finder.places,
        finder.config,
        NavigatorConfig(controller=PathFollowerConfig(max_speed_m_s=0.5)),
    )
    moment = simulation.read_sensors()
    scan = None
    for k in itertools.count():
        for scan in moment.scans:
            result = finder.step(scan, moment.T_odom_base)
            search.take(result, moment.T_odom_base)
            if result.pose is not None:
                assert is_right(result.pose, simulation.robot.T_world_base)
                return k * STEP_NS / 1e9
        if k * STEP_NS / 1e9 > LIMIT_S:
            return LIMIT_S
        command = search.step(moment.T_odom_base, scan, STEP_NS / 1e9)
        moment = simulation.step(command.v, command.w)
        assert not simulation.robot.collisions


def seconds_roaming(finder, start, seed):
    finder.restart()
    for look in random_drive(world_of(TWINS), se2.pose(*start), seed):
        seconds = look.scan.stamp_ns / 1e9
        if seconds > LIMIT_S or finder.step(look.scan, look.T_odom_base).pose is not None:
            return min(seconds, LIMIT_S)
    raise AssertionError


@pytest.mark.cpu_budget(25.0, 'drives by two strategies from many starts')
def test_a_robot_that_drives_where_places_differ_is_sure_sooner_than_one_that_roams(finder):
    itself = [seconds_driven_by_itself(finder, start, seed) for seed, start in enumerate(STARTS)]
    roaming = [seconds_roaming(finder, start, seed) for seed in range(3) for start in STARTS]
    assert max(itself) < LIMIT_S
    assert np.mean(itself) < np.mean(roaming), (itself, roaming)


def in_both_rooms(*start):
    """The same pose in both identical rooms, as T_map_odom for an odometry pose of zero."""
    return np.array([se2.pose(*start), se2.pose(start[0] + 6.0, *start[1:])])


def test_the_viewpoint_is_where_the_views_differ_and_in_reach_for_all_places(finder):
    starts = in_both_rooms(*STARTS[0])
    odometry = se2.pose(4.0, -1.0, 0.4)  # the same pose in either room
    starts_there = np.array([se2.compose(T, se2.invert(odometry)) for T in starts])
    half = np.array([0.5, 0.5])
    view = best_viewpoint(finder.places, odometry, starts_there, half, 15.0, WavefrontConfig())
    assert view.gain > 0.5
    for T in starts_there:
        x, y = se2.transform_points(T, view.T_odom_view[None, :2])[0]
        row, col = finder.places.frame.cells_of(np.array([[x, y]]))[0]
        assert finder.places.states[row, col] == FREE
        assert y > 2.0 + 6.0  # near the doors, far from the centre of the rooms


def everywhere(step_m=0.4):
    """Odometry poses all over a room, with observations to all sides."""
    x, y = np.meshgrid(np.arange(-7.0, 7.0, step_m), np.arange(-9.0, 9.0, step_m))
    turns = np.arange(-3.0, 3.2, 0.7)
    at = np.repeat(np.column_stack([x.ravel(), y.ravel()]), len(turns), axis=0)
    return np.column_stack([at, np.tile(turns, x.size)])


def test_where_nothing_tells_places_apart_the_robot_goes_on_and_stands_when_all_is_seen():
    shut = TWINS.copy()
    shut[70:72] = 100
    places = Places.of(*map_of(shut), CONFIG)
    starts = in_both_rooms(*STARTS[0])
    half = np.array([0.5, 0.5])
    driving = NavigatorConfig()
    view = best_viewpoint(places, np.zeros(3), starts, half, 15.0, driving.planner)
    assert view.gain == 0.0
    assert np.hypot(*view.T_odom_view[:2]) > 2.0
    seen = everywhere()
    assert best_viewpoint(places, np.zeros(3), starts, half, 15.0, driving.planner, seen) is None
    ahead = seen[np.abs(se2.wrap(seen[:, 2])) < 1.5]
    assert (
        best_viewpoint(places, np.zeros(3), starts, half, 15.0, driving.planner, ahead) is not None
    )
    search = ActiveSearch(places, CONFIG, driving)
    for T in seen:
        search.take(Result(SearchState.AMBIGUOUS, '', ()), T)
    search.take(
        Result(
            SearchState.AMBIGUOUS, '', tuple(PoseHypothesis(T, np.eye(3), 0.5, 1.0) for T in starts)
        ),
        np.zeros(3),
    )
    scan = LaserScanner(LaserScannerConfig(), 0).scan(world_of(shut), starts[0], 0)
    command = search.step(np.zeros(3), scan, 0.1)
    assert (command.v, command.w, command.state) == (0.0, 0.0, 'idle')


def test_what_is_beside_a_place_by_little_neither_closes_its_way_nor_is_told_apart(finder):
    starts = in_both_rooms(*STARTS[0])
    beside = np.array([se2.compose(T, se2.pose(0.4, 0.2, 0.1)) for T in starts])
    weights = np.array([0.3, 0.3, 0.2, 0.2])
    one = best_viewpoint(finder.places, np.zeros(3), starts, weights[:2], 15.0, WavefrontConfig())
    four = best_viewpoint(
        finder.places,
        np.zeros(3),
        np.concatenate([starts, beside]),
        weights,
        15.0,
        WavefrontConfig(),
    )
    assert np.array_equal(one.T_odom_view, four.T_odom_view)


def test_where_all_but_the_own_place_has_been_looked_from_a_turn_there_is_new(finder):
    # In front of its room's door, facing away from the corridor, which continues to one side.
    starts = np.array([[3.5, 9.9, -np.pi / 2.0], [9.5, 9.9, -np.pi / 2.0]])
    seen = everywhere()
    seen = np.concatenate([seen[np.hypot(seen[:, 0], seen[:, 1]) > 0.85], np.zeros((1, 3))])
    view = best_viewpoint(
        finder.places, np.zeros(3), starts, np.array([0.5, 0.5]), 15.0, WavefrontConfig(), seen
    )
    assert view.gain > 0.0
    assert np.hypot(*view.T_odom_view[:2]) < 0.6
    assert abs(view.T_odom_view[2]) > 0.8


def test_of_what_places_have_in_common_nothing_is_lost(finder):
    T = se2.pose(*STARTS[0])
    patch = common_patch(finder.places, np.zeros(3), T[None])
    at = patch.frame.centres_of(np.argwhere(np.ones(patch.shape, dtype=bool))[::17])
    cells = finder.places.frame.cells_of(se2.transform_points(T, at))
    inside = ((cells >= 0) & (cells < finder.places.states.shape)).all(axis=1)
    states = finder.places.states[cells[inside, 0], cells[inside, 1]]
    own = patch.frame.cells_of(at)
    assert np.array_equal(patch.free[own[inside, 0], own[inside, 1]], states == FREE)
    assert not patch.free[own[~inside, 0], own[~inside, 1]].any()
    both = common_patch(finder.places, np.zeros(3), np.array([T, se2.pose(5.5, 3.0, 0.3)]))
    assert not (both.free & ~patch.free).any()
