"""Progress of drives, repeated arrivals, and goals at a server that answers late or refuses."""

import math
from dataclasses import replace

import numpy as np

from thinmap_ros.core.exploration.mission import DriveProgress, DriveRequest, Drives, Retries
from thinmap_ros.core.exploration.strategy import unobserved
from thinmap_ros.core.se2 import pose

GOAL = pose(10.0, 0.0, 0.0)


def test_a_robot_that_comes_nearer_makes_progress_and_one_that_oscillates_does_not():
    progress = DriveProgress(GOAL)
    for second in range(20):
        progress.update(pose(0.2 * second, 0.0, 0.0), None, float(second))
    assert progress.idle_s == 0.0
    for second in range(20, 50):
        progress.update(pose(3.8 - (second % 3), 0.0, 0.0), None, float(second))
    assert progress.idle_s == 30.0


def test_on_a_way_round_an_obstacle_the_remaining_path_counts():
    progress = DriveProgress(GOAL)
    for second in range(60):
        progress.update(pose(-0.2 * second, 0.0, 0.0), 40.0 - 0.2 * second, float(second))
    assert progress.idle_s == 0.0
    for second in range(60, 101):
        progress.update(pose(-12.0, 0.0, 0.0), 28.0, float(second))
    assert progress.idle_s == 40.0


def test_a_detour_is_measured_anew_but_not_again_and_again():
    progress = DriveProgress(GOAL)
    now_s = 0.0
    longer_m = []
    for detour in range(10):
        for remaining_m in np.arange(5.0 + detour, 3.0 + detour, -0.2):
            now_s += 1.0
            if progress.update(pose(-1.0, 0.0, 0.0), float(remaining_m), now_s):
                longer_m.append(float(remaining_m))
    assert progress.idle_s == 60.0
    assert longer_m == [6.0, 7.0, 8.0]


def test_missing_inputs_are_no_standstill():
    progress = DriveProgress(GOAL)
    progress.update(pose(0.0, 0.0, 0.0), None, 0.0)
    progress.update(pose(0.0, 0.0, 0.0), None, 500.0)
    assert progress.idle_s == 10.0
    progress.update(pose(0.0, 0.0, 0.0), None, 400.0)
    assert progress.idle_s == 10.0


class Told:
    """A strategy that keeps why its targets failed."""

    def __init__(self):
        self.failures = []

    def target_failed(self, reason):
        self.failures.append(reason)


def test_arrivals_are_repeated_when_the_goal_stays_the_same():
    target = unobserved(1, (10.0, 0.0), 0.5, GOAL)
    drives = Drives()
    strategy = Told()
    for _ in range(5):
        assert drives.follow(target, strategy) is GOAL
        drives.add_result(True, '')
    moved = target._replace(goal=pose(10.05, 0.0, 0.1))
    assert drives.follow(moved, strategy) is moved.goal
    drives.add_result(True, '')
    other = target._replace(goal=pose(9.0, 0.0, 0.0))
    assert replace(drives).follow(other, strategy) is other.goal
    assert replace(drives).follow(None, strategy) is None
    assert not strategy.failures
    assert drives.follow(target, strategy) is None
    assert strategy.failures == [drives.failure] == ['reached, but the target stays']
    assert drives.follow(target, strategy) is GOAL


def test_a_goal_is_sent_again_when_it_changes():
    request = DriveRequest(pose(1.0, 1.0, math.pi - 0.05), 100.0)
    assert request.is_same(pose(1.05, 1.05, -math.pi + 0.1))
    assert not request.is_same(pose(1.2, 1.0, math.pi))
    assert not request.is_same(pose(1.0, 1.0, math.pi - 0.3))


def test_a_server_is_silent_when_its_feedback_ends_and_not_when_it_has_none():
    request = DriveRequest(GOAL, 100.0, is_accepted=True)
    assert not request.is_silent(1000.0)
    request.add_feedback(4.0, 200.0)
    assert request.remaining_m == 4.0
    assert not request.is_silent(202.9)
    assert request.is_silent(203.0)
    request.add_feedback(0.0, 204.0)
    assert request.remaining_m is None
    assert not request.is_silent(206.9)


def test_only_a_goal_without_response_is_unanswered():
    request = DriveRequest(GOAL, 100.0, answer_timeout_s=5.0)
    assert not request.is_unanswered(104.9)
    assert request.is_unanswered(105.0)
    request.is_accepted = True
    assert not request.is_unanswered(105.0)


def test_a_server_has_more_and_more_time_for_its_answer_until_the_goal_is_given_up():
    retries = Retries()
    timeouts = []
    given_up = []
    for _ in range(4):
        timeouts.append(retries.answer_timeout_s)
        given_up.append(retries.add_unanswered())
    assert timeouts == [5.0, 10.0, 20.0, 20.0]
    assert given_up == [False, False, True, True]
    retries.add_accepted()
    assert retries.answer_timeout_s == 5.0


def test_a_rejected_goal_is_sent_again_after_a_pause_and_given_up_after_five_times():
    retries = Retries()
    assert retries.may_send(0.0)
    for times in range(1, 11):
        assert retries.add_rejected(10.0 * times) == (times in (5, 10))
        assert not retries.may_send(10.0 * times + 1.9)
        assert retries.may_send(10.0 * times + 2.0)
    # The clock was set back.
    assert retries.may_send(1.0)
