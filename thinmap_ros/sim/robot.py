"""Differential-drive robot: exact motion, limits, contact with walls, odometry drift."""

import math
from dataclasses import dataclass, field

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.planning.wavefront import WavefrontConfig
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.world import World

_PATH_MARGIN_M = 0.03  # between a body and the obstacles beside its path
_PLANNED_RADIUS_M = WavefrontConfig().robot_radius_m


@dataclass(frozen=True)
class RobotConfig(Config):
    """Body and limits of a robot, and the errors of its wheel odometry."""

    radius_m: float = parameter(
        0.22, 'radius of the disc that holds the body, m', low=0.01, high=2.0
    )
    max_speed_m_s: float = parameter(1.6, 'speed limit, m/s', low=0.01, high=5.0)
    max_angular_speed_rad_s: float = parameter(3.0, 'turn rate limit, rad/s', low=0.01, high=10.0)
    max_acceleration_m_s2: float = parameter(0.5, 'acceleration limit, m/s^2', low=0.01, high=10.0)
    max_angular_acceleration_rad_s2: float = parameter(
        3.0, 'turn acceleration limit, rad/s^2', low=0.01, high=20.0
    )
    scale_sigma: float = parameter(
        0.01, 'systematic error of distances: wheel diameter (1 sigma)', low=0.0
    )
    turn_scale_sigma: float = parameter(
        0.02, 'systematic error of turns: wheel base (1 sigma)', low=0.0
    )
    drift_sigma_rad_m: float = parameter(
        0.01, 'systematic turn per metre: unequal wheels (1 sigma), rad/m', low=0.0
    )
    distance_noise: float = parameter(
        0.01, 'noise of distances per square root of metres (1 sigma), m', low=0.0
    )
    turn_noise: float = parameter(
        0.02, 'noise of turns per square root of radians (1 sigma), rad', low=0.0
    )
    turn_noise_driving: float = parameter(
        0.01, 'noise of turns per square root of metres (1 sigma), rad', low=0.0
    )
    contact_margin_m: float = 0.05  # a contact ends where the body is so far from the wall

    @property
    def planned_radius_m(self) -> float:
        """Radius with which paths are planned, m: at least that of the nodes by default."""
        return max(self.radius_m + _PATH_MARGIN_M, _PLANNED_RADIUS_M)


# The 3-AT is larger and skid-steered: its wheels slip whenever it turns. The footprint of the
# MiR100 is 0.89 x 0.58 m, 0.04 m ahead of its axle.
PRESETS = {
    '2dx': RobotConfig(),
    '3at': RobotConfig(
        radius_m=0.32,
        max_speed_m_s=0.8,
        max_angular_speed_rad_s=2.4,
        turn_scale_sigma=0.08,
        turn_noise=0.06,
        drift_sigma_rad_m=0.02,
    ),
    'mir100': RobotConfig(
        radius_m=0.57,
        max_speed_m_s=1.5,
        max_angular_speed_rad_s=1.5,
        max_angular_acceleration_rad_s2=2.5,
    ),
}
# Lasers of those that have others than an LMS200. The two S300 scan at 12.5 Hz; at 10 Hz they
# alternate in steps of 50 ms.
# Source: mir_description of DFKI, mir_100_v1.urdf.xacro and sick_s300.urdf.xacro.
LASERS = {
    'mir100': LaserScannerConfig(
        beams=541,
        field_of_view_deg=270.0,
        range_max_m=29.0,
        scan_rate_hz=10.0,
        range_resolution_m=0.01,
        lasers='front 0.4288,0.2358,0.7854; rear -0.3548,-0.2352,-2.3562',
    )
}


