"""Pure-pursuit path follower for a differential drive, and right of way between robots."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from thinmap_ros.core.config import SAFE_LOWER, Config, parameter
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.jit import kernel

_MAX_CORNER_CUT_M = 0.05  # largest distance between the driven arc and the path: one cell
_TURN_IN_PLACE_RAD = 0.9  # heading error above which the robot turns in place, and drives no arc

# Of the right of way.
MESSAGE_PERIOD_S = 1.0
NEAR_ROBOT_M = 3.0  # robots this close to another one send their motion ten times a second
_STEPS = 8
_APPROACH_M = 1e-3  # two robots that are too close already may not come closer by more


@dataclass(frozen=True)
class SpeedConfig(Config):
    """What decides how long a drive takes."""

    max_speed_m_s: float = parameter(
        0.2, 'Maximum speed (m/s).', low=0.01, high=5.0, safe=SAFE_LOWER
    )
    max_angular_speed_rad_s: float = parameter(
        1.0, 'Maximum angular speed (rad/s).', low=0.05, high=10.0, safe=SAFE_LOWER
    )
    max_acceleration_m_s2: float = parameter(
        0.4,
        'Maximum acceleration (m/s^2). Lower: smoother, and the robot brakes earlier.',
        low=0.01,
        high=10.0,
        safe=SAFE_LOWER,
    )


@dataclass(frozen=True)
class PathFollowerConfig(SpeedConfig):
    """Limits of the drive, and how closely a path is followed."""

    max_angular_acceleration_rad_s2: float = parameter(
        2.5,
        'Maximum angular acceleration (rad/s^2). Lower: smoother turns.',
        low=0.05,
        high=20.0,
        safe=SAFE_LOWER,
    )
    lookahead_distance_m: float = parameter(
        0.35,
        'Smallest lookahead distance of the pure-pursuit controller (m). Raise it if the robot '
        'oscillates about the path, lower it to follow more closely.',
        low=0.05,
        high=5.0,
    )
    lookahead_time_s: float = parameter(
        0.8,
        'Lookahead distance per speed (s). Raise it if a fast robot oscillates about the path.',
        low=0.0,
        high=10.0,
    )
    # In narrow passages: minimum lookahead, its growth with the clearance margin, and a speed that
    # is always allowed.
    narrow_lookahead_m: float = 0.1
    lookahead_per_margin: float = 2.0
    min_narrow_speed_m_s: float = 0.1


class PathFollower:
    """Follows paths; stores the last command, so that acceleration limits hold.

    Source: Coulter, "Implementation of the pure pursuit path tracking algorithm", 1992.
    """

    def __init__(self, config: PathFollowerConfig) -> None:
        self.config = config
        self.v = 0.0
        self.w = 0.0
        self._turning = False

    def command(
        self, T_map_base: Array, path: Array, dt_s: float, clearance_margin_m: float = math.inf
    ) -> tuple[float, float]:
        """Speed (m/s) and turn rate (rad/s) for the next dt_s along a path (K, 2), to its end.

        clearance_margin_m: free space on either side of the path; where it is small, the robot
        follows the path more closely.
        """
        config = self.config
        narrow = config.narrow_lookahead_m + config.lookahead_per_margin * max(
            clearance_margin_m, 0.0
        )
        reach = min(max(config.lookahead_distance_m, config.lookahead_time_s * self.v), narrow)
        x, y, theta = T_map_base.tolist()
        ahead_x, ahead_y, rest_m = _point_ahead(path, x, y, reach, _MAX_CORNER_CUT_M)
        dx = ahead_x - x
        dy = ahead_y - y
        error = wrap(math.atan2(dy, dx) - theta) if dx or dy else 0.0
        # Hysteresis: once turning, the robot turns until the path is nearly straight ahead.
        least = 0.3 * _TURN_IN_PLACE_RAD if self._turning else _TURN_IN_PLACE_RAD
        self._turning = abs(error) > least
        if self._turning:
            return self._limited(0.0, self._turn_rate(error, dt_s), dt_s)
        v = min(config.max_speed_m_s, math.sqrt(2.0 * config.max_acceleration_m_s2 * rest_m))
        v = min(v, max(narrow / max(config.lookahead_time_s, 1e-9), config.min_narrow_speed_m_s))
        curvature = 2.0 * math.sin(error) / max(math.hypot(dx, dy), 0.05)
        if abs(curvature) * v > config.max_angular_speed_rad_s:
            v = config.max_angular_speed_rad_s / abs(curvature)
        return self._limited(v, v * curvature, dt_s)

    def turn_to(self, T_map_base: Array, heading_rad: float, dt_s: float) -> tuple[float, float]:
        """Speed and turn rate for the next dt_s: stop, then turn to a heading, map frame."""
        if self.v > 0.0:
            return self.stop(dt_s)
        error = wrap(heading_rad - float(T_map_base[2]))
        return self._limited(0.0, self._turn_rate(error, dt_s), dt_s)

    def stop(self, dt_s: float) -> tuple[float, float]:
        """Speed and turn rate for the next dt_s: brake on the present arc, within the limits.

        This arc was checked for obstacles up to the stopping point when it was entered; any other
        may end in a wall.
        """
        v = max(self.v - self.config.max_acceleration_m_s2 * dt_s, 0.0)
        return self._limited(v, self.w * v / self.v if self.v > 0.0 else 0.0, dt_s)

    def override_speed(self, v: float, w: float) -> tuple[float, float]:
        """Override the command with a slower one, beyond the limits, in front of an obstacle."""
        self.v = v
        self.w = w
        return v, w

    def _turn_rate(self, error: float, dt_s: float) -> float:
        """Highest turn rate from which the robot can stop at the desired heading."""
        braking = math.sqrt(2.0 * 0.7 * self.config.max_angular_acceleration_rad_s2 * abs(error))
        return math.copysign(
            min(braking, self.config.max_angular_speed_rad_s, abs(error) / dt_s), error
        )

    def _limited(self, v: float, w: float, dt_s: float) -> tuple[float, float]:
        config = self.config
        w = min(max(w, -config.max_angular_speed_rad_s), config.max_angular_speed_rad_s)
        self.v = max(_limited_change(self.v, v, config.max_acceleration_m_s2 * dt_s), 0.0)
        self.w = _limited_change(self.w, w, config.max_angular_acceleration_rad_s2 * dt_s)
        return self.v, self.w


def _limited_change(value: float, goal: float, change: float) -> float:
    return min(max(goal, value - change), value + change)


@kernel
def nearest_point(path: Array, x: float, y: float) -> int:
    """Index of the point of a path (K, 2) nearest to (x, y); the first of equally near ones."""
    best = np.inf
    nearest = 0
    for k in range(path.shape[0]):
        squared = (path[k, 0] - x) ** 2 + (path[k, 1] - y) ** 2
        if squared < best:
            best = squared
            nearest = k
    return nearest


@kernel
def length_from(path: Array, first: int) -> float:
    """Length of a path (K, 2) from one of its points to its end."""
    length = 0.0
    for k in range(first + 1, path.shape[0]):
        length += math.hypot(path[k, 0] - path[k - 1, 0], path[k, 1] - path[k - 1, 1])
    return length


@kernel
def _point_ahead(
    path: Array, x: float, y: float, reach_m: float, max_corner_cut_m: float
) -> tuple[float, float, float]:
    """Target point on a path (K, 2) from (x, y), and the remaining length of the path, m.

    It lies up to reach_m ahead on the path, or less if the straight line to it would leave the path
    by more than max_corner_cut_m: corners are not cut.
    """
    first = nearest_point(path, x, y)
    end = path.shape[0] - 1
    left_m = max(length_from(path, first), math.hypot(path[end, 0] - x, path[end, 1] - y))
    last = first
    along = 0.0
    while last < end and along < reach_m:
        last += 1
        along += math.hypot(path[last, 0] - path[last - 1, 0], path[last, 1] - path[last - 1, 1])
    allowed = max_corner_cut_m + math.hypot(path[first, 0] - x, path[first, 1] - y)
    while last > first + 1 and _max_deviation(path, first, last, x, y) > allowed:
        last -= 1
    return path[last, 0], path[last, 1], left_m


@kernel
def _max_deviation(path: Array, first: int, last: int, x: float, y: float) -> float:
    """Largest distance, m, of path points first to last from the line from (x, y) to the last."""
    dx = path[last, 0] - x
    dy = path[last, 1] - y
    length = max(math.hypot(dx, dy), 1e-9)
    most = 0.0
    for k in range(first, last):
        most = max(most, abs((path[k, 0] - x) * dy - (path[k, 1] - y) * dx))
    return most / length


@dataclass(frozen=True, eq=False)
class Motion:
    """Name, pose (3,), speed, m/s, and turn rate, rad/s, of a robot."""

    robot: str
    pose: Array
    v: float
    w: float


class HeardMotion(NamedTuple):
    """Motion of a robot, and how long ago it was received, s."""

    motion: Motion
    age_s: float


def moved_on(motion: Motion, seconds: float) -> Motion:
    """The motion of a robot after a time at its present speeds."""
    x, y = _places(motion, np.array([seconds]))[0]
    theta = motion.pose[2] + motion.w * seconds
    return replace(motion, pose=np.array([x, y, theta]))


def as_heard(motion: Motion, age_s: float) -> list[Motion]:
    """Where a robot may be that was heard some time ago: there still, or as far as it has driven.

    A robot that drives tells its pose at least once a second.
    """
    return [motion, moved_on(motion, min(age_s, MESSAGE_PERIOD_S))]


def must_stop(own: Motion, others: Iterable[Motion], distance_m: float, horizon_s: float) -> bool:
    """Whether a robot would come closer than distance_m to another one within a time, s.

    A laser that looks ahead does not see a robot beside it. A robot stops driving, and may turn,
    where it would come too close to another one that stands. Of two that drive, the one with the
    larger name stops.
    own: its motion as it is commanded; horizon_s: at least the time that it needs to brake.
    """
    for other in others:
        now_m = math.dist(own.pose[:2], other.pose[:2])
        limit_m = min(distance_m, now_m - _APPROACH_M)
        if _nearest_m(own, replace(other, v=0.0, w=0.0), horizon_s) < limit_m:
            return True
        if own.robot > other.robot and _nearest_m(own, other, horizon_s) < limit_m:
            return True
    return False


def _nearest_m(a: Motion, b: Motion, horizon_s: float) -> float:
    times = np.linspace(horizon_s / _STEPS, horizon_s, _STEPS)
    return float(np.hypot(*(_places(a, times) - _places(b, times)).T).min())


def _places(motion: Motion, times: Array) -> Array:
    """Positions (N, 2) on the present arc after some times (N,), s."""
    half_turn = 0.5 * motion.w * times
    chord = motion.v * times * np.sinc(half_turn / math.pi)
    heading = motion.pose[2] + half_turn
    directions = np.column_stack([np.cos(heading), np.sin(heading)])
    return np.asarray(motion.pose[:2] + chord[:, None] * directions)
