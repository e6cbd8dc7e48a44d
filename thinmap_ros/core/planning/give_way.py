"""Right of way between robots that know each other's poses and speeds.

A laser that looks ahead does not see a robot beside it. A robot stops driving, and may turn, where
it would come too close to another one that stands. Of two that drive, the one with the larger name
stops.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from thinmap_ros.core.se2 import Array

MESSAGE_PERIOD_S = 1.0
NEAR_ROBOT_M = 3.0  # robots this close to another one send their motion ten times a second
_STEPS = 8
_APPROACH_M = 1e-3  # two robots that are too close already may not come closer by more


@dataclass(frozen=True, eq=False)
class Motion:
    """Name, pose (3,), speed, m/s, and turn rate, rad/s, of a robot."""

    robot: str
    pose: Array
    v: float
    w: float


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
    places: Array = motion.pose[:2] + chord[:, None] * np.column_stack(
        [np.cos(heading), np.sin(heading)]
    )
    return places
