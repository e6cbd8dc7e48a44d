"""Missions: budgets, distance, area, return to the start, timeouts of inputs."""

import math

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
    Odometer,
)
from thinmap_ros.core.exploration.strategy import Decision, EndNode, FinishCode, Observation
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import pose
from thinmap_ros.core.topology.graph import TopologicalMap

SQUARE = np.array([[1.0, 1.0], [3.0, 1.0], [3.0, 3.0], [1.0, 3.0]])


def test_noise_at_a_standstill_is_no_distance_but_a_slow_robot_gets_on():
    odometer = Odometer()
    rng = np.random.default_rng(1)
    for _ in range(500):
        odometer.add_pose(np.append(rng.normal(0.0, 0.002, 2), 0.0))
    assert odometer.distance_m == 0.0
    for x in np.arange(0.0, 2.0, 0.005):
        odometer.add_pose(np.array([x, 0.0, 0.0]))
    assert odometer.distance_m == pytest.approx(2.0, abs=0.05)


def test_the_start_is_the_first_pose():
    odometer = Odometer()
    assert odometer.start is None
    odometer.add_pose(np.array([1.0, 2.0, 0.5]))
    odometer.add_pose(np.array([2.0, 2.0, 0.5]))
    assert odometer.start is not None
    assert odometer.start.tolist() == [1.0, 2.0, 0.5]


@pytest.mark.parametrize(
    ('used', 'word'),
    [
        ((9.0, 4.0, 19.0), ''),
        ((10.0, 0.0, 0.0), 'time'),
        ((0.0, 5.0, 0.0), 'distance'),
        ((0.0, 0.0, 21.0), 'area'),
    ],
)
def test_each_limit_ends_it_and_says_which(used, word):
    reason = Budget(10.0, 5.0, 20.0).exhausted_by(*used)
    assert (reason == '') if not word else reason.startswith(word)


def test_without_limits_nothing_is_ever_used_up():
    assert Budget().exhausted_by(1e9, 1e9, 1e9) == ''


class Scripted:
    """A strategy with decisions set by the test; it stores its inputs."""

    def __init__(self, goal=None, code=FinishCode.NONE, area_m2=0.0):
        self.goal = goal
        self.code = code
        self.area_m2 = area_m2
        self.patch = None
        self.failures = []
        self.target_id = 1

    def step(self, topology, patch, scan, T_map_base):
        self.patch = patch
        target = None
        if self.goal is not None:
            target = EndNode(
                self.target_id, 0.0, 0.0, 0.5, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, True, self.goal
            )
        finished = self.code != FinishCode.NONE
        return Decision(target, finished, 'words', self.code, [], [], self.area_m2)

    def target_failed(self, reason):
        self.failures.append(reason)


PATCH = GridPatch(GridFrame(0.0, 0.0, 0.1), np.zeros((40, 40), dtype=np.int8))
SCAN = Scan.create(0, np.full(181, 2.0), -math.pi / 2, math.pi / 180, 0.05, 8.0)
GOAL = pose(3.0, 3.0, 0.0)


def at(x, y=0.0):
    return Observation(TopologicalMap({}, {}), PATCH, SCAN, pose(x, y, 0.0))


def mission_of(strategy, now_s=0.0, watchdog=None, **goal):
    return Mission(MissionGoal(**goal), strategy, watchdog or InputWatchdog(), now_s)


def test_a_mission_drives_where_the_strategy_decides_and_ends_with_it():
    strategy = Scripted()
    mission = mission_of(strategy)
    assert mission.step(at(0.0)) is None
    strategy.goal = GOAL
    assert mission.step(at(0.0)) == DriveTo(GOAL)
    assert mission.drive_ended(True, '') is None
    assert mission.drive_ended(False, 'a closed door') is None
    assert strategy.failures == ['a closed door']
    strategy.code = FinishCode.ALL_RESOLVED
    end = mission.step(at(0.0))
    assert end == Finish(FinishCode.ALL_RESOLVED, 'words')
    assert end.is_success
    assert mission.state == MissionState.FINISHED


def test_nothing_left_to_do_is_not_nothing_could_be_done():
    for code, places, succeeds in (
        (FinishCode.ALL_RESOLVED, [0.0], True),  # a closet that is seen from the start
        (FinishCode.UNREACHABLE, [0.0], False),
        (FinishCode.UNREACHABLE, [0.0, 0.1, 0.0], False),  # turns in place, not quite
        (FinishCode.UNREACHABLE, [0.0, 0.5, 0.0], True),
    ):
        strategy = Scripted()
        mission = mission_of(strategy)
        for x in places:
            assert mission.step(at(x)) is None
        strategy.code = code
        end = mission.step(at(0.0))
        assert (end.code, end.is_success) == (code, succeeds)
        assert end.reason == ('words' if succeeds else 'words; the robot has not driven')


