"""Pose prediction by calibrated odometry from scan to scan, with its covariance."""

from dataclasses import dataclass, field, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.features import odometry_variances
from thinmap_ros.core.odometry import OdometryIncrement, OdometryIncrements
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, rotated_covariance, rotation
from thinmap_ros.core.slam.matching.scan_matcher import Match
from thinmap_ros.core.slam.motion_model import MotionConfig, MotionModel, MotionPrediction
from thinmap_ros.core.slam.odometry_calibration import OdometryCalibration


@dataclass(frozen=True, eq=False)
class Reversal:
    """Expected reversal of an odometry error by the next increment, in the robot frame before it.

    mean (3,), covariance (3, 3). The next reading reverses a wrong reading of the odometry, but
    not wheel slip. Both are assumed to be equally likely.
    """

    mean: Array = field(default_factory=lambda: np.zeros(3))
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Poses (3,) before a motion and, as predicted, after it, and covariance (3, 3) of the motion.

    In the frame of the pose before, the anchor's. motion: the increment in the robot frame;
    discontinuity: description of an odometry jump; '' without one.
    """

    before: Array
    prior: Array
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
        self._revision = 0

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

    def predict(
        self, scan: Scan, T_odom_base: Array, before: Array, revision: int = 0
    ) -> Prediction:
        """Predict the pose of a scan by its odometry pose (3,) and the previous pose (3,).

        revision: number of corrections of the map so far: matches before one are not compared with
        those after it.
        """
        if revision != self._revision:
            self._revision = revision
            self.reset_segment()
        increment = self._increments.add(scan, T_odom_base)
        motion = self._motion(increment)
        reversal = self._reversal
        self._reversal = Reversal()
        R = rotation(float(before[2]))
        expected = se2.compose(before, motion.increment) + R @ reversal.mean
        covariance = R @ (motion.covariance + reversal.covariance) @ R.T
        prior = se2.pose(*expected.tolist())
        return Prediction(before, prior, covariance, motion, increment.discontinuity)

    def contradict(self, prediction: Prediction, match: Match, accepted: bool) -> None:
        """Expect that the next increment may reverse the innovation of an unexpected match."""
        after = match.pose if accepted else prediction.prior
        off = rotation(-float(after[2])) @ se2.pose_difference(match.pose, prediction.prior)
        mean = -0.5 * off if accepted else np.zeros(3)
        self._reversal = Reversal(mean, 0.25 * np.outer(off, off))

    def update(self, prediction: Prediction, match: Match) -> None:
        """Update the odometry noise by a match with enough inliers, in the prediction's frame."""
        if self._begins_known:
            scan_information = rotated_covariance(
                match.scan_information, -float(prediction.before[2])
            )
            self._model.update(se2.between(prediction.before, match.pose), scan_information)
        self._begins_known = True

    def reset_segment(self) -> None:
        """Stop comparing odometry with matches across a pose that was set or lost."""
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
