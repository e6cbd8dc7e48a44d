"""Travel times: those of the planner's paths, with turns at both ends and a stop."""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.path_follower import SpeedConfig
from thinmap_ros.core.planning.travel_times import TravelTimes
from thinmap_ros.core.planning.wavefront import WavefrontConfig, find_path

FRAME = GridFrame(0.0, 0.0, 0.1)
SPEEDS = SpeedConfig(max_speed_m_s=0.5, max_angular_speed_rad_s=1.0, max_acceleration_m_s2=0.4)
STOP_S = 1.25


def travel_in(free, at, trail=(), planner=None):
    """Times from a pose in a map whose cells are free, else occupied."""
    travel = TravelTimes(planner or WavefrontConfig(), SPEEDS)
    for pose in trail:
        travel.add_pose(pose)
    travel.update(free, free.copy(), FRAME, at)
    return travel


def hall():
    free = np.zeros((80, 80), dtype=np.bool_)
    free[1:79, 1:79] = True
    return free


def seconds_to(travel, x, y, theta=0.0):
    return float(travel.seconds_to(np.array([[x, y, theta]]))[0])


def test_a_straight_drive_takes_its_length_and_a_stop():
    travel = travel_in(hall(), se2.pose(2.0, 4.0, 0.0))
    assert seconds_to(travel, 6.0, 4.0) == pytest.approx(4.0 / 0.5 + STOP_S, abs=0.3)


def test_turns_at_both_ends_cost_time():
    straight_s = seconds_to(travel_in(hall(), se2.pose(2.0, 4.0, 0.0)), 6.0, 4.0)
    away = travel_in(hall(), se2.pose(2.0, 4.0, math.pi))
    assert seconds_to(away, 6.0, 4.0) == pytest.approx(straight_s + math.pi, abs=0.1)
    assert seconds_to(away, 6.0, 4.0, 1.0) == pytest.approx(straight_s + math.pi + 1.0, abs=0.1)


def test_the_first_turn_is_to_the_path_and_not_to_the_goal():
    """A wall before the robot: the path to the place behind it begins to the left."""
    free = hall()
    free[10:79, 40] = False
    towards_path = travel_in(free, se2.pose(3.5, 1.5, -0.5 * math.pi))
    towards_goal = travel_in(free, se2.pose(3.5, 1.5, 0.0))
    behind = (4.6, 2.5)
    assert seconds_to(towards_path, *behind) < seconds_to(towards_goal, *behind)


def test_a_robot_turns_where_it_stands():
    travel = travel_in(hall(), se2.pose(2.0, 4.0, 0.0))
    assert seconds_to(travel, 2.0, 4.0, 1.0) == pytest.approx(1.0 + STOP_S)


def test_a_leaf_one_cell_thick_that_has_closed_is_no_passage():
    free = np.zeros((80, 80), dtype=np.bool_)
    free[5:75, 5:39] = True
    free[5:75, 40:75] = True
    free[68:74, 39] = True  # a second door, far away
    free[35:43, 39] = True
    driven = [se2.pose(x, 3.95, 0.0) for x in np.arange(2.0, 4.7, 0.03)]
    here = driven[-1]
    open_s = seconds_to(travel_in(free, here, driven), 3.2, 3.95, math.pi)
    free[35:43, 39] = False
    closed_s = seconds_to(travel_in(free, here, driven), 3.2, 3.95, math.pi)
    assert open_s < 10.0
    assert closed_s > 14.0


def test_they_are_those_of_the_paths_that_the_planner_finds():
    rng = np.random.default_rng(4)
    free = hall()
    for row, col in rng.integers(5, 70, (12, 2)).tolist():
        free[row : row + 6, col : col + 6] = False
    free[5:12, 5:12] = True
    at = se2.pose(0.85, 0.85, 0.0)
    travel = travel_in(free, at)
    patch = GridPatch(FRAME, np.where(free, 0, 100).astype(np.int8))
    ratios = []
    for row, col in np.argwhere(travel.reachable)[::97].tolist():
        x, y = FRAME.centres_of(np.array([[row, col]]))[0].tolist()
        found = find_path(patch, (0.85, 0.85), (x, y), WavefrontConfig())
        assert found is not None
        if found.cost_m > 1.5:
            ratios.append(travel.seconds[row, col] * SPEEDS.max_speed_m_s / found.cost_m)
    assert len(ratios) > 20
    assert 0.85 < min(ratios) <= max(ratios) < 1.2


def test_a_place_without_a_path_is_never_reached():
    free = hall()
    free[:, 40] = False
    travel = travel_in(free, se2.pose(2.0, 4.0, 0.0))
    assert seconds_to(travel, 6.0, 4.0) == math.inf
    assert seconds_to(travel, -6.0, 400.0) == math.inf
    assert not travel.reachable[40, 60] and travel.traversable[40, 60]


def test_another_robot_drives_from_where_it_is():
    free = hall()
    travel = travel_in(free, se2.pose(2.0, 4.0, 0.0))
    goals = np.array([[7.0, 4.0, 0.0], [-9.0, 4.0, 0.0]])
    near_s, outside_s = travel.seconds_from(se2.pose(6.0, 4.0, 0.0), goals)
    assert near_s == pytest.approx(2.0, abs=0.3)
    assert outside_s == pytest.approx(30.0)


def test_a_robot_outside_the_map_reaches_nothing():
    travel = travel_in(hall(), se2.pose(-5.0, 4.0, 0.0))
    assert not travel.reachable.any()


def test_a_faster_robot_is_there_sooner():
    slow = TravelTimes(WavefrontConfig(), SpeedConfig(max_speed_m_s=0.2))
    slow.update(hall(), hall(), FRAME, se2.pose(2.0, 4.0, 0.0))
    fast = travel_in(hall(), se2.pose(2.0, 4.0, 0.0))
    assert seconds_to(slow, 6.0, 4.0) > 2.0 * seconds_to(fast, 6.0, 4.0)
