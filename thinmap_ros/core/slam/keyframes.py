"""Keyframes: scans that are kept along the path, and what their poses are known to.

Where the robot comes back to what it has mapped before, and both agree, an earlier keyframe is
reused: their number follows the area, not the time.
Source: Johannsson, Kaess, Fallon and Leonard, "Temporally scalable visual SLAM using a reduced pose
graph", 2013.
"""

import heapq
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.grid.buckets import Buckets
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.anchors import AnchoredPoses
from thinmap_ros.core.slam.edges import Edge

_BUCKET_M = 4.0
_RADIAN_M = 1.0  # a radian of turn makes two scans as different as so many metres


@dataclass(frozen=True)
class KeyframeConfig(Config):
    """Parameters of keyframes."""

    keyframe_m: float = parameter(
        0.7, 'a scan is kept after a path of this length, m', low=0.1, high=10.0
    )
    keyframe_rad: float = parameter(0.7, 'or after a turn by this, rad', low=0.1, high=3.2)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A scan that is kept, its points (N, 2), robot frame, and its pose (3,).

    path_m: length of the path when the robot was there last; covariance (3, 3): of the pose, map
    frame; submap: number of the local map that it is part of.
    """

    scan: Scan
    points_base: Array
    T_map_base: Array
    path_m: float
    covariance: Array
    submap: int


class Keyframes:
    """The keyframes, the steps between them, and the path that is told by them."""

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self.frames: list[Keyframe] = []
        self.steps: list[Edge] = []  # to each keyframe but the first, from its anchor
        self._buckets = Buckets(_BUCKET_M)
        self._path = AnchoredPoses()

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def anchor(self) -> int:
        """Number of the keyframe that the robot was at last; -1 before the first."""
        return self._path.last

    def keep(self, frame: Keyframe, step_covariance: Array) -> int:
        """Make a scan a keyframe; returns its number.

        step_covariance (3, 3): of its pose seen from the anchor's, in the frame of the anchor.
        """
        number = len(self.frames)
        if number:
            anchor = self.anchor
            T = se2.between(self.frames[anchor].T_map_base, frame.T_map_base)
            self.steps.append(Edge(anchor, number, T, inverse(step_covariance), False))
        self.frames.append(frame)
        self._buckets.put(number, float(frame.T_map_base[0]), float(frame.T_map_base[1]))
        self._path.add(frame.scan.stamp_ns, number, np.zeros(3))
        return number

    def reuse(self, number: int, frame: Keyframe) -> None:
        """Have an earlier keyframe stand for a scan that sees about the same."""
        earlier = self.frames[number]
        self.frames[number] = replace(earlier, path_m=frame.path_m)
        offset = se2.between(earlier.T_map_base, frame.T_map_base)
        self._path.add(frame.scan.stamp_ns, number, offset)

    def poses(self) -> Array:
        """Poses (N, 3) of the keyframes."""
        return np.array([frame.T_map_base for frame in self.frames]).reshape(-1, 3)

    def move(self, poses: Array, edges: list[Edge]) -> None:
        """The first (N,) keyframes are at poses (N, 3); `edges` tie them besides the steps."""
        covariances = _covariances(poses, self.steps + edges)
        for number, T in enumerate(poses):
            self.frames[number] = replace(
                self.frames[number], T_map_base=T, covariance=covariances[number]
            )
            self._buckets.put(number, float(T[0]), float(T[1]))

    def path(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (N,) and poses (N, 3) of the scans that are keyframes, or for which one stands."""
        return self._path.stamps_ns, self._path.poses(self.poses())

    def are_apart(self, T_a: Array, T_b: Array) -> bool:
        """Whether two poses (3,) do not see about the same."""
        x, y, turn = se2.between(T_a, T_b).tolist()
        config = self._config
        return math.hypot(x, y) >= config.keyframe_m or abs(turn) >= config.keyframe_rad

    def near(self, T_map_base: Array, reach_m: float) -> list[int]:
        """Keyframes within a reach of a pose (3,), and some that are farther."""
        return self._buckets.near(float(T_map_base[0]), float(T_map_base[1]), reach_m)

    def alike(self, T_map_base: Array) -> int | None:
        """The keyframe that sees most nearly the same as one at a pose (3,), or None."""
        near = self.near(T_map_base, self._config.keyframe_m)
        near = [k for k in near if not self.are_apart(self.frames[k].T_map_base, T_map_base)]
        if not near:
            return None
        return min(near, key=lambda k: unlike(self.frames[k].T_map_base, T_map_base))


def unlike(T_a: Array, T_b: Array) -> float:
    """How differently two poses (3,) see, in m."""
    x, y, turn = se2.between(T_a, T_b).tolist()
    return float(math.hypot(x, y) + _RADIAN_M * abs(turn))


def carried(covariance: Array, lever: Array) -> Array:
    """Covariance (3, 3) of a pose that is bound to another one of that covariance, map frame.

    lever (2,): from the one to the other. Source: Smith, Self and Cheeseman, "Estimating uncertain
    spatial relationships in robotics", 1990, compounding.
    """
    F = np.array([[1.0, 0.0, -lever[1]], [0.0, 1.0, lever[0]], [0.0, 0.0, 1.0]])
    return np.asarray(F @ covariance @ F.T)


def inverse(matrix: Array) -> Array:
    """Information (3, 3) of a covariance, and the other way round."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def turned(covariance: Array, theta: float) -> Array:
    """Covariance (3, 3) of a relative pose, turned from a frame at theta to that of the map."""
    c, s = math.cos(theta), math.sin(theta)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(R @ covariance @ R.T)


def _covariances(poses: Array, edges: list[Edge]) -> list[Array]:
    """Covariance (3, 3) of each pose (N, 3) along the chain of edges that leaves it the least.

    An upper bound, as if there were no other chain; the first pose is certain.
    """
    ties: list[list[tuple[int, Array]]] = [[] for _ in poses]
    for edge in edges:
        if edge.b < len(poses):
            own = turned(inverse(edge.information), float(poses[edge.a, 2]))
            ties[edge.a].append((edge.b, own))
            # The other way its error in heading acts at the far end.
            back = carried(own, poses[edge.a, :2] - poses[edge.b, :2])
            ties[edge.b].append((edge.a, back))
    found: list[Array | None] = [None] * len(poses)
    heap: list[tuple[float, int, int, Array]] = [(0.0, 0, 0, np.zeros((3, 3)))]
    count = 0
    while heap:
        _, _, k, covariance = heapq.heappop(heap)
        if found[k] is not None:
            continue
        found[k] = covariance
        for other, own in ties[k]:
            if found[other] is None:
                count += 1
                new = carried(covariance, poses[other, :2] - poses[k, :2]) + own
                heapq.heappush(heap, (float(new[0, 0] + new[1, 1]), count, other, new))
    return [np.zeros((3, 3)) if each is None else each for each in found]
