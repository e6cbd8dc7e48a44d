"""A mission that is saved while it runs, and continued by another process."""

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.mission import (
    Budget,
    DriveTo,
    Finish,
    InputWatchdog,
    Mission,
    MissionGoal,
    MissionState,
    mission_state,
    resumed_mission,
)
from thinmap_ros.core.exploration.strategy import FinishCode
from thinmap_ros.core.se2 import pose

AREA = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 5.0]])
START = pose(1.0, 2.0, 0.5)


class Nothing:
    """A strategy that is not asked for anything here."""


def mission_of(now_s=100.0, state=MissionState.EXPLORING):
    goal = MissionGoal(Budget(300.0, 80.0, 0.0), AREA, return_to_start=True)
    mission = Mission(goal, Nothing(), InputWatchdog(), now_s, state)
    for x in (1.0, 2.0, 3.0):
        mission.odometer.add_pose(pose(x, 2.0, 0.5))
    return mission


def resumed(mission, now_s, saved_s=112.0):
    return resumed_mission(mission_state(mission, saved_s), Nothing(), InputWatchdog(), now_s)


def test_goal_budget_and_progress_are_those_of_before():
    again = resumed(mission_of(), now_s=120.0)
    assert again.goal.budget == Budget(300.0, 80.0, 0.0)
    np.testing.assert_array_equal(again.goal.area, AREA)
    assert again.goal.return_to_start and again.is_running and not again.is_paused
    assert again.elapsed_s(125.0) == 17.0
    assert again.odometer.distance_m == 2.0
    # Meanwhile the robot was driven on.
    again.odometer.add_pose(pose(4.0, 2.0, 0.5))
    again.odometer.add_pose(pose(5.0, 2.0, 0.5))
    assert again.odometer.distance_m == 3.0
    np.testing.assert_array_equal(again.odometer.start, START)


def test_what_the_drives_came_to_is_kept():
    mission = mission_of(state=MissionState.RETURNING)
    mission.end = Finish(FinishCode.UNREACHABLE, 'the robot has not driven', has_explored=False)
    again = resumed(mission, now_s=120.0)
    assert again.end == mission.end and not again.drives.has_settled
    mission.drives.add_result(True, '')
    assert resumed(mission, now_s=120.0).drives.has_settled


def test_the_budget_of_time_counts_what_was_used_before():
    watchdog = InputWatchdog(scan_timeout_s=1000.0)
    state = mission_state(mission_of(), 112.0)
    again = resumed_mission(state, Nothing(), watchdog, 120.0)
    assert again.check(120.0 + 287.0, True) is None
    action = again.check(120.0 + 288.0, True)
    assert isinstance(action, DriveTo) and again.end.code == FinishCode.BUDGET_EXHAUSTED


def test_a_simulated_clock_that_has_not_arrived_yet_does_not_count():
    again = resumed(mission_of(), now_s=0.0)
    assert again.check(500.0, True) is None
    assert again.elapsed_s(510.0) == 22.0


def test_a_robot_that_returns_drives_on_to_its_start_and_ends_for_the_same_reason():
    mission = mission_of(state=MissionState.RETURNING)
    mission.end = Finish(FinishCode.ALL_RESOLVED, 'all 7 of 7 m² reliable')
    again = resumed(mission, now_s=120.0)
    action = again.check(121.0, is_driving=False)
    assert isinstance(action, DriveTo)
    np.testing.assert_array_equal(action.goal, START)
    assert again.drive_ended(True, '') == mission.end


def test_a_mission_that_is_paused_or_has_ended_stays_so():
    mission = mission_of()
    mission.is_paused = True
    assert resumed(mission, 120.0).is_paused
    mission.cancel('cancelled')
    again = resumed(mission, 120.0)
    assert not again.is_running
    assert again.end == Finish(FinishCode.CANCELLED, 'cancelled')
    assert again.is_resumed_by(MissionGoal(area=AREA))


def test_a_mission_before_its_first_pose_has_no_start():
    mission = Mission(MissionGoal(), Nothing(), InputWatchdog(), 100.0)
    assert resumed(mission, 120.0).odometer.start is None


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('phase', np.array(4)),
        ('end_code', np.array(-1)),
        ('elapsed_s', np.array(np.nan)),
        ('budget', np.array([np.inf, 0.0, 0.0])),
        ('area', np.zeros((2, 3))),
        ('end_reason', np.zeros(3)),
        ('unknown', np.array(0)),
    ],
)
def test_what_is_no_state_of_a_mission_is_refused(name, value):
    state = {**mission_state(mission_of(), 112.0), name: value}
    with pytest.raises(InputError, match=f'saved mission: .*{name}'):
        resumed_mission(state, Nothing(), InputWatchdog(), 120.0)
