"""Where odometry leads the robot from scan to scan, and how uncertain that is."""

from dataclasses import dataclass, field

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.models import odometry_variances
from thinmap_ros.core.odometry import OdometryIncrements
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import rotated_covariance
from thinmap_ros.core.slam.matching.scan_matcher import Match
from thinmap_ros.core.slam.motion_model import MotionConfig, MotionModel, MotionPrediction
from thinmap_ros.core.slam.odometry_calibration import OdometryCalibration


@dataclass(frozen=True, eq=False)
class Reversal:
    """What the next motion takes back of one that contradicted its scan, map frame.

    mean (3,), covariance (3, 3). A reading of the odometry that was wrong is put right by the next
    one, what wheels have slipped is not; one is as likely as the other.
    """

    mean: Array = field(default_factory=lambda: np.zeros(3))
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Pose T_map_base (3,) that the motion leads to, and its covariance (3, 3), map frame.

    motion: the increment in the robot frame; T_before (3,): where it began.
    """

    T_before: Array
    T_map_base: Array
    covariance: Array
    motion: MotionPrediction


class OdometryPrediction:
    """Predicts the pose of each scan by odometry, and learns the errors of the odometry."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._increments = OdometryIncrements()
        self._calibration = OdometryCalibration()
        self._model = MotionModel(config)
        self._reversal = Reversal()
        self._begins_known = False  # whether a match told where the next motion begins

    @property
    def rejected(self) -> int:
        """Odometry poses that made no sense."""
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
        """The pose of a scan with an odometry pose (3,), from where the robot was before (3,)."""
        motion = self._motion(scan, T_odom_base)
        reversal = self._reversal
        self._reversal = Reversal()
        expected = se2.compose(T_before, motion.increment) + reversal.mean
        covariance = rotated_covariance(motion.covariance, float(T_before[2])) + reversal.covariance
        return Prediction(T_before, se2.pose(*expected.tolist()), covariance, motion)

    def contradict(self, prediction: Prediction, match: Match, accepted: bool) -> None:
        """A match was unexpected: the next motion may take the contradiction back."""
        off = se2.pose_difference(match.T_map_base, prediction.T_map_base)
        mean = -0.5 * off if accepted else np.zeros(3)
        self._reversal = Reversal(mean, 0.25 * np.outer(off, off))

    def update(self, prediction: Prediction, match: Match) -> None:
        """A match that fits has told where the robot is, and so what odometry was off."""
        if self._begins_known:
            scan_information = rotated_covariance(
                match.scan_information, -float(prediction.T_before[2])
            )
            self._model.update(se2.between(prediction.T_before, match.T_map_base), scan_information)
        self._begins_known = True
        self._calibration.update(match.T_map_base, match.scan_information)

    def reset_segment(self) -> None:
        """The pose was not found but put, moved or lost: the next motion begins from elsewhere."""
        self._begins_known = False
        self._calibration.reset_segment()

    def _motion(self, scan: Scan, T_odom_base: Array) -> MotionPrediction:
        """The motion since the last scan, robot frame."""
        increment = self._increments.add(scan.stamp_ns, T_odom_base)
        variances = odometry_variances(increment.T_before_base, self._config)[[0, 2]]
        moved, systematic = self._calibration.corrected(increment.T_before_base, variances)
        motion = self._model.predict(moved, systematic)
        if increment.discontinuity_m == 0.0:
            return motion
        self._calibration.reset_segment()
        unknown = np.diag(np.square([increment.discontinuity_m, increment.discontinuity_m, 1.0]))
        return MotionPrediction(motion.increment, motion.covariance + unknown, False)
