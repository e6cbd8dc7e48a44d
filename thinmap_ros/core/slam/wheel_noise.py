"""Noise of wheel odometry of the localizer before, `--core ekf`."""

import math
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.se2 import Array


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