@pytest.mark.parametrize(
    ('results', 'succeeds'),
    [
        ([False], False),
        ([False, False], False),
        ([True], True),
        ([True, False], True),  # a closed door, after a room
        ([None, False], True),  # the first target was seen on the way
    ],
)
def test_a_navigator_that_reaches_no_target_has_explored_nothing(results, succeeds):
    strategy = Scripted(GOAL)
    mission = mission_of(strategy)
    for number, result in enumerate(results):
        strategy.target_id = number
        mission.step(at(float(number)))
        if result is not None:
            mission.drive_ended(result, '' if result else 'the wheels are chained')
    strategy.goal = None
    strategy.code = FinishCode.UNREACHABLE
    end = mission.step(at(3.0))
    assert (end.code, end.is_success) == (FinishCode.UNREACHABLE, succeeds)
    failure = 'words; no target was reached: the wheels are chained'
    assert end.reason == ('words' if succeeds else failure)
    assert mission.is_resumed_by(MissionGoal()) is False, 'the next one tries all again'


@pytest.mark.parametrize(
    ('limit', 'now_s', 'words'),
    [
        (Budget(time_s=20.0), 120.0, 'time limit of 20 s'),
        (Budget(distance_m=2.0), 101.0, 'distance limit of 2.0 m'),
        (Budget(area_m2=30.0), 101.0, 'area limit of 30.0 m^2'),
    ],
)
def test_each_budget_ends_a_mission_as_a_success(limit, now_s, words):
    strategy = Scripted(GOAL)
    watchdog = InputWatchdog()
    mission = mission_of(strategy, 100.0, watchdog, budget=limit)
    mission.step(at(0.0))
    watchdog.add_scan(now_s - 1.0)
    assert mission.check(now_s - 1.0, True) is None
    strategy.area_m2 = 30.0
    mission.step(at(2.0))
    end = mission.check(now_s, True)
    assert end == Finish(FinishCode.BUDGET_EXHAUSTED, words)
    assert end.is_success
    assert mission.elapsed_s(now_s) == now_s - 100.0


def returning_mission():
    strategy = Scripted(code=FinishCode.UNREACHABLE)
    mission = mission_of(strategy, return_to_start=True, budget=Budget(time_s=1.0))
    mission.odometer.add_pose(pose(1.0, 2.0, 0.5))
    action = mission.step(at(3.0))
    assert isinstance(action, DriveTo)
    assert action.goal.tolist() == [1.0, 2.0, 0.5]
    assert mission.state == MissionState.RETURNING
    return mission


def test_a_mission_returns_to_its_start_and_ends_with_the_reason_why_exploring_ended():
    mission = returning_mission()
    assert mission.step(at(2.0)) is None
    assert mission.odometer.distance_m > 3.0
    # Budgets do not prevent the return.
    assert mission.check(2.0, True) is None
    assert mission.drive_ended(True, '') == Finish(FinishCode.UNREACHABLE, 'words')
    assert mission.state == MissionState.FINISHED


def test_the_return_is_tried_three_times():
    mission = returning_mission()
    assert isinstance(mission.drive_ended(False, 'no path'), DriveTo)
    assert isinstance(mission.drive_ended(False, 'no path'), DriveTo)
    end = mission.drive_ended(False, 'a closed door')
    words = 'words; not home: a closed door'
    assert end == Finish(FinishCode.UNREACHABLE, words, is_home=False)
    assert end.is_explored and not end.is_success
    assert not mission.strategy.failures


def test_a_navigator_that_lost_the_goal_is_sent_to_the_start_again():
    mission = returning_mission()
    assert mission.check(1.0, True) is None
    assert isinstance(mission.check(2.0, False), DriveTo)
    # This is not a failure.
    assert isinstance(mission.drive_ended(False, 'no path'), DriveTo)
    assert isinstance(mission.drive_ended(False, 'no path'), DriveTo)


def test_a_budget_that_ends_before_the_first_pose_returns_nowhere():
    mission = mission_of(Scripted(), now_s=1.0, budget=Budget(time_s=1.0), return_to_start=True)
    assert mission.check(2.0, False) == Finish(FinishCode.BUDGET_EXHAUSTED, 'time limit of 1 s')


def test_scans_that_stay_away_end_a_mission():
    watchdog = InputWatchdog()
    mission = mission_of(Scripted(GOAL), 100.0, watchdog)
    assert mission.check(160.0, True) is None
    watchdog.add_scan(150.0)
    assert mission.check(210.0, True) is None
    end = mission.check(210.1, True)
    assert end == Finish(FinishCode.SENSOR_TIMEOUT, 'no scan that shows anything for 60 s')
    assert not end.is_success


