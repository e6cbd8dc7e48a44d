"""Where the robot is, relative to the last keyframe scan: its anchor.

A correction of the keyframes moves the anchor, and thereby all that is relative to it: nothing here
has to be told.
"""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array, propagated_covariance, rotated_covariance
from thinmap_ros.core.slam.covariance import PoseUncertainty
from thinmap_ros.core.slam.map_evidence import MapEvidence
from thinmap_ros.core.slam.odometry_prediction import Prediction


@dataclass(frozen=True, eq=False)
class DeadReckoning:
    """Dead-reckoned pose (3,) since the last scan that agreed, with covariance (3, 3)."""

    T_anchor_base: Array
    covariance: Array

    def moved(self, prediction: Prediction) -> 'DeadReckoning':
        """The dead-reckoned pose after the motion of a prediction."""
        motion = prediction.motion
        before = self.T_anchor_base
        after = se2.compose(before, motion.increment)
        Q = rotated_covariance(motion.covariance, float(before[2]))
        lever = after[:2] - before[:2]
        return DeadReckoning(after, propagated_covariance(self.covariance, lever) + Q)

    def seen_from(self, T_old_new: Array) -> 'DeadReckoning':
        """The same relative to another anchor, at a pose (3,) relative to the present one."""
        return DeadReckoning(
            se2.between(T_old_new, self.T_anchor_base),
            rotated_covariance(self.covariance, -float(T_old_new[2])),
        )


class Track:
    """Pose of the robot relative to the anchor, T_anchor_base (3,), and what is known of it.

    uncertainty, reckoned, T_anchor_update: relative to the anchor, too; the last is the pose of the
    scan that was last added to the map, None before the first. evidence: against the map.
    """

    def __init__(self, T_anchor_base: Array, evidence: MapEvidence) -> None:
        self.T_anchor_base = T_anchor_base
        self.uncertainty = PoseUncertainty(T_anchor_base)
        self.evidence = evidence
        self.reckoned = DeadReckoning(T_anchor_base, np.zeros((3, 3)))
        self.T_anchor_update: Array | None = None

    @property
    def since_update(self) -> Array | None:
        """Motion (3,) since the last map update; None before the first."""
        update = self.T_anchor_update
        return None if update is None else se2.between(update, self.T_anchor_base)

    def place(self, T_anchor_base: Array, covariance: Array) -> None:
        """Set the pose (3,) with covariance (3, 3), relative to any anchor, without any motion."""
        self.T_anchor_base = T_anchor_base
        self.T_anchor_update = None
        self.uncertainty.place(T_anchor_base, covariance)
        self.reckoned = DeadReckoning(T_anchor_base, self.uncertainty.since_match)

    def record_agreement(self) -> None:
        """Restart dead reckoning at the pose of this scan if the scan agrees with the map."""
        if self.evidence.agrees:
            self.reckoned = DeadReckoning(self.T_anchor_base, self.uncertainty.since_match)

    def turn(self, T_anchor_base: Array) -> None:
        """Set the pose (3,) after its heading was measured by other means than the map."""
        self.T_anchor_base = T_anchor_base
        self.uncertainty.T_moved = T_anchor_base
        self.record_agreement()

    def begin_step(self) -> None:
        """Make the present pose the anchor: a keyframe scan."""
        T_old_new = self.T_anchor_base
        self.T_anchor_base = np.zeros(3)
        self.uncertainty.start_step(T_old_new)
        self.reckoned = self.reckoned.seen_from(T_old_new)
        if self.T_anchor_update is not None:
            self.T_anchor_update = se2.between(T_old_new, self.T_anchor_update)
