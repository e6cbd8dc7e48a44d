"""Keyframes: stored scans along the path, with their poses and covariances.

If the robot returns to a mapped area and both visits agree, an earlier keyframe is reused. So the
number of keyframes grows with the area, not with time.
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
from thinmap_ros.core.grid.spatial_hash import SpatialHash
from thinmap_ros.core.jit import inlined, kernel
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.graph.trajectory import KeyframeTrajectory
from thinmap_ros.core.slam.wall_compass import Heading

_BUCKET_M = 4.0
# Variance of the main wall direction relative to the first keyframe.
_MAP_VARIANCE = 0.005**2
_UNMEASURED = Heading(0.0, math.inf)
_RADIAN_M = 1.0  # distance that changes the view of a scan as much as a rotation by a radian


@dataclass(frozen=True)
class KeyframeConfig(Config):
    """Parameters of keyframes."""

    distance_m: float = parameter(
        0.7,
        'Travelled distance after which a scan becomes a keyframe (m). Lower: more loop-closure '
        'candidates, more memory.',
        low=0.1,
        high=10.0,
    )
    angle_rad: float = parameter(
        0.7,
        'Rotation after which a scan becomes a keyframe (rad). Lower: more loop-closure '
        'candidates, more memory.',
        low=0.1,
        high=3.2,
    )


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A stored scan, its surface points (N, 5), robot frame, and its pose T_map_base (3,).

    path_m: length of the path at the last visit; covariance (3, 3): of the pose, map frame;
    submap: number of its local map; heading: measured by wall directions, map frame, or None.
    """

    scan: Scan
    points: Array
    T_map_base: Array
    path_m: float
    covariance: Array
    submap: int
    heading: Heading | None = None


