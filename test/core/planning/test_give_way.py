"""Who must stop when two robots meet."""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.navigator import Navigator
from thinmap_ros.core.planning.path_follower import (
    HeardMotion,
    Motion,
    as_heard,
    moved_on,
    must_stop,
)

HALL = GridPatch(GridFrame(0.0, 0.0, 0.1), np.zeros((60, 60), dtype=np.int8))


def at(robot, x, y, heading, v, w=0.0):
    return Motion(robot, se2.pose(x, y, heading), v, w)


def stops(own, *others):
    return must_stop(own, others, 0.55, 1.0)


def test_of_two_that_meet_the_larger_name_stops():
    a = at('a', 0.0, 0.0, 0.4, 0.5)
    b = at('b', 0.0, 0.8, -0.4, 0.5)
    assert stops(b, a)
    assert not stops(a, b)


def test_nobody_drives_into_a_robot_that_stands_whatever_its_name():
    assert stops(at('a', 0.0, 0.0, 0.0, 0.5), at('b', 0.8, 0.0, 0.0, 0.0))
    assert stops(at('b', 0.0, 0.0, 0.0, 0.5), at('a', 0.8, 0.0, 0.0, 0.0))


def test_robots_that_are_close_may_leave_and_turn():
    standing = at('a', 0.4, 0.0, 0.0, 0.0)
    assert not stops(at('b', 0.0, 0.0, math.pi, 0.5), standing)
    assert not stops(at('b', 0.0, 0.0, 0.0, 0.0, 1.0), standing)
    assert stops(at('b', 0.0, 0.0, 0.0, 0.1), standing)


def test_an_arc_around_a_robot_is_free():
    other = at('a', 1.0, 0.0, 0.0, 0.0)
    assert stops(at('b', 0.0, 0.0, 0.0, 0.6), other)
    assert not stops(at('b', 0.0, 0.0, 0.0, 0.6, 1.5), other)


def test_a_robot_that_follows_another_one_drives_on():
    assert not stops(at('b', 0.0, 0.0, 0.0, 0.5), at('a', 1.2, 0.0, 0.0, 0.5))


@pytest.mark.parametrize('w', [0.0, 0.5])
def test_a_robot_moves_on_along_its_arc(w):
    motion = Motion('a', se2.pose(1.0, 2.0, 0.7), 0.4, w)
    steps = motion.pose
    for _ in range(2000):
        steps = se2.compose(steps, se2.pose(0.4 * 1e-3, 0.0, w * 1e-3))
    later = moved_on(motion, 2.0)
    assert later.pose == pytest.approx(steps, abs=1e-3)
    assert (later.v, later.w) == (0.4, w)


def test_a_robot_that_drives_is_not_where_it_was_heard():
    own = Motion('a', se2.pose(0.0, 0.0, 0.0), 0.5, 0.0)
    comes = Motion('b', se2.pose(1.2, 0.0, math.pi), 0.4, 0.0)
    assert not must_stop(own, [comes], 0.6, 0.5)
    assert must_stop(own, as_heard(comes, 0.9), 0.6, 0.5)
    # It may have stopped, and says so a second later at the latest.
    leaves = Motion('b', se2.pose(0.7, 0.0, 0.0), 0.4, 0.0)
    assert must_stop(own, as_heard(leaves, 0.9), 0.6, 0.5)
    assert [each.pose[0] for each in as_heard(leaves, 9.0)] == pytest.approx([0.7, 1.1])


def test_a_navigator_that_gives_way_plans_around_the_other_robot():
    navigator = Navigator()
    navigator.set_goal(5.0, 3.0)
    other = np.array([[3.0, 3.0]])
    nearest_m = []
    for _ in range(8):
        command = navigator.step(se2.pose(2.2, 3.0, 0.0), HALL, None, 0.1)
        if command.v > 0.0:
            navigator.give_way(command, 0.1, other, 0.55)
        nearest_m.append(float(np.hypot(*(navigator.path - other).T).min()))
    assert nearest_m[0] < 0.1
    assert nearest_m[-1] >= 0.55


def test_a_navigator_that_gives_way_waits_and_aborts():
    navigator = Navigator()
    navigator.set_goal(5.0, 3.0)
    pose = se2.pose(1.0, 3.0, 0.0)
    states = []
    for _ in range(100):
        command = navigator.step(pose, HALL, None, 0.1)
        if command.state == 'driving' and command.v > 0.0:
            command = navigator.give_way(command, 0.1, np.array([[3.0, 0.5]]), 0.55)
            assert command.v == 0.0
        states.append(command.state)
        if command.state == 'failed':
            break
    assert command.reason == 'another robot is in the way'
    assert command.is_timeout
    assert 0.1 * len(states) == pytest.approx(8.0, abs=0.5)


def test_a_robot_that_would_touch_another_one_at_its_goal_stands_and_has_arrived():
    """Its goal is gone: a navigator that only gave way would never say that it was reached."""
    navigator = Navigator()
    navigator.set_goal(2.0, 3.0)
    other = HeardMotion(at('b', 2.6, 3.0, 0.0, 0.0), 0.0)
    x = 0.9
    states = []
    while not states or states[-1] not in ('reached', 'idle'):
        command = navigator.step(se2.pose(x, 3.0, 0.0), HALL, None, 0.1)
        heard = [other] if command.state == 'reached' else []
        assert command.v > 0.0
        command = navigator.allowed(at('a', x, 3.0, 0.0, command.v), command, heard, 0.8, 0.1)
        states.append(command.state)
        x += 0.1 * command.v
    assert states[-1] == 'reached'
    assert command.v == 0.0
    assert navigator.step(se2.pose(x, 3.0, 0.0), HALL, None, 0.1).v == 0.0


def test_a_robot_alone_drives_as_its_navigator_wants():
    navigator = Navigator()
    navigator.set_goal(5.0, 3.0)
    command = navigator.step(se2.pose(1.0, 3.0, 0.0), HALL, None, 0.1)
    assert navigator.allowed(at('a', 1.0, 3.0, 0.0, command.v), command, [], 0.55, 0.1) is command