def test_a_pose_that_stays_lost_ends_a_mission_and_a_silent_localizer_does_not():
    watchdog = InputWatchdog()
    mission = mission_of(Scripted(GOAL), 0.0, watchdog)
    watchdog.add_tracking(False, 1.0)
    assert mission.check(50.0, True) is None
    for now_s in (50.0, 55.0, 60.0):
        watchdog.add_scan(now_s)
        watchdog.add_tracking(True, now_s)
        assert mission.check(now_s, True) is None
    end = mission.check(60.1, True)
    assert end == Finish(FinishCode.LOCALIZATION_LOST, 'the pose has been lost for 10 s')
    assert not end.is_success


def test_a_pose_that_was_found_again_starts_the_timeout_afresh():
    watchdog = InputWatchdog()
    mission = mission_of(Scripted(GOAL), 0.0, watchdog)
    for is_lost, now_s in ((True, 5.0), (False, 14.0), (True, 16.0)):
        watchdog.add_tracking(is_lost, now_s)
        assert mission.check(now_s, True) is None
    assert mission.check(26.0, True) is None
    assert mission.check(26.1, True) is not None


def test_the_next_mission_starts_its_timeouts_afresh():
    watchdog = InputWatchdog()
    watchdog.add_tracking(True, 0.0)
    mission = mission_of(Scripted(GOAL), 100.0, watchdog)
    assert mission.check(110.0, True) is None
    assert mission.check(110.1, True) is not None


def test_the_strategy_sees_walls_outside_the_area():
    strategy = Scripted()
    mission_of(strategy, area=SQUARE).step(at(2.0, 2.0))
    assert (strategy.patch.cells[10:30, 10:30] == 0).all()
    assert (strategy.patch.cells[:, :10] == 100).all()
    mission_of(strategy, area=SQUARE[:2]).step(at(2.0, 2.0))
    assert strategy.patch is PATCH


def test_only_an_interrupted_mission_of_the_same_area_is_resumed():
    for code in (FinishCode.NONE, FinishCode.ALL_RESOLVED, FinishCode.UNREACHABLE):
        mission = mission_of(Scripted(code=code), area=SQUARE)
        mission.step(at(2.0, 2.0))
        assert mission.is_resumed_by(MissionGoal(area=SQUARE)) == (code == FinishCode.NONE)
        assert not mission.is_resumed_by(MissionGoal())
    mission = mission_of(Scripted(GOAL), area=SQUARE)
    mission.cancel('cancelled')
    assert mission.is_resumed_by(MissionGoal(Budget(time_s=5.0), SQUARE, True))


@pytest.mark.parametrize('wrong', [math.nan, math.inf, 1e30])
def test_goals_with_numbers_that_are_none_are_refused(wrong):
    for budget in (Budget(time_s=wrong), Budget(distance_m=wrong), Budget(area_m2=wrong)):
        with pytest.raises(InputError, match='goal: limit or corner of the area'):
            MissionGoal(budget)
    with pytest.raises(InputError, match='goal: limit or corner of the area'):
        MissionGoal(area=np.array([[0.0, 0.0], [1.0, wrong], [0.0, 1.0]]))


def test_while_it_is_paused_nothing_is_decided_and_no_timeout_runs():
    mission = mission_of(Scripted(GOAL))
    mission.is_paused = True
    assert mission.step(at(0.0)) is None
    assert mission.decision is None
    assert mission.check(1e6, False) is None
    mission.is_paused = False
    assert mission.check(1e6 + 59.0, False) is None
    assert mission.step(at(0.0)) == DriveTo(GOAL)


def test_a_paused_mission_can_be_cancelled():
    mission = mission_of(Scripted(GOAL))
    mission.is_paused = True
    end = mission.cancel('cancelled')
    assert end == Finish(FinishCode.CANCELLED, 'cancelled')
    assert not end.is_success
    assert not mission.is_running


def test_what_is_missing_is_named_when_a_mission_ends_for_want_of_it():
    watchdog = InputWatchdog()
    mission = mission_of(Scripted(GOAL), now_s=1.0, watchdog=watchdog)
    watchdog.awaited = 'map on map'
    end = mission.check(61.1, False)
    assert end == Finish(FinishCode.SENSOR_TIMEOUT, 'no map on map for 60 s')


def test_it_is_known_whether_the_robot_is_back_at_its_start():
    mission = returning_mission()
    assert mission.is_running
    assert not mission.has_returned
    mission.drive_ended(True, '')
    assert not mission.is_running
    assert mission.has_returned


def test_the_time_begins_with_a_simulated_clock_that_stands_at_zero_before():
    mission = mission_of(Scripted(), budget=Budget(time_s=30.0))
    assert mission.check(500.0, is_driving=False) is None
    assert mission.elapsed_s(510.0) == 10.0
    assert mission.check(529.0, is_driving=False) is None
    end = mission.check(530.0, is_driving=False)
    assert isinstance(end, Finish) and end.code == FinishCode.BUDGET_EXHAUSTED
