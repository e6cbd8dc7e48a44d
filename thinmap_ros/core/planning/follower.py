"""Path -> speed and turn rate for a differential drive: pure pursuit, with turns on the spot where the path bends hard.

Source: Coulter, "Implementation of the pure pursuit path tracking algorithm", 1992.
"""

import math
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.se2 import Array, wrap


@dataclass(frozen=True)
class FollowerConfig(Config):
    """Limits of the drive, and how closely a path is followed."""

    max_speed_m_s: float = parameter(0.2, 'speed limit, m/s', low=0.01, high=5.0)
    max_turn_rad_s: float = parameter(1.0, 'turn rate limit, rad/s', low=0.05, high=10.0)
    max_acceleration_m_s2: float = parameter(0.4, 'acceleration limit, m/s^2', low=0.01, high=10.0)
    max_turn_acceleration_rad_s2: float = parameter(2.5, 'turn acceleration limit, rad/s^2', low=0.05, high=20.0)
    lookahead_m: float = parameter(0.35, 'distance of the point on the path that is steered for, m', low=0.05, high=5.0)
    lookahead_s: float = parameter(0.8, 'time ahead of the point that is steered for, s', low=0.0, high=10.0)
    stray_m: float = parameter(0.05, 'corners of the path are cut by no more than this, m', low=0.0, high=1.0)
    turn_in_place_rad: float = parameter(
        0.9, 'heading error from which on the robot turns on the spot, rad', low=0.1, high=3.0
    )


class Follower:
    """Follows one path after the other; remembers the last command, so that the acceleration limits hold."""

    def __init__(self, config: FollowerConfig) -> None:
        self.config = config
        self.v = 0.0
        self.w = 0.0
        self._turning = False

    def command(self, T_map_base: Array, path: Array, dt_s: float) -> tuple[float, float]:
        """Speed (m/s) and turn rate (rad/s) for the next dt_s along a path (K, 2) that ends where to stop."""
        config = self.config
        reach = max(config.lookahead_m, config.lookahead_s * self.v)
        ahead, rest_m = _point_ahead(path, T_map_base[:2], reach, config.stray_m)
        dx, dy = ahead - T_map_base[:2]
        error = wrap(math.atan2(dy, dx) - T_map_base[2]) if dx or dy else 0.0
        # Once turning, on until the path is nearly straight ahead: no flickering at the limit.
        self._turning = abs(error) > (0.3 * config.turn_in_place_rad if self._turning else config.turn_in_place_rad)
        if self._turning:
            return self._limited(0.0, self._turn_for(error, dt_s), dt_s)
        v = min(config.max_speed_m_s, math.sqrt(2.0 * config.max_acceleration_m_s2 * rest_m))
        curvature = 2.0 * math.sin(error) / max(math.hypot(dx, dy), 0.05)
        if abs(curvature) * v > config.max_turn_rad_s:
            v = config.max_turn_rad_s / abs(curvature)
        return self._limited(v, v * curvature, dt_s)

    def turn_to(self, T_map_base: Array, heading_rad: float, dt_s: float) -> tuple[float, float]:
        """Speed and turn rate for the next dt_s that stop the robot and turn it to a heading in the map frame."""
        error = wrap(heading_rad - float(T_map_base[2]))
        return self._limited(0.0, self._turn_for(error, dt_s), dt_s)

    def stop(self, dt_s: float) -> tuple[float, float]:
        """Speed and turn rate for the next dt_s that come to rest within the limits."""
        return self._limited(0.0, 0.0, dt_s)

    def slowed(self, v: float, w: float) -> tuple[float, float]:
        """Take note that a command was made slower than the limits allow, for something right ahead."""
        self.v, self.w = v, w
        return v, w

    def _turn_for(self, error: float, dt_s: float) -> float:
        """Turn rate that can still be braked to rest at the wished heading."""
        braking = math.sqrt(2.0 * 0.7 * self.config.max_turn_acceleration_rad_s2 * abs(error))
        return math.copysign(min(braking, self.config.max_turn_rad_s, abs(error) / dt_s), error)

    def _limited(self, v: float, w: float, dt_s: float) -> tuple[float, float]:
        config = self.config
        w = min(max(w, -config.max_turn_rad_s), config.max_turn_rad_s)
        self.v = max(_towards(self.v, v, config.max_acceleration_m_s2 * dt_s), 0.0)
        self.w = _towards(self.w, w, config.max_turn_acceleration_rad_s2 * dt_s)
        return self.v, self.w


def _towards(value: float, goal: float, change: float) -> float:
    return min(max(goal, value - change), value + change)


def _point_ahead(path: Array, xy: Array, reach_m: float, stray_m: float) -> tuple[Array, float]:
    """Point of a path (K, 2) to steer for from xy, and the length left from the point nearest to xy, m.

    It lies up to reach_m on along the path, and less far where the straight way to it would leave the path by more
    than stray_m: corners are not cut.
    """
    nearest = int(np.square(path - xy).sum(axis=1).argmin())
    rest = path[nearest:]
    steps = np.hypot(*np.diff(rest, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    left_m = max(float(along[-1]), float(np.hypot(*(rest[-1] - xy))))
    last = min(int(np.searchsorted(along, reach_m)), len(rest) - 1)
    allowed = stray_m + float(np.hypot(*(rest[0] - xy)))
    while last > 1 and _stray(rest[:last], xy, rest[last]) > allowed:
        last -= 1
    return np.asarray(rest[last]), left_m


def _stray(points: Array, a: Array, b: Array) -> float:
    """Largest distance of points (K, 2) from the straight line through a and b, m."""
    dx, dy = b - a
    length = max(math.hypot(dx, dy), 1e-9)
    return float(np.abs((points[:, 0] - a[0]) * dy - (points[:, 1] - a[1]) * dx).max()) / length
