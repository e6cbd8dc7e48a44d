"""Keyframes: stored scans along the path, with their poses and covariances.

If the robot returns to a mapped area and both visits agree, an earlier keyframe is reused. So the
number of keyframes grows with the area, not with time.
Source: Johannsson, Kaess, Fallon and Leonard, "Temporally scalable visual SLAM using a reduced pose
graph", 2013.
"""

import heapq
import math
from collections.abc import Container, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.covariances import (
    carried,
    inverse,
    propagated_covariance,
    rotated_covariance,
    rotation,
)
from thinmap_ros.core.grid.spatial_hash import SpatialHash
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.pose_graph import NO_SHARE, Edge, Systematic
from thinmap_ros.core.slam.graph.trajectory import KeyframeTrajectory
from thinmap_ros.core.slam.wall_compass import Heading
from thinmap_ros.jit import inlined, kernel

_BUCKET_M = 4.0
_NO_COVARIANCE = np.zeros((3, 3))
_DETACHED = 1e-9 * np.eye(3)  # information of a step that says nothing
_NO_DERIVATIVE = np.zeros((3, 4))
_UNMEASURED = (0.0, math.inf, 0.0, 0.0, 0.0, 0.0, 0.0)  # row of a heading
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
    submap: number of its local map; heading: measured by wall directions, map frame, or None;
    systematic (3, 4): derivative of the pose by the calibration of the odometry.
    """

    scan: Scan
    points: Array
    T_map_base: Array
    path_m: float
    covariance: Array
    submap: int
    heading: Heading | None = None
    systematic: Array = field(default_factory=lambda: np.zeros((3, 4)))


@dataclass(frozen=True, eq=False)
class Step:
    """Relative pose of a keyframe and its anchor, in the frame of the anchor.

    covariance (3, 3): of independent errors; systematic: share of the odometry.
    """

    covariance: Array
    systematic: Systematic = NO_SHARE

    def turned(self, theta: float) -> 'Step':
        """The step in a frame in which its own is turned by theta, rad."""
        share = replace(self.systematic, derivative=rotation(theta) @ self.systematic.derivative)
        return Step(rotated_covariance(self.covariance, theta), share)


class Anchor:
    """The last keyframe scan, to which the pose of the robot is relative.

    The origin of the map before the first. T_map: its pose (3,). A correction of the keyframes
    moves it, and thereby whatever is relative to it.
    """

    def __init__(self, frame: Keyframe | None = None, T_frame: Array | None = None) -> None:
        """At a pose (3,) relative to a keyframe, of which it is known exactly; None: at its own."""
        self._frame = frame
        origin = np.zeros(3) if frame is None else frame.T_map_base
        self.T_map = origin if T_frame is None else se2.compose(origin, T_frame)

    def pose(self, T_anchor_base: Array) -> Array:
        """Pose T_map_base (3,) of a pose relative to the anchor."""
        return se2.compose(self.T_map, T_anchor_base)

    def relative(self, T_map_base: Array) -> Array:
        """Pose (3,) relative to the anchor of a pose in the map."""
        return se2.between(self.T_map, T_map_base)

    def path_m_at(self, T_anchor_base: Array) -> float:
        """Length of the path, m, along straight lines between keyframes, to a pose (3,)."""
        if self._frame is None:
            return 0.0
        return self._frame.path_m + math.hypot(T_anchor_base[0], T_anchor_base[1])

    def turned(self, covariance: Array) -> Array:
        """A covariance (3, 3) in the frame of the anchor, given that in the map frame."""
        return rotated_covariance(covariance, -float(self.T_map[2]))

    def covariance_at(self, T_anchor_base: Array, own: Array) -> Array:
        """Covariance (3, 3), map frame, of a pose whose covariance since the anchor is `own`."""
        total = rotated_covariance(own, float(self.T_map[2]))
        if self._frame is not None:
            total = total + propagated_covariance(
                self._frame.covariance, self._lever(T_anchor_base)
            )
        return np.asarray(0.5 * (total + total.T))

    def systematic_at(self, T_anchor_base: Array, own: Array) -> Array:
        """Derivative (3, 4) by the calibration, map frame, of a pose; own: since the anchor."""
        total = rotation(float(self.T_map[2])) @ own
        if self._frame is not None:
            total = total + carried(self._frame.systematic, self._lever(T_anchor_base))
        return np.asarray(total)

    def _lever(self, T_anchor_base: Array) -> Array:
        """Offset (2,) from the keyframe to a pose (3,) relative to the anchor, map frame."""
        assert self._frame is not None
        return self.pose(T_anchor_base)[:2] - self._frame.T_map_base[:2]


class Keyframes:
    """The keyframes, the edges between consecutive ones, and the trajectory relative to them.

    revision: number of corrections so far.
    """

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self.frames: list[Keyframe] = []
        self.steps: list[Edge] = []  # from its anchor to each keyframe but the first
        self._buckets = SpatialHash(_BUCKET_M)
        self._path = KeyframeTrajectory()
        self.revision = 0

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def anchor(self) -> int:
        """Number of the last added or reused keyframe; -1 before the first."""
        return self._path.last

    def is_step(self, j: int, k: int) -> bool:
        """Whether keyframe j was the anchor of keyframe k."""
        return k < len(self.frames) and self.steps[k - 1].a == j

    @property
    def T_anchor_last(self) -> Array:  # noqa: N802
        """Pose (3,) of the last keyframe scan relative to its keyframe: 0 unless it reuses one."""
        return self._path.T_last

    def add(self, frame: Keyframe, step: Step) -> int:
        """Add a keyframe with an edge from the anchor, by its step; returns its number."""
        number = len(self.frames)
        if number:
            anchor = self.anchor
            T = se2.between(self.frames[anchor].T_map_base, frame.T_map_base)
            self.steps.append(
                Edge(anchor, number, T, inverse(step.covariance), False, step.systematic)
            )
        self.frames.append(frame)
        self._buckets.insert(number, float(frame.T_map_base[0]), float(frame.T_map_base[1]))
        self._path.add(frame.scan.stamp_ns, number, np.zeros(3))
        return number

    def detach(self, numbers: Container[int]) -> None:
        """Forget the steps to keyframes from others: they do not say how these lie."""
        self.steps = [
            replace(step, information=_DETACHED)
            if step.b in numbers and step.a not in numbers
            else step
            for step in self.steps
        ]

    def reuse(self, number: int, frame: Keyframe) -> None:
        """Reuse an earlier keyframe with nearly the same view (reduced pose graph)."""
        earlier = self.frames[number]
        self.frames[number] = replace(earlier, path_m=frame.path_m)
        offset = se2.between(earlier.T_map_base, frame.T_map_base)
        self._path.add(frame.scan.stamp_ns, number, offset)

    def load(self, frames: Sequence[Keyframe], steps: Sequence[Edge]) -> None:
        """Begin with saved keyframes, and the step to each but the first."""
        self.frames = list(frames)
        self.steps = list(steps)
        for number, frame in enumerate(frames):
            self._buckets.insert(number, float(frame.T_map_base[0]), float(frame.T_map_base[1]))
            self._path.add(frame.scan.stamp_ns, number, np.zeros(3))

    def return_to(self, number: int) -> None:
        """Make a keyframe the anchor that the robot has come to by no known motion."""
        frame = self.frames[number]
        path_m = max(each.path_m for each in self.frames)
        self.frames[number] = replace(frame, path_m=path_m)
        self._path.add(frame.scan.stamp_ns, number, np.zeros(3))

    @property
    def headings(self) -> list[Edge]:
        """Measured headings as edges from the first keyframe, whose heading defines the map's."""
        return [
            _heading_edge(number, frame.heading, float(self.frames[0].T_map_base[2]))
            for number, frame in enumerate(self.frames)
            if number and frame.heading is not None
        ]

    def covariances_from(self, root: int, poses: Array, edges: list[Edge]) -> tuple[Array, Array]:
        """Covariance (N, 3, 3) of each pose (N, 3) relative to pose `root`, map frame.

        Of independent errors; also returns the derivatives (N, 3, 4) by the calibration.

        edges: edges of the graph besides the steps.
        """
        frames = self.frames[: len(poses)]
        headings = heading_errors([frame.heading for frame in frames], poses)
        edges = self.steps + edges
        if root:
            # Both headings are measured by one direction, and its error is in neither difference.
            headings[:, 0] += headings[root, 0]
            headings[:, 1:] = 0.0
            return covariances_from(root, poses, edges, headings)
        origin = frames[0]
        return covariances_from(0, poses, edges, headings, origin.covariance, origin.systematic)

    def poses(self) -> Array:
        """Poses (N, 3) of the keyframes."""
        return np.array([frame.T_map_base for frame in self.frames]).reshape(-1, 3)

    def calibrate(self, parameters: Array) -> None:
        """Correct steps and headings by parameters (N, 4) of the calibration.

        The poses follow by `move`.
        """
        self.steps = [step.calibrated(parameters) for step in self.steps]
        for number, frame in enumerate(self.frames):
            if frame.heading is not None:
                heading = frame.heading.calibrated(parameters)
                self.frames[number] = replace(frame, heading=heading)

    def move(self, poses: Array, edges: list[Edge]) -> None:
        """Set the poses (N, 3) of the first N keyframes; `edges`: besides the steps."""
        self.revision += 1
        covariances, derivatives = self.covariances_from(0, poses, edges)
        for number, T in enumerate(poses):
            self.frames[number] = replace(
                self.frames[number],
                T_map_base=T,
                covariance=covariances[number],
                systematic=derivatives[number],
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


def heading_errors(headings: Sequence[Heading | None], poses: Array) -> Array:
    """Errors (N, 6) of the headings that wall directions measure for poses (N, 3).

    Columns: variance of the measurement and of its difference from the pose, infinite without one;
    variance of the main direction; its derivative (4,) by the calibration.
    """
    rows = np.array([_UNMEASURED if heading is None else heading.row for heading in headings])
    errors = rows[:, 1:]
    errors[:, 0] += se2.wrap(rows[:, 0] - poses[:, 2]) ** 2
    return errors


def with_heading(covariance: Array, derivative: Array, error: Array) -> tuple[Array, Array]:
    """Covariance (3, 3) and derivative (3, 4) of a pose after a heading measurement.

    error (6,): of the measurement, as in `heading_errors`. The error of the main direction is that
    of earlier headings: it is in both, and stays.
    """
    found: tuple[Array, Array] = _with_heading(covariance, derivative, error)
    return found


@inlined
def _with_heading(covariance: Array, derivative: Array, error: Array) -> tuple[Array, Array]:
    own = covariance[2, 2] - error[1]  # not in common with the main direction
    if own <= 0.0 or not np.isfinite(error[0]):
        return covariance, derivative
    shared = covariance[2] * (own / covariance[2, 2])
    gain = shared / (own + error[0])
    change = error[2:] - derivative[2]
    return covariance - np.outer(gain, shared), derivative + np.outer(gain, change)


def _heading_edge(number: int, heading: Heading, first: float) -> Edge:
    information = np.zeros((3, 3))
    reference = heading.reference
    information[2, 2] = 1.0 / (reference.variance + heading.variance)
    T = np.array([0.0, 0.0, heading.yaw - first])
    return Edge(0, number, T, information, True, reference.systematic)


def covariances_from(
    root: int,
    poses: Array,
    edges: list[Edge],
    headings: Array,
    covariance: Array = _NO_COVARIANCE,
    derivative: Array = _NO_DERIVATIVE,
) -> tuple[Array, Array]:
    """Covariance (N, 3, 3) of each pose (N, 3) relative to pose `root`, map frame.

    Of independent errors; also returns the derivatives (N, 3, 4) by the calibration.
    covariance (3, 3), derivative (3, 4): those of the root; zero without.

    Along the chain of edges with the smallest variance: an upper bound, because other chains are
    ignored. It is infinite for poses that are not connected. Edges to poses beyond N are ignored.
    headings (N, 6): as in `heading_errors`.
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
    by_calibration = np.array([edge.systematic.derivative for edge in edges])
    own_by_calibration = np.ascontiguousarray(R @ by_calibration.reshape(-1, 3, 4))
    found: tuple[Array, Array] = _covariances(
        root,
        covariance,
        derivative,
        poses,
        first,
        order,
        a,
        b,
        own,
        own_by_calibration,
        headings,
    )
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


@inlined
def _carry_derivative(derivative: Array, x: float, y: float) -> Array:
    """`carried` with a lever (x, y)."""
    moved: Array = derivative.copy()
    moved[0] -= y * derivative[2]
    moved[1] += x * derivative[2]
    return moved


@kernel
def _covariances(
    root: int,
    covariance: Array,
    derivative: Array,
    poses: Array,
    first: NDArray[np.int64],
    order: NDArray[np.int64],
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    own: Array,
    own_by_calibration: Array,
    headings: Array,
) -> tuple[Array, Array]:
    """Dijkstra's algorithm, by the variance of the position.

    The M edges at pose k have the numbers order[first[k]] to order[first[k + 1]]. A number n >= M
    is edge n - M in reverse direction. headings (N, 6): as in `heading_errors`.
    """
    found = np.full((len(poses), 3, 3), np.inf)
    best = np.full(len(poses), np.inf)
    done = np.zeros(len(poses), dtype=np.bool_)
    found[root] = covariance
    derivatives = np.zeros((len(poses), 3, 4))
    derivatives[root] = derivative
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
            if tie < len(a):
                by = _carry_derivative(derivatives[k], x, y) + own_by_calibration[edge]
            else:
                by = _carry_derivative(derivatives[k] - own_by_calibration[edge], x, y)
            new, by = _with_heading(new, by, headings[other])
            variance = new[0, 0] + new[1, 1]
            if variance < best[other]:
                best[other] = variance
                found[other] = new
                derivatives[other] = by
                heapq.heappush(heap, (variance, other))
    return found, derivatives
