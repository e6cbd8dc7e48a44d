"""Robots that do not move as commanded: blocked wheels, or obstacles that the laser cannot see."""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array

# A robot is stuck if it has moved by less than this share of what it was commanded for a while, and
# of so much that the noise of its pose does not matter. The least share of a simulated exploration
# (dungeon/d1573, 543 s) is 0.88; a slow base, and wheels that slip while the localizer corrects
# their odometry, lie between.
_SHARE = 0.1
_WINDOW_S = 1.5
_MIN_PATH_M = 0.2
_MIN_TURN_RAD = 0.5
# Another pose than the one at which the robot was stuck.
_MOVED_M = 0.1
_MOVED_RAD = 0.3
_RING = 2.0 * np.pi * np.arange(8) / 8.0


class _Sample(NamedTuple):
    """Pose (3,), and time, commanded path and turn, and turn of the pose since the first one."""

    T_map_base: Array
    time_s: float
    path_m: float
    commanded_rad: float
    turned_rad: float


class StuckDetector:
    """Compares the motion of the robot with its commands.

    is_turning: whether what was commanded last was a turn on the spot.
    """

    def __init__(self) -> None:
        self.is_turning = False
        self._samples: deque[_Sample] = deque()

    def add(self, T_map_base: Array, v: float, w: float, dt_s: float) -> bool:
        """Add a pose (3,), after a command v (m/s), w (rad/s) of dt_s.

        Returns whether the robot is stuck. A stop restarts the comparison.
        """
        if (v == 0.0 and w == 0.0) or not self._samples:
            self._samples = deque([_Sample(T_map_base, 0.0, 0.0, 0.0, 0.0)])
            return False
        last = self._samples[-1]
        turned = se2.wrap(float(T_map_base[2] - last.T_map_base[2]))
        now = _Sample(
            T_map_base,
            last.time_s + dt_s,
            last.path_m + abs(v) * dt_s,
            last.commanded_rad + w * dt_s,
            last.turned_rad + turned,
        )
        self._samples.append(now)
        while len(self._samples) > 2 and _is_enough(self._samples[1], now):
            self._samples.popleft()
        return self._is_stuck(self._samples[0], now)

    def _is_stuck(self, then: _Sample, now: _Sample) -> bool:
        if not _is_enough(then, now):
            return False
        path_m = now.path_m - then.path_m
        self.is_turning = path_m < _MIN_PATH_M
        if self.is_turning:
            turned = now.turned_rad - then.turned_rad
            is_stuck = abs(turned) < _SHARE * abs(now.commanded_rad - then.commanded_rad)
        else:
            is_stuck = math.dist(now.T_map_base[:2], then.T_map_base[:2]) < _SHARE * path_m
        if is_stuck:
            self._samples.clear()
        return is_stuck


def _is_enough(then: _Sample, now: _Sample) -> bool:
    """Whether so much was commanded meanwhile that a robot must have moved."""
    if now.time_s - then.time_s < _WINDOW_S:
        return False
    is_driven = now.path_m - then.path_m >= _MIN_PATH_M
    return is_driven or abs(now.commanded_rad - then.commanded_rad) >= _MIN_TURN_RAD


class StuckPlaces:
    """Places at which the robot was stuck: discs of its radius ahead of it.

    A robot that is stuck in two directions is blocked itself, and no place is. Until it has turned
    away, a place counts for the goal of that time only. Only having driven there shows that a place
    is free: what blocks the robot may be transparent to the laser.
    """

    def __init__(self, robot_radius_m: float) -> None:
        self._radius_m = robot_radius_m
        self._places: list[Array] = []
        self._stuck: Array | None = None  # pose (3,) at which the robot was stuck, and still is
        self._is_place = False
        self._is_new_goal = False

    def points(self) -> Array:
        """Points (N, 2) on the discs, map frame, m."""
        places = list(self._places)
        if self._stuck is not None and self._is_place and not self._is_new_goal:
            places.append(self._ahead(self._stuck))
        ring = self._radius_m * np.column_stack([np.cos(_RING), np.sin(_RING)])
        discs = [place + np.vstack([ring, np.zeros((1, 2))]) for place in places]
        return np.concatenate(discs) if discs else np.empty((0, 2))

    def goal_set(self) -> None:
        """Try again where the robot has been stuck and has not moved since."""
        self._is_new_goal = True

    def add_pose(self, T_map_base: Array) -> None:
        """Add a pose (3,) of the robot: places that it drives over are free."""
        self._places = [
            place for place in self._places if math.dist(place, T_map_base[:2]) > self._radius_m
        ]
        if self._stuck is None:
            return
        moved = se2.between(self._stuck, T_map_base)
        if moved[0] >= _MOVED_M:
            self._stuck = None  # it drove on
        elif math.hypot(moved[0], moved[1]) >= _MOVED_M or abs(moved[2]) >= _MOVED_RAD:
            if self._is_place:
                self._places.append(self._ahead(self._stuck))
            self._stuck = None

    def add_stuck(self, T_map_base: Array, is_turning: bool) -> bool:
        """The robot is stuck at a pose (3,). Returns whether it was, and has not moved since."""
        is_repeated = self._stuck is not None
        self._is_place = not is_repeated and not is_turning
        self._is_new_goal = False
        if not is_repeated:
            self._stuck = T_map_base
        return is_repeated

    def _ahead(self, T_map_base: Array) -> Array:
        """Centre (2,) of a disc that touches the robot in front."""
        heading = float(T_map_base[2])
        return T_map_base[:2] + 2.0 * self._radius_m * np.array(
            [math.cos(heading), math.sin(heading)]
        )
