"""The pose graph of the keyframes, and its optimization, a slice of an iteration per step."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframes
from thinmap_ros.core.slam.graph.pose_graph import EdgeArrays, last, rounds
from thinmap_ros.core.slam.graph.tables import EdgeTable
from thinmap_ros.core.slam.odometry import OdometryCalibration
from thinmap_ros.core.stage import Correction

_MIN_MOVE_M = 0.1  # smallest move of a keyframe for which the map follows the calibration


class KeyframeGraph:
    """Moves the keyframes as the edges between them and the calibration of the odometry have it.

    edges: those between visits; the keyframes hold their steps and headings.
    """

    def __init__(self, keyframes: Keyframes, calibration: OdometryCalibration) -> None:
        """calibration: of the odometry, as another part estimates it."""
        self._keyframes = keyframes
        self._calibration = calibration
        self.edges = EdgeTable()
        # The optimization in progress: None after each slice, and the correction at its end.
        self._slices: Iterator[Correction | None] | None = None

    @property
    def is_moving(self) -> bool:
        """Whether an optimization is in progress."""
        return self._slices is not None

    def optimize(self, start: Array | None = None) -> None:
        """Begin an optimization, at poses (N, 3); None: at the present ones."""
        self._calibrate(self._calibration.smoothed())
        poses = self._keyframes.poses() if start is None else start
        self._slices = self._moved(rounds(poses, self._all_edges()), poses)

    def optimized(self) -> Array:
        """Poses (N, 3) of the keyframes after a whole optimization, which does not move them."""
        self._calibrate(self._calibration.smoothed())
        return last(rounds(self._keyframes.poses(), self._all_edges()))

    def step(self) -> Correction | None:
        """Do one slice; returns the correction of the keyframes after the last one."""
        if self._slices is None:
            return None
        try:
            correction = next(self._slices)
        except StopIteration:
            correction = None
            self._slices = None
        if correction is not None:
            self._slices = None
        return correction

    def follow_calibration(self) -> None:
        """Begin to move the poses by what is newly known of the calibration, and by nothing else.

        The maps of loops that were accepted without an optimization agree within their noise. What
        remains of their errors is no news: it stays until a loop closes.
        """
        if self._is_calibration_new():
            self._slices = self._followed(self._calibration.smoothed())
            self.step()

    def _moved(self, moving: Iterator[Array], poses: Array) -> Iterator[Correction | None]:
        """Slices of an optimization, from poses (N, 3)."""
        for after in moving:
            poses = after
            yield None
        # Keyframes that were added during the optimization move with their anchors.
        for added in self._keyframes.steps[len(poses) - 1 :]:
            poses = np.vstack([poses, se2.compose(poses[added.a], added.T_a_b)])
        before = self._keyframes.poses()
        for _ in self._keyframes.move(poses, self.edges):
            yield None
            before = self._keyframes.poses()
        yield Correction(before, self._keyframes.poses())

    def _followed(self, parameters: Array) -> Iterator[Correction | None]:
        """Slices of a move by parameters (N, 4); none after the first iteration if it is small."""
        poses = self._keyframes.poses()
        anchor = self._keyframes.anchor  # others may be added between the slices
        now = self._all_edges()
        settled = now.settled(poses)
        change = self._all_edges(parameters).T_a_b - now.T_a_b
        moving = rounds(poses, replace(settled, T_a_b=settled.T_a_b + change))
        moved = poses
        for moved in moving:
            if not np.array_equal(moved, poses):
                break  # the first iteration is complete
            yield None
        self._calibration.applied = parameters[-1]
        if math.dist(moved[anchor, :2], poses[anchor, :2]) > _MIN_MOVE_M:
            self._calibrate(self._calibration.smoothed())
            yield None
            yield from self._moved(moving, moved)

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
        self.edges.calibrate(parameters)
        self._calibration.applied = parameters[-1]

    def _all_edges(self, parameters: Array | None = None) -> EdgeArrays:
        """All edges, as they are or would be with parameters (N, 4) of the calibration."""
        keyframes = self._keyframes
        return EdgeArrays.joined(
            [
                keyframes.steps.arrays(parameters),
                self.edges.arrays(parameters),
                keyframes.headings(parameters),
            ]
        )
