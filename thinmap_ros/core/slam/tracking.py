"""Whether scans agree with the map: tracking, lost in a new local map, or not yet placed in one."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import carried, turned
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
        Q = turned(motion.covariance, float(self.T_map_base[2]))
        lever = after[:2] - self.T_map_base[:2]
        return DeadReckoning(after, carried(self.covariance, lever) + Q)


class Tracking:
    """Evidence against the map.

    A cumulative sum of the share of points that contradict the map, less a third of those that fit.
    Source: Page, "Continuous inspection schemes", 1954.
    """

    def __init__(self, lost_threshold: float, least_fit: float, T_map_base: Array) -> None:
        self.evidence = 0.0
        self.is_unplaced = False  # in a map that was given, or put somewhere by hand
        self.reckoned = DeadReckoning(T_map_base, np.zeros((3, 3)))
        self._lost_evidence = lost_threshold
        self._least_fit = least_fit
        self._adrift_m = 0.0  # path for which a new local map is not yet part of the map

    @property
    def agrees(self) -> bool:
        """Whether nothing speaks against the map."""
        return self.evidence == 0.0

    @property
    def is_lost(self) -> bool:
        """Whether the pose is in no map that others know."""
        return self._adrift_m > 0.0 or (self.is_unplaced and self.evidence > 0.0)

    @property
    def needs_new_map(self) -> bool:
        """Whether scans contradict the map for good."""
        return self.evidence > self._lost_evidence

    def judge(self, match: Match | None) -> None:
        """Update the evidence by a match; None: nothing could be matched, and nothing is told."""
        if match is None:
            return
        more = match.contradicted - match.fit / FOR_A_SLIP
        self.evidence = max(self.evidence + more, 0.0)
        if self.is_unplaced:
            self.evidence = min(self.evidence, self._lost_evidence)
            self.is_unplaced = self.evidence > 0.0 or match.fit < self._least_fit

    def note(self, T_map_base: Array, covariance: Array) -> None:
        """The pose of this scan is (3,): dead reckoning begins there where the map agrees."""
        if self.agrees:
            self.reckoned = DeadReckoning(T_map_base, covariance)

    def place(self, T_map_base: Array, covariance: Array) -> None:
        """The robot was put at a pose (3,) with covariance (3, 3)."""
        self.is_unplaced = True
        self._adrift_m = 0.0
        self.evidence = 0.0
        self.reckoned = DeadReckoning(T_map_base, covariance)

    def begin_in_map(self) -> None:
        """A map was given, and the robot is somewhere in it."""
        self.is_unplaced = True
        self.evidence = _UNPLACED_EVIDENCE

    def begin_submap(self) -> None:
        """Continue in a new local map."""
        self.evidence = 0.0
        self._adrift_m = _ADRIFT_M

    def travel(self, path_m: float) -> None:
        """The map has grown after a path of this length, m."""
        self._adrift_m = max(self._adrift_m - path_m, 0.0)

    def join(self, T_map_base: Array) -> None:
        """A loop was closed: the new local map is part of the map, the pose is (3,)."""
        self._adrift_m = 0.0
        self.reckoned = DeadReckoning(T_map_base, self.reckoned.covariance)
