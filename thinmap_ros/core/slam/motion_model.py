"""The motion that odometry predicts from one scan to the next, and how uncertain it is.

The innovations of scan matching scale the noise of the odometry model, separately for translation
and rotation. So an odometry that slips, lags or lacks rotation gets a larger covariance.
Source: Mehra, "On the identification of variances and adaptive Kalman filtering", 1970;
Siegwart and Nourbakhsh, "Introduction to autonomous mobile robots", for the odometry's noise.
"""

from dataclasses import dataclass, field

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import parameter
from thinmap_ros.core.ekf_slam.features import OdometryConfig, odometry_slip, odometry_variances
from thinmap_ros.core.se2 import Array


@dataclass(frozen=True)
class MotionConfig(OdometryConfig):
    """Parameters of the odometry noise, and of its adaptation to scan matching.

    Besides the parameters: min_scale of the modelled variance, as good wheels slip, too; a motion
    within stationary_sigmas of the noise floor is none; below corridor_ratio of the information
    across a corridor, the information along it is that of a smooth one.
    """

    noise_window: float = parameter(
        20.0,
        'Number of scans over which the odometry noise is estimated. Raise it for a steadier '
        'estimate, lower it to follow changes of the floor sooner.',
        low=1.0,
        high=1e4,
    )
    min_scale: float = 1.0
    stationary_sigmas: float = 3.0
    corridor_ratio: float = 0.2


@dataclass(frozen=True, eq=False)
class MotionPrediction:
    """Increment (3,) and its covariance (3, 3), in the robot frame before it.

    is_stationary: whether the increment is within the noise floor of the odometry; by_calibration
    (3, 4): derivative of the increment by the parameters of the calibration.
    """

    increment: Array
    covariance: Array
    is_stationary: bool
    by_calibration: Array = field(default_factory=lambda: np.zeros((3, 4)))


def _distinctness(information: Array, corridor_ratio: float) -> Array:
    """Weight (2,), 0 to 1, of a scan's innovation in x and y, by its information (3, 3).

    Along a smooth corridor the information of a match is overconfident, and its innovation is no
    error of the odometry.
    """
    own = np.diag(information)[:2]
    return np.asarray(np.minimum(own / max(corridor_ratio * float(own.max()), 1e-12), 1.0))


class MotionModel:
    """Predicts the motion between two scans, and adapts its noise to the innovations of matches."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._share: Array = np.ones(2)  # scale of the variances of translation and rotation
        self._learned = 0  # number of updates
        self._allowed: Array = np.ones(3)
        self._expected: Array = np.zeros(3)

    def predict(self, increment: Array, systematic: Array) -> MotionPrediction:
        """Predict the motion since the previous scan by the odometry increment (3,).

        systematic (3, 3): covariance of the residual systematic error of the odometry.
        """
        config = self._config
        self._expected = increment
        self._allowed = odometry_variances(increment, config) + np.diag(systematic)
        moves = np.abs(increment) > config.stationary_sigmas * odometry_slip(config)
        return MotionPrediction(increment, np.diag(self._variances), not moves.any())

    def update(self, found: Array, scan_information: Array) -> None:
        """Adapt the noise to a matched motion (3,); information (3, 3) of the scan, robot frame."""
        # Variance of the motion as the scan measures it.
        variance = 1.0 / np.maximum(np.diag(scan_information), 1e-12)
        gain = self._variances / (self._variances + variance)
        innovation = found - self._expected
        innovation[2] = se2.wrap(float(innovation[2]))
        # The match is a posterior: it has moved the pose by `gain` times the scan's innovation.
        squared = np.square(innovation / gain)
        beyond = np.maximum(squared - variance, 0.0)  # not explained by the noise of the scan
        share = self._share[[0, 0, 1]]
        # A larger innovation is an outlier, such as a single slip: its effect is limited.
        change = (
            np.minimum(beyond / self._allowed, self._config.stationary_sigmas**2 * share) - share
        )
        change *= np.maximum(gain**2, beyond / np.maximum(squared, 1e-12))
        change[:2] *= np.where(
            change[:2] > 0.0, _distinctness(scan_information, self._config.corridor_ratio), 1.0
        )
        self._learned += 1
        rate = max(1.0 / self._config.noise_window, 1.0 / (1.0 + self._learned))
        self._share[0] += rate * 0.5 * (change[0] + change[1])
        self._share[1] += rate * change[2]
        np.maximum(self._share, self._config.min_scale, out=self._share)

    @property
    def _variances(self) -> Array:
        return np.asarray(self._allowed * self._share[[0, 0, 1]])
