"""A robot that does not move as commanded: it is noticed, and where it was is avoided."""

import math

import numpy as np
import pytest

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.navigator import Navigator
from thinmap_ros.core.planning.obstacles import StuckDetector, StuckPlaces
from thinmap_ros.core.se2 import pose
from thinmap_ros.sim.robot import after_arc

DT_S = 0.1
RADIUS_M = 0.25


def time_until_stuck(v, w, follow, seconds=60.0, seed=0):
    """Time after which a robot counts as stuck; None: it does not. follow: its next pose."""
    detector = StuckDetector()
    rng = np.random.default_rng(seed)
    T = np.zeros(3)
    for k in range(round(seconds / DT_S)):
        seen = T + rng.normal(0.0, 0.003, 3)
        if detector.add(seen, v, w, DT_S):
            return k * DT_S
        T = follow(T)
    return None


@pytest.mark.parametrize(
    ('v', 'w', 'seconds'), [(0.5, 0.0, 1.5), (0.2, 0.3, 1.5), (0.0, 1.0, 1.5), (0.05, 0.0, 4.0)]
)
def test_a_robot_that_stands_is_stuck_when_it_should_have_moved(v, w, seconds):
    assert time_until_stuck(v, w, lambda T: T) == pytest.approx(seconds, abs=0.2)


@pytest.mark.parametrize('share', [0.2, 0.5, 1.0])
@pytest.mark.parametrize(
    ('v', 'w'), [(0.5, 0.0), (0.5, 1.0), (0.02, 0.0), (0.02, 1.0), (0.0, 1.0), (0.0, -3.0)]
)
def test_a_robot_that_moves_is_not_stuck_however_slow(v, w, share):
    moved = (share * v * DT_S, share * w * DT_S)
    assert time_until_stuck(v, w, lambda T: after_arc(T, *moved)) is None


def test_odometry_of_slipping_wheels_that_the_localizer_takes_back_is_no_motion():
    def slip(T):
        return pose(0.0, 0.0, 0.0) if T[0] > 0.08 else after_arc(T, 0.05, 0.0)

    assert time_until_stuck(0.5, 0.0, slip) < 3.0


def test_turning_to_and_fro_is_no_standstill():
    detector = StuckDetector()
    for k in range(600):
        w = 1.0 if k % 6 < 3 else -1.0
        assert not detector.add(np.zeros(3), 0.0, w, DT_S)


def test_a_stop_starts_the_comparison_anew():
    detector = StuckDetector()
    for k in range(600):
        v = 0.0 if k % 14 == 0 else 0.5
        assert not detector.add(np.zeros(3), v, 0.0, DT_S)


def test_a_place_is_a_disc_ahead_and_stays_until_the_robot_drives_over_it():
    places = StuckPlaces(RADIUS_M)
    here = pose(1.0, 2.0, math.pi / 2.0)
    assert not places.add_stuck(here, is_turning=False)
    away = np.hypot(*(places.points() - here[:2]).T)
    assert away.min() == pytest.approx(RADIUS_M)
    assert away.max() == pytest.approx(3.0 * RADIUS_M)
    places.add_pose(pose(1.0, 2.0, math.pi))
    places.goal_set()
    places.add_pose(pose(1.0, 2.9, math.pi))
    assert len(places.points()) == 9
    places.add_pose(pose(1.0, 2.6, math.pi))
    assert len(places.points()) == 0


def test_a_robot_that_is_stuck_again_without_having_moved_is_blocked_itself():
    places = StuckPlaces(RADIUS_M)
    here = pose(0.0, 0.0, 0.0)
    places.add_stuck(here, is_turning=False)
    places.add_pose(here + 0.01)
    assert places.add_stuck(here + 0.01, is_turning=True)
    assert len(places.points()) == 0
    places.add_pose(pose(0.0, 0.0, 1.0))
    assert len(places.points()) == 0
    assert not places.add_stuck(pose(0.0, 0.0, 1.0), is_turning=True)
    assert len(places.points()) == 0, 'nothing is ahead of a robot that cannot turn'


def test_a_next_goal_may_try_the_same_way_and_driving_on_shows_that_it_is_free():
    places = StuckPlaces(RADIUS_M)
    places.add_stuck(pose(0.0, 0.0, 0.0), is_turning=False)
    assert len(places.points()) == 9
    places.goal_set()
    assert len(places.points()) == 0
    places.add_pose(pose(0.2, 0.0, 0.0))
    places.add_pose(pose(0.2, 0.0, 2.0))
    assert len(places.points()) == 0


class Room:
    """A free room of 8 x 8 m, with a robot in it that cannot pass some places."""

    def __init__(self, passes=lambda T: True, top_m=4.0):
        """top_m: upper edge of what is free."""
        cells = np.zeros((80, 80), dtype=np.int8)
        cells[round((top_m + 4.0) / 0.1) :] = 100
        self.patch = GridPatch(GridFrame(-4.0, -4.0, 0.1), cells)
        self.navigator = Navigator()
        self.passes = passes
        self.T = pose(-2.0, 0.05, 0.0)
        self.pushes = 0

    def drive_to(self, x, y, seconds=120.0):
        """The last command, and the states that were commanded."""
        self.navigator.set_goal(x, y)
        states = []
        for _ in range(round(seconds / DT_S)):
            command = self.navigator.step(self.T, self.patch, None, DT_S)
            states.append(command.state)
            if command.state in ('reached', 'failed'):
                break
            next_T = after_arc(self.T, command.v * DT_S, command.w * DT_S)
            if self.passes(next_T):
                self.T = next_T
            else:
                self.pushes += 1
        return command, states


def test_a_robot_whose_wheels_are_blocked_gives_up_each_goal_after_seconds():
    room = Room(passes=lambda T: False)
    for x in (2.0, 3.0, -3.0):
        command, states = room.drive_to(x, 0.05)
        assert command.state == 'failed'
        assert command.reason.startswith('the robot does not move as commanded')
        assert len(states) <= 45
    room.passes = lambda T: True
    assert room.drive_to(2.0, 0.05)[0].state == 'reached'


def test_a_robot_drives_round_a_pane_that_it_cannot_see_and_remembers_it():
    room = Room(passes=lambda T: not (abs(T[0]) < 0.1 and abs(T[1]) < 0.5))
    command, states = room.drive_to(2.0, 0.05)
    assert command.state == 'reached'
    assert 'blocked' in states
    first = room.pushes
    assert 10 <= first <= 150
    assert room.drive_to(-2.0, 0.05)[0].state == 'reached'
    assert room.drive_to(2.0, 0.05)[0].state == 'reached'
    assert room.pushes <= 2 * first


def test_a_robot_behind_glass_ends_with_a_reason():
    room = Room(passes=lambda T: T[0] < -0.1)
    command, _ = room.drive_to(2.0, 0.05)
    assert command.state == 'failed'
    assert room.pushes <= 200
    assert room.drive_to(-3.0, 1.0)[0].state == 'reached', 'it can be driven away'
