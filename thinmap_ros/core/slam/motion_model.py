"""The motion that odometry predicts from one scan to the next, and how uncertain it is.

How far odometry was off what the scans found is remembered, for translation and rotation, and
scales the noise that its model allows: an odometry that slips, lags or does not turn at all counts
less, without any rule for it.
Source: Mehra, "On the identification of variances and adaptive Kalman filtering", 1970;
Siegwart and Nourbakhsh, "Introduction to autonomous mobile robots", for the odometry's noise.
"""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import parameter
from thinmap_ros.core.ekf_slam.models import OdometryConfig, odometry_slip, odometry_variances
from thinmap_ros.core.se2 import Array

_MOST_SIGMAS = 3.0
# Ratio of the information along walls to that across them, above which it is no smooth corridor.
_CORRIDOR_RATIO = 0.2
_LEAST_SHARE = 1.0  # of the variance that the model allows: good wheels slip, too


@dataclass(frozen=True)
class MotionConfig(OdometryConfig):
    """Noise of the motion, 1 sigma, as it is taken to be before the scans have told."""

    noise_window: float = parameter(
        20.0,
        'Number of scans over which the odometry noise is estimated. Raise it for a steadier '
        'estimate, lower it to follow changes of the floor sooner.',
        low=1.0,
        high=1e4,
    )


@dataclass(frozen=True, eq=False)
class MotionPrediction:
    """Increment (3,) and its covariance (3, 3), in the robot frame before it.

    stands: whether it is no more than the slip of a robot that stands.
    """

    increment: Array
    covariance: Array
    is_stationary: bool


def _distinctness(information: Array) -> Array:
    """How far a scan is to be believed on each coordinate of the position (2,): 0 to 1.

    Along a smooth corridor it tells little, and errs by more than its information claims: what it
    moves a robot by there is no error of the odometry.
    """
    own = np.diag(information)[:2]
    return np.asarray(np.minimum(own / max(_CORRIDOR_RATIO * float(own.max()), 1e-12), 1.0))


class MotionModel:
    """Predicts the motion between two scans, and learns its noise from where they were matched."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._share: Array = np.ones(2)  # of the allowed variances, of translation and rotation
        self._learned = 0  # motions that scans have told
        self._allowed: Array = np.ones(3)
        self._expected: Array = np.zeros(3)

    def predict(self, increment: Array, systematic: Array) -> MotionPrediction:
        """Motion since the scan before, by the increment (3,) of the odometry.

        systematic (3, 3): covariance of what is left of the odometry's systematic error.
        """
        config = self._config
        self._expected = increment
        self._allowed = odometry_variances(increment, config) + np.diag(systematic)
        moves = np.abs(increment) > _MOST_SIGMAS * odometry_slip(config)
        return MotionPrediction(increment, np.diag(self._variances), not moves.any())

    def update(self, found: Array, scan_information: Array) -> None:
        """A scan found the motion (3,) to be that, with information (3, 3), robot frame."""
        # Of the motion as the scan measures it.
        variance = 1.0 / np.maximum(np.diag(scan_information), 1e-12)
        gain = self._variances / (self._variances + variance)
        innovation = found - self._expected
        innovation[2] = se2.wrap(float(innovation[2]))
        # The match has moved the pose by that share of what the scan alone says.
        squared = np.square(innovation / gain)
        beyond = np.maximum(squared - variance, 0.0)  # what the scan's own error does not explain
        share = self._share[[0, 0, 1]]
        # What is farther off has slipped once, and says no more than this of the noise.
        change = np.minimum(beyond / self._allowed, _MOST_SIGMAS**2 * share) - share
        change *= np.maximum(gain**2, beyond / np.maximum(squared, 1e-12))
        change[:2] *= np.where(change[:2] > 0.0, _distinctness(scan_information), 1.0)
        self._learned += 1
        rate = max(1.0 / self._config.noise_window, 1.0 / (1.0 + self._learned))
        self._share[0] += rate * 0.5 * (change[0] + change[1])
        self._share[1] += rate * change[2]
        np.maximum(self._share, _LEAST_SHARE, out=self._share)

    @property
    def _variances(self) -> Array:
        return np.asarray(self._allowed * self._share[[0, 0, 1]])
