"""Motion model of a differential drive and observation model of a line, with Jacobians."""

import math
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.se2 import Array, rotation, wrap


@dataclass(frozen=True)
class OdometryConfig(Config):
    """Noise of odometry, 1 sigma."""

    noise_ratio: float = parameter(
        0.03,
        'Standard deviation of odometry per metre or radian of motion, besides its systematic '
        'error, which is calibrated. Smallest value; it grows where scans find more. Raise it for '
        'wheels that slip, lower it for an odometry that is better than that.',
        low=0.001,
        high=2.0,
    )
    noise_floor_m: float = parameter(
        0.003,
        'Smallest standard deviation of the position in an odometry increment (m). Raise it if the '
        'pose sticks where the robot is pushed, lower it if it drifts at a standstill.',
        low=1e-5,
        high=1.0,
    )
    noise_floor_rad: float = parameter(
        0.003,
        'Smallest standard deviation of the heading in an odometry increment (rad). Raise it if '
        'the heading sticks where the robot is turned, lower it if it drifts at a standstill.',
        low=1e-5,
        high=1.0,
    )


def odometry_slip(config: OdometryConfig) -> Array:
    """Smallest error (3,), 1 sigma, of an odometry increment."""
    return np.array([config.noise_floor_m, config.noise_floor_m, config.noise_floor_rad])


def odometry_variances(increment: Array, config: OdometryConfig) -> Array:
    """Variances (3,) of an odometry increment (3,), in the robot frame before the motion."""
    length_m = math.hypot(increment[0], increment[1])
    turn = abs(float(increment[2]))
    sigmas = odometry_slip(config) + config.noise_ratio * np.array([length_m, length_m, turn])
    return np.square(sigmas)


def motion_jacobians(T_map_base: Array, increment: Array) -> tuple[Array, Array]:
    """F_x and F_u, (3, 3) each, of T_map_base o increment.

    Source: EKF-SLAM/TI paper eqs. (10), (11).
    """
    F_u = rotation(float(T_map_base[2]))
    dx, dy, _ = F_u @ increment
    F_x = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    return F_x, F_u


def observe_line(T_map_base: Array, line: Array) -> tuple[Array, Array, Array]:
    """Predicted observation (2,) of a map line (r, alpha), robot frame.

    Also returns its Jacobians w.r.t. the pose (2, 3) and the line (2, 2).

    Source: EKF-SLAM/TI paper eq. (3), which is illegible in the text. For a line
    x cos(alpha) + y sin(alpha) = r it is
    r^R = r - (x cos(alpha) + y sin(alpha)), alpha^R = alpha - theta,
    and if r^R < 0: -r^R, alpha^R + pi.
    """
    x, y, theta = (float(v) for v in T_map_base)
    r = float(line[0])
    alpha = float(line[1])
    c = math.cos(alpha)
    s = math.sin(alpha)
    distance = r - (x * c + y * s)
    bearing = alpha - theta
    sign = 1.0
    if distance < 0.0:
        distance = -distance
        bearing = bearing + math.pi
        sign = -1.0
    by_pose = np.array([[-sign * c, -sign * s, 0.0], [0.0, 0.0, -1.0]])
    by_line = np.array([[sign, sign * (x * s - y * c)], [0.0, 1.0]])
    return np.array([distance, wrap(bearing)]), by_pose, by_line


def place_line(T_map_base: Array, seen: Array) -> tuple[Array, Array, Array]:
    """Line (2,), map frame, of an observed line (r, alpha), robot frame.

    Also returns its Jacobians w.r.t. the pose (2, 3) and the observation (2, 2).

    The inverse of `observe_line`; r >= 0 in the map, too.
    """
    x, y, theta = (float(v) for v in T_map_base)
    alpha = float(seen[1]) + theta
    c = math.cos(alpha)
    s = math.sin(alpha)
    r = float(seen[0]) + x * c + y * s
    sign = 1.0
    if r < 0.0:
        r = -r
        alpha = alpha + math.pi
        sign = -1.0
    turn = sign * (-x * s + y * c)
    by_pose = np.array([[sign * c, sign * s, turn], [0.0, 0.0, 1.0]])
    by_seen = np.array([[sign, turn], [0.0, 1.0]])
    return np.array([r, wrap(alpha)]), by_pose, by_seen
