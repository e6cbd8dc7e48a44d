"""Whether scans agree with the map: tracking, lost in a new local map, or not yet placed in one."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import propagated_covariance, rotated_covariance
from thinmap_ros.core.slam.matching.scan_matcher import Match
from thinmap_ros.core.slam.odometry_prediction import Prediction

FOR_A_SLIP = 3.0  # points that fit, for one that contradicts, where scan and motion disagree
_ADRIFT_M = 10.0  # path in a new local map after which it is part of the map for good
_UNPLACED_EVIDENCE = 0.5  # of a robot that has been put into a map: a scan or two that fit


@dataclass(frozen=True, eq=False)
class DeadReckoning:
    """Where the motion alone leads since a scan agreed with the map: pose (3,), cov. (3, 3)."""

    T_map_base: Array
    covariance: Array

    def moved(self, prediction: Prediction) -> 'DeadReckoning':
        """The same after one more motion."""
        motion = prediction.motion
        after = se2.compose(self.T_map_base, motion.increment)
        Q = rotated_covariance(motion.covariance, float(self.T_map_base[2]))
        lever = after[:2] - self.T_map_base[:2]
        return DeadReckoning(after, propagated_covariance(self.covariance, lever) + Q)


class Tracking:
    """Evidence against the map.

    A cumulative sum of the share of points that contradict the map, less a third of those that fit.
    Source: Page, "Continuous inspection schemes", 1954.
    """

    def __init__(self, lost_threshold: float, least_fit: float, T_map_base: Array) -> None:
        self.evidence = 0.0
        self.is_delocalized = False  # in a map that was given, or put somewhere by hand
        self.dead_reckoned = DeadReckoning(T_map_base, np.zeros((3, 3)))
        self._lost_evidence = lost_threshold
        self._least_fit = least_fit
        self._provisional_path_m = 0.0  # path for which a new local map is not yet part of the map

    @property
    def agrees(self) -> bool:
        """Whether nothing speaks against the map."""
        return self.evidence == 0.0

    @property
    def is_lost(self) -> bool:
        """Whether the pose is in no map that others know."""
        return self._provisional_path_m > 0.0 or (self.is_delocalized and self.evidence > 0.0)

    @property
    def needs_submap(self) -> bool:
        """Whether scans contradict the map for good."""
        return self.evidence > self._lost_evidence

    def update(self, match: Match | None) -> None:
        """Update the evidence by a match; None: nothing could be matched, and nothing is told."""
        if match is None:
            return
        more = match.contradiction_ratio - match.inlier_ratio / FOR_A_SLIP
        self.evidence = max(self.evidence + more, 0.0)
        if self.is_delocalized:
            self.evidence = min(self.evidence, self._lost_evidence)
            self.is_delocalized = self.evidence > 0.0 or match.inlier_ratio < self._least_fit

    def record_pose(self, T_map_base: Array, covariance: Array) -> None:
        """The pose of this scan is (3,): dead reckoning begins there where the map agrees."""
        if self.agrees:
            self.dead_reckoned = DeadReckoning(T_map_base, covariance)

    def place(self, T_map_base: Array, covariance: Array) -> None:
        """The robot was put at a pose (3,) with covariance (3, 3)."""
        self.is_delocalized = True
        self._provisional_path_m = 0.0
        self.evidence = 0.0
        self.dead_reckoned = DeadReckoning(T_map_base, covariance)

    def start_delocalized(self) -> None:
        """A map was given, and the robot is somewhere in it."""
        self.is_delocalized = True
        self.evidence = _UNPLACED_EVIDENCE

    def start_submap(self) -> None:
        """Continue in a new local map."""
        self.evidence = 0.0
        self._provisional_path_m = _ADRIFT_M

    def add_path(self, path_m: float) -> None:
        """The map has grown after a path of this length, m."""
        self._provisional_path_m = max(self._provisional_path_m - path_m, 0.0)

    def join(self, T_map_base: Array) -> None:
        """A loop was closed: the new local map is part of the map, the pose is (3,)."""
        self._provisional_path_m = 0.0
        self.dead_reckoned = DeadReckoning(T_map_base, self.dead_reckoned.covariance)