class Keyframes:
    """The keyframes, the edges between consecutive ones, and the trajectory relative to them."""

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self.frames: list[Keyframe] = []
        self.steps: list[Edge] = []  # from its anchor to each keyframe but the first
        self._buckets = SpatialHash(_BUCKET_M)
        self._path = KeyframeTrajectory()

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def anchor(self) -> int:
        """Number of the last added or reused keyframe; -1 before the first."""
        return self._path.last

    def add(self, frame: Keyframe, step_covariance: Array) -> int:
        """Add a keyframe with an edge from the anchor; returns its number.

        step_covariance (3, 3): of its pose relative to the anchor, in the frame of the anchor.
        """
        number = len(self.frames)
        if number:
            anchor = self.anchor
            T = se2.between(self.frames[anchor].T_map_base, frame.T_map_base)
            self.steps.append(Edge(anchor, number, T, inverse(step_covariance), False))
        self.frames.append(frame)
        self._buckets.insert(number, float(frame.T_map_base[0]), float(frame.T_map_base[1]))
        self._path.add(frame.scan.stamp_ns, number, np.zeros(3))
        return number

    def reuse(self, number: int, frame: Keyframe) -> None:
        """Reuse an earlier keyframe with nearly the same view (reduced pose graph)."""
        earlier = self.frames[number]
        self.frames[number] = replace(earlier, path_m=frame.path_m)
        offset = se2.between(earlier.T_map_base, frame.T_map_base)
        self._path.add(frame.scan.stamp_ns, number, offset)

    @property
    def headings(self) -> list[Edge]:
        """Measured headings as edges from the first keyframe, whose heading defines the map's."""
        return [
            _heading_edge(number, frame.heading, float(self.frames[0].T_map_base[2]))
            for number, frame in enumerate(self.frames)
            if number and frame.heading is not None
        ]

    def covariances_from(self, root: int, poses: Array, edges: list[Edge]) -> Array:
        """Covariance (N, 3, 3) of each pose (N, 3) relative to pose `root`, map frame.

        edges: edges of the graph besides the steps.
        """
        frames = self.frames[: len(poses)]
        measured = np.array([frame.heading or _UNMEASURED for frame in frames])
        off = se2.wrap(measured[:, 0] - poses[:, 2])
        variances = _MAP_VARIANCE + measured[:, 1] + off**2
        variances[0] = 0.0
        return covariances_from(root, poses, self.steps + edges, variances[root] + variances)

    def poses(self) -> Array:
        """Poses (N, 3) of the keyframes."""
        return np.array([frame.T_map_base for frame in self.frames]).reshape(-1, 3)

    def move(self, poses: Array, edges: list[Edge]) -> None:
        """Set the poses (N, 3) of the first N keyframes; `edges`: besides the steps."""
        covariances = self.covariances_from(0, poses, edges)
        for number, T in enumerate(poses):
            self.frames[number] = replace(
                self.frames[number], T_map_base=T, covariance=covariances[number]
            )
            self._buckets.insert(number, float(T[0]), float(T[1]))

    def path(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (N,) in ns and poses (N, 3) of all keyframe scans, with those that reused one."""
        return self._path.stamps_ns, self._path.poses(self.poses())

    def differ(self, T_a: Array, T_b: Array) -> bool:
        """Whether the views of two poses (3,) differ by a keyframe distance or angle."""
        x, y, turn = se2.between(T_a, T_b).tolist()
        config = self._config
        return math.hypot(x, y) >= config.distance_m or abs(turn) >= config.angle_rad

    def near(self, T_map_base: Array, reach_m: float) -> list[int]:
        """Keyframes within a radius (m) of a pose (3,), and some that are farther."""
        return self._buckets.query_radius(float(T_map_base[0]), float(T_map_base[1]), reach_m)

    def most_similar(self, T_map_base: Array) -> int | None:
        """Keyframe with the view most similar to that at a pose (3,); None if all differ."""
        near = self.near(T_map_base, self._config.distance_m)
        near = [k for k in near if not self.differ(self.frames[k].T_map_base, T_map_base)]
        if not near:
            return None
        return min(near, key=lambda k: view_difference_m(self.frames[k].T_map_base, T_map_base))


def view_difference_m(T_a: Array, T_b: Array) -> float:
    """Difference of the views of two poses (3,): distance plus weighted rotation, m."""
    x, y, turn = se2.between(T_a, T_b).tolist()
    return float(math.hypot(x, y) + _RADIAN_M * abs(turn))


def propagated_covariance(covariance: Array, lever: Array) -> Array:
    """Covariance (3, 3) of a pose at a fixed offset from a pose of that covariance, map frame.

    lever (2,): offset, m. Source: Smith, Self and Cheeseman, "Estimating uncertain spatial
    relationships in robotics", 1990, compounding.
    """
    F = np.array([[1.0, 0.0, -lever[1]], [0.0, 1.0, lever[0]], [0.0, 0.0, 1.0]])
    return np.asarray(F @ covariance @ F.T)


def heading_variance(heading: Heading | None, T_map_base: Array) -> float:
    """Variance of the heading of a pose (3,) by a measurement, plus their squared difference."""
    if heading is None:
        return math.inf
    off = float(se2.wrap(heading.yaw - float(T_map_base[2])))
    return _MAP_VARIANCE + heading.variance + off**2


def with_heading(covariance: Array, variance: float) -> Array:
    """Covariance (3, 3) of a pose after an independent heading measurement of a variance."""
    if not math.isfinite(variance):
        return covariance
    gain = covariance[:, 2] / (covariance[2, 2] + variance)
    return np.asarray(covariance - np.outer(gain, covariance[2]))


def inverse(matrix: Array) -> Array:
    """Information (3, 3) of a covariance, and vice versa."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def rotated_covariance(covariance: Array, theta: float) -> Array:
    """Covariance (3, 3) of a relative pose, rotated by theta into the map frame."""
    c = math.cos(theta)
    s = math.sin(theta)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(R @ covariance @ R.T)


def _heading_edge(number: int, heading: Heading, first: float) -> Edge:
    information = np.zeros((3, 3))
    information[2, 2] = 1.0 / (_MAP_VARIANCE + heading.variance)
    return Edge(0, number, np.array([0.0, 0.0, heading.yaw - first]), information, True)


def covariances_from(root: int, poses: Array, edges: list[Edge], heading_variances: Array) -> Array:
    """Covariance (N, 3, 3) of each pose (N, 3) relative to pose `root`, map frame.

    Along the chain of edges with the smallest variance: an upper bound, because other chains are
    ignored. It is infinite for poses that are not connected. Edges to poses beyond N are ignored.
    heading_variances (N,): of measured headings relative to the root; infinite without one.
    """
    edges = [edge for edge in edges if edge.b < len(poses)]
    a = np.array([edge.a for edge in edges], dtype=np.int64)
    b = np.array([edge.b for edge in edges], dtype=np.int64)
    covariances = np.linalg.inv(np.array([edge.information for edge in edges]).reshape(-1, 3, 3))
    c = np.cos(poses[a, 2])
    s = np.sin(poses[a, 2])
    R = np.zeros((len(edges), 3, 3))
    R[:, 0, 0] = c
    R[:, 0, 1] = -s
    R[:, 1, 0] = s
    R[:, 1, 1] = c
    R[:, 2, 2] = 1.0
    order = np.argsort(np.concatenate([a, b]), kind='stable')
    first = np.searchsorted(np.concatenate([a, b])[order], np.arange(len(poses) + 1))
    own = R @ covariances @ R.transpose(0, 2, 1)
    found: Array = _covariances(root, poses, first, order, a, b, own, heading_variances)
    return found


@inlined
def _carry(covariance: Array, x: float, y: float) -> Array:
    """`propagated_covariance` with a lever (x, y)."""
    # Without products of matrices: for these small ones their calls take most of the time.
    carried_there: Array = covariance.copy()
    carried_there[0] -= y * covariance[2]
    carried_there[1] += x * covariance[2]
    carried_there[:, 0] -= y * carried_there[:, 2]
    carried_there[:, 1] += x * carried_there[:, 2]
    return carried_there


@kernel
def _covariances(
    root: int,
    poses: Array,
    first: NDArray[np.int64],
    order: NDArray[np.int64],
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    own: Array,
    heading_variances: Array,
) -> Array:
    """Dijkstra's algorithm, by the variance of the position.

    The M edges at pose k have the numbers order[first[k]] to order[first[k + 1]]. A number n >= M
    is edge n - M in reverse direction.
    """
    found = np.full((len(poses), 3, 3), np.inf)
    best = np.full(len(poses), np.inf)
    done = np.zeros(len(poses), dtype=np.bool_)
    found[root] = 0.0
    best[root] = 0.0
    heap = [(0.0, root)]
    while len(heap):
        _, k = heapq.heappop(heap)
        if done[k]:
            continue
        done[k] = True
        for tie in order[first[k] : first[k + 1]]:
            edge = tie % len(a)
            other = b[edge] if tie < len(a) else a[edge]
            if done[other]:
                continue
            x = poses[other, 0] - poses[k, 0]
            y = poses[other, 1] - poses[k, 1]
            # In reverse direction the heading error of the edge acts at its other end.
            step = own[edge] if tie < len(a) else _carry(own[edge], x, y)
            new = _carry(found[k], x, y) + step
            gain = new[:, 2] / (new[2, 2] + heading_variances[other])
            new -= np.outer(gain, new[2])
            variance = new[0, 0] + new[1, 1]
            if variance < best[other]:
                best[other] = variance
                found[other] = new
                heapq.heappush(heap, (variance, other))
    return found
