"""Motion of a differential drive and observation of a line, with their Jacobians."""

import math
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.se2 import Array, wrap


@dataclass(frozen=True)
class MotionConfig(Config):
    """Noise of wheel odometry, 1 sigma.

    What grows with the way is given for one metre or radian and grows with its square root, so that
    the doubt after a drive does not depend on how many scans were taken on it.
    """

    odom_distance_sigma: float = parameter(
        0.05, 'distance error after one metre, m', low=0.0, high=2.0
    )
    odom_turn_sigma: float = parameter(
        0.2, 'turn error after turning by one radian, rad', low=0.0, high=2.0
    )
    odom_drift_sigma: float = parameter(0.1, 'turn error after one metre, rad', low=0.0, high=2.0)
    odom_slip_m: float = parameter(
        0.003, 'error of any increment, in each direction, m', low=1e-5, high=1.0
    )
    odom_slip_rad: float = parameter(0.003, 'error of any increment, rad', low=1e-5, high=1.0)


def odometry_variances(increment: Array, config: MotionConfig) -> Array:
    """Variances (2,) of chord, m^2, turn, rad^2, of an odometry increment (3,), without slip."""
    chord, turn = math.hypot(increment[0], increment[1]), abs(float(increment[2]))
    of_turn = config.odom_turn_sigma**2 * turn + config.odom_drift_sigma**2 * chord
    return np.array([config.odom_distance_sigma**2 * chord, of_turn])


def odometry_covariance(
    increment: Array, config: MotionConfig, shares: Array | None = None
) -> Array:
    """Covariance (3, 3) of an odometry increment (3,), in the robot frame before the motion.

    The inputs are the chord d that the robot moved and the angle phi that it turned: on an arc the
    increment is (d cos(phi/2), d sin(phi/2), phi). Their noise is independent; slip in any
    direction comes on top. shares (2,): what there is of the variances of chord and turn, without
    it all.
    Source: EKF-SLAM/TI paper eq. (11), the part F_u Q F_u'; differential-drive model after Siegwart
    and Nourbakhsh.
    """
    chord, turn = math.hypot(increment[0], increment[1]), float(increment[2])
    backward = increment[0] * math.cos(turn / 2.0) + increment[1] * math.sin(turn / 2.0) < 0.0
    d = -chord if backward else chord
    c, s = math.cos(turn / 2.0), math.sin(turn / 2.0)
    G = np.array([[c, -0.5 * d * s], [s, 0.5 * d * c], [0.0, 1.0]])
    variances = odometry_variances(increment, config) * (1.0 if shares is None else shares)
    slip = np.square([config.odom_slip_m, config.odom_slip_m, config.odom_slip_rad])
    scaled = G * np.sqrt(variances)
    return np.asarray(scaled @ scaled.T + np.diag(slip))


def rotation(theta: float) -> Array:
    """(3, 3): turns increments, and by R C R' covariances, from the robot frame to theta's."""
    c, s = math.cos(theta), math.sin(theta)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def motion_jacobians(T_map_base: Array, increment: Array) -> tuple[Array, Array]:
    """F_x and F_u, (3, 3) each, of T_map_base o increment.

    Source: EKF-SLAM/TI paper eqs. (10), (11).
    """
    F_u = rotation(float(T_map_base[2]))
    dx, dy, _ = F_u @ increment
    F_x = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    return F_x, F_u


def observe_line(T_map_base: Array, line: Array) -> tuple[Array, Array, Array]:
    """A map line (r, alpha) as the robot sees it.

    Prediction (2,), Jacobians by pose (2, 3) and by line (2, 2).

    Source: EKF-SLAM/TI paper eq. (3), lost in the text; with x cos(alpha) + y sin(alpha) = r it is
    r^R = r - (x cos(alpha) + y sin(alpha)), alpha^R = alpha - theta,
    and where r^R < 0: -r^R, alpha^R + pi.
    """
    x, y, theta = (float(v) for v in T_map_base)
    r, alpha = float(line[0]), float(line[1])
    c, s = math.cos(alpha), math.sin(alpha)
    distance, bearing, sign = r - (x * c + y * s), alpha - theta, 1.0
    if distance < 0.0:
        distance, bearing, sign = -distance, bearing + math.pi, -1.0
    by_pose = np.array([[-sign * c, -sign * s, 0.0], [0.0, 0.0, -1.0]])
    by_line = np.array([[sign, sign * (x * s - y * c)], [0.0, 1.0]])
    return np.array([distance, wrap(bearing)]), by_pose, by_line


def place_line(T_map_base: Array, seen: Array) -> tuple[Array, Array, Array]:
    """A line (r, alpha) seen by the robot, in the map.

    Line (2,), Jacobians by pose (2, 3) and by what was seen (2, 2).

    The inverse of `observe_line`; r >= 0 in the map as well.
    """
    x, y, theta = (float(v) for v in T_map_base)
    alpha = float(seen[1]) + theta
    c, s = math.cos(alpha), math.sin(alpha)
    r, sign = float(seen[0]) + x * c + y * s, 1.0
    if r < 0.0:
        r, alpha, sign = -r, alpha + math.pi, -1.0
    turn = sign * (-x * s + y * c)
    by_pose = np.array([[sign * c, sign * s, turn], [0.0, 0.0, 1.0]])
    by_seen = np.array([[sign, turn], [0.0, 1.0]])
    return np.array([r, wrap(alpha)]), by_pose, by_seen
