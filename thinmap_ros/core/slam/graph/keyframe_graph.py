"""The pose graph of the keyframes, and its optimization, one iteration per step."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.estimate import Correction
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframes
from thinmap_ros.core.slam.graph.pose_graph import Edge, optimized, rounds
from thinmap_ros.core.slam.odometry_calibration import OdometryCalibration

_MIN_MOVE_M = 0.1  # smallest move of a keyframe for which the map follows the calibration


@dataclass(eq=False)
class _Optimization:
    """An optimization in progress: its rounds, and the poses (N, 3) after the last one."""

    rounds: Iterator[Array]
    poses: Array


class KeyframeGraph:
    """Moves the keyframes as the edges between them and the calibration of the odometry have it.

    edges: those between visits; the keyframes hold their steps and headings.
    """

    def __init__(self, keyframes: Keyframes, calibration: OdometryCalibration) -> None:
        """calibration: of the odometry, as another part estimates it."""
        self._keyframes = keyframes
        self._calibration = calibration
        self.edges: list[Edge] = []
        self._optimization: _Optimization | None = None

    @property
    def is_moving(self) -> bool:
        """Whether an optimization is in progress."""
        return self._optimization is not None

    def optimize(self, start: Array | None = None) -> None:
        """Begin an optimization, at poses (N, 3); None: at the present ones."""
        self._calibrate(self._calibration.smoothed())
        poses = self._keyframes.poses() if start is None else start
        self._optimization = _Optimization(rounds(poses, self._all_edges), poses)

    def optimized(self) -> Array:
        """Poses (N, 3) of the keyframes after a whole optimization, which does not move them."""
        self._calibrate(self._calibration.smoothed())
        return optimized(self._keyframes.poses(), self._all_edges)

    def step(self) -> Correction | None:
        """Do one iteration; returns the correction of the keyframes after the last one."""
        optimization = self._optimization
        if optimization is None:
            return None
        after = next(optimization.rounds, None)
        if after is not None:
            optimization.poses = after
            return None
        self._optimization = None
        poses = optimization.poses
        # Keyframes that were added during the optimization move with their anchors.
        for added in self._keyframes.steps[len(poses) - 1 :]:
            poses = np.vstack([poses, se2.compose(poses[added.a], added.T_a_b)])
        before = self._keyframes.poses()
        self._keyframes.move(poses, self.edges)
        return Correction(before, poses)

    def follow_calibration(self) -> None:
        """Begin to move the poses by what is newly known of the calibration, and by nothing else.

        The maps of loops that were accepted without an optimization agree within their noise. What
        remains of their errors is no news: it stays until a loop closes.
        """
        if not self._is_calibration_new():
            return
        parameters = self._calibration.smoothed()
        poses = self._keyframes.poses()
        settled = [edge.settled(poses, parameters) for edge in self._all_edges]
        moving = rounds(poses, settled)
        moved = next(moving)
        self._calibration.applied = parameters[-1]
        last = self._keyframes.anchor
        if math.dist(moved[last, :2], poses[last, :2]) > _MIN_MOVE_M:
            self._calibrate(parameters)
            self._optimization = _Optimization(moving, moved)

    def _is_calibration_new(self) -> bool:
        """Whether the calibration may move the last keyframe by more than it is uncertain itself.

        The parameters have a random walk: what they are now is not what they were.
        """
        if len(self._keyframes) < 2:
            return False
        by = self._keyframes.frames[self._keyframes.anchor].systematic[:2]
        off = by @ (self._calibration.parameters - self._calibration.applied)
        variance = float(np.trace(self._calibration.covariance_of(by)))
        return float(off @ off) > max(_MIN_MOVE_M**2, variance)

    def _calibrate(self, parameters: Array) -> None:
        """Correct the edges by parameters (N, 4) of the calibration."""
        self._keyframes.calibrate(parameters)
        self.edges = [edge.calibrated(parameters) for edge in self.edges]
        self._calibration.applied = parameters[-1]

    @property
    def _all_edges(self) -> list[Edge]:
        return self._keyframes.steps + self.edges + self._keyframes.headings