class WheelOdometry:
    """Odometry T_odom_base (3,) from zero, with random drift, from exact steps of a robot."""

    def __init__(self, config: RobotConfig, seed: int) -> None:
        self.config = config
        self.T_odom_base = np.zeros(3)
        self._rng = np.random.default_rng(seed)
        self._scale = 1.0 + self._rng.normal(0.0, config.scale_sigma)
        self._turn_scale = 1.0 + self._rng.normal(0.0, config.turn_scale_sigma)
        self._drift_rad_m = self._rng.normal(0.0, config.drift_sigma_rad_m)

    def add_step(self, distance_m: float, turn_rad: float) -> Array:
        """Add a step with an exact distance and rotation; returns the odometry pose (3,)."""
        distance, turn = self._with_odometry_noise(distance_m, turn_rad)
        self.T_odom_base = after_arc(self.T_odom_base, distance, turn)
        return self.T_odom_base

    def _with_odometry_noise(self, distance: float, turn: float) -> tuple[float, float]:
        """Distance (m) and rotation (rad) with odometry errors."""
        metres = abs(distance)
        radians = abs(turn)
        noise = self._rng.normal(size=2).tolist()
        root = math.sqrt(metres)
        seen_distance = distance * self._scale + noise[0] * self.config.distance_noise * root
        sigma = self.config.turn_noise * math.sqrt(radians) + self.config.turn_noise_driving * root
        seen_turn = turn * self._turn_scale + self._drift_rad_m * metres + noise[1] * sigma
        return seen_distance, seen_turn


@dataclass(eq=False)
class DifferentialDriveRobot:
    """A robot at T_world_base (3,), with odometry T_odom_base (3,) from zero that drifts."""

    config: RobotConfig
    world: World
    T_world_base: Array
    seed: int
    T_odom_base: Array = field(default_factory=lambda: np.zeros(3))
    v: float = 0.0
    w: float = 0.0
    collisions: int = 0
    touching: bool = False

    def __post_init__(self) -> None:
        self._odometry = WheelOdometry(self.config, self.seed)

    def step(self, v: float, w: float, dt_s: float) -> None:
        """Drive for dt_s towards a commanded speed v (m/s) and turn rate w (rad/s), within limits.

        A robot that would touch a wall does not move, but can rotate. A contact counts once, until
        the robot has left the wall.
        """
        self.v = _towards(
            self.v, v, self.config.max_speed_m_s, self.config.max_acceleration_m_s2 * dt_s
        )
        self.w = _towards(
            self.w,
            w,
            self.config.max_angular_speed_rad_s,
            self.config.max_angular_acceleration_rad_s2 * dt_s,
        )
        moved = after_arc(self.T_world_base, self.v * dt_s, self.w * dt_s)
        x, y, _ = moved.tolist()
        clear = self.world.is_clear(x, y, self.config.radius_m)
        if not clear and self.v != 0.0:
            self.collisions += not self.touching
            self.v = 0.0
            moved = after_arc(self.T_world_base, 0.0, self.w * dt_s)
        self.T_world_base = moved
        # A robot that keeps pushing approaches the wall again: still the same contact.
        self.touching = not clear or (
            self.touching
            and not self.world.is_clear(
                moved[0], moved[1], self.config.radius_m + self.config.contact_margin_m
            )
        )
        self.T_odom_base = self._odometry.add_step(self.v * dt_s, self.w * dt_s)


def after_arc(T: Array, distance: float, turn: float) -> Array:
    """Pose (3,) after a circular arc of a length (m) and rotation (rad) from a pose (3,)."""
    half = turn / 2.0
    chord = distance if half == 0.0 else distance * math.sin(half) / half
    dx = chord * math.cos(half)
    dy = chord * math.sin(half)
    x, y, theta = T.tolist()
    c = math.cos(theta)
    s = math.sin(theta)
    return se2.pose(x + c * dx - s * dy, y + s * dx + c * dy, theta + se2.wrap(turn))


def _towards(value: float, goal: float, limit: float, change: float) -> float:
    goal = min(max(goal, -limit), limit)
    return min(max(goal, value - change), value + change)
