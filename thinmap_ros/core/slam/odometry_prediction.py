"""Pose prediction by calibrated odometry from scan to scan, with its covariance."""

from dataclasses import dataclass, field, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.covariances import rotated_covariance
from thinmap_ros.core.ekf_slam.models import odometry_variances
from thinmap_ros.core.odometry import OdometryIncrement, OdometryIncrements
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.matching.scan_matcher import Match
from thinmap_ros.core.slam.motion_model import MotionConfig, MotionModel, MotionPrediction
from thinmap_ros.core.slam.odometry_calibration import OdometryCalibration


@dataclass(frozen=True, eq=False)
class Reversal:
    """Expected reversal of an odometry error by the next increment, map frame.

    mean (3,), covariance (3, 3). The next reading reverses a wrong reading of the odometry, but
    not wheel slip. Both are assumed to be equally likely.
    """

    mean: Array = field(default_factory=lambda: np.zeros(3))
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted pose T_map_base (3,), and covariance (3, 3) of its motion, map frame.

    motion: the increment in the robot frame; T_before (3,): pose before the motion, map frame;
    discontinuity: description of an odometry jump; '' without one.
    """

    T_before: Array
    T_map_base: Array
    covariance: Array
    motion: MotionPrediction
    discontinuity: str


class OdometryPrediction:
    """Predicts the pose of each scan by odometry, and estimates the errors of the odometry."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._increments = OdometryIncrements()
        self.calibration = OdometryCalibration()
        self._model = MotionModel(config)
        self._reversal = Reversal()
        self._begins_known = False  # whether the next motion starts at a matched pose

    @property
    def rejected(self) -> int:
        """Number of odometry poses with invalid values."""
        return self._increments.rejected

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last scan."""
        return self._increments.stamp_ns

    @property
    def T_odom_base(self) -> Array:  # noqa: N802
        """Odometry pose (3,) of the last scan."""
        return self._increments.T_odom_base

    def predict(self, scan: Scan, T_odom_base: Array, T_before: Array) -> Prediction:
        """Predict the pose of a scan by its odometry pose (3,) and the previous pose (3,)."""
        increment = self._increments.add(scan, T_odom_base)
        motion = self._motion(increment)
        reversal = self._reversal
        self._reversal = Reversal()
        expected = se2.compose(T_before, motion.increment) + reversal.mean
        covariance = rotated_covariance(motion.covariance, float(T_before[2])) + reversal.covariance
        T_map_base = se2.pose(*expected.tolist())
        return Prediction(T_before, T_map_base, covariance, motion, increment.discontinuity)

    def contradict(self, prediction: Prediction, match: Match, accepted: bool) -> None:
        """Expect that the next increment may reverse the innovation of an unexpected match."""
        off = se2.pose_difference(match.T_map_base, prediction.T_map_base)
        mean = -0.5 * off if accepted else np.zeros(3)
        self._reversal = Reversal(mean, 0.25 * np.outer(off, off))

    def update(self, prediction: Prediction, match: Match, systematic: Array) -> None:
        """Update the odometry noise and calibration by a match with enough inliers.

        systematic (3, 4): derivative of the matched pose by the calibration, map frame.
        """
        if self._begins_known:
            scan_information = rotated_covariance(
                match.scan_information, -float(prediction.T_before[2])
            )
            self._model.update(se2.between(prediction.T_before, match.T_map_base), scan_information)
        self._begins_known = True
        self.calibration.update(match.T_map_base, match.scan_information, systematic)

    def reset_segment(self) -> None:
        """Stop comparing odometry with matches across a pose that was set, corrected or lost."""
        self._begins_known = False
        self.calibration.reset_segment()

    def _motion(self, increment: OdometryIncrement) -> MotionPrediction:
        """Motion since the last scan, robot frame; wide after an odometry discontinuity."""
        variances = odometry_variances(increment.T_before_base, self._config)[[0, 2]]
        moved, G = self.calibration.corrected(increment.T_before_base, variances)
        motion = self._model.predict(moved, G @ self.calibration.covariance @ G.T)
        if increment.discontinuity_m == 0.0:
            return replace(motion, by_calibration=G)
        self.calibration.reset_segment()
        unknown = np.diag(np.square([increment.discontinuity_m, increment.discontinuity_m, 1.0]))
        return MotionPrediction(motion.increment, motion.covariance + unknown, False)
