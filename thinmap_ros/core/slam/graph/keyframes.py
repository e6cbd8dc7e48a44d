"""Keyframes: stored scans along the path, with their poses and covariances.

If the robot returns to a mapped area and both visits agree, an earlier keyframe is reused. So the
number of keyframes grows with the area, not with time.
Source: Johannsson, Kaess, Fallon and Leonard, "Temporally scalable visual SLAM using a reduced pose
graph", 2013.
"""

import heapq
import math
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.grid.fields import SpatialHash
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import (
    Array,
    carried,
    inverse,
    propagated_covariance,
    rotated_covariance,
    rotation,
)
from thinmap_ros.core.slam.graph import tables
from thinmap_ros.core.slam.graph.pose_graph import NO_SHARE, Edge, EdgeArrays, Systematic
from thinmap_ros.core.slam.graph.tables import EdgeTable, HeadingTable, KeyframeTrajectory, Rows
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.odometry import UNKNOWN, OdometryCalibration
from thinmap_ros.core.slam.wall_compass import Heading, Reference
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, Field, Fields, State
from thinmap_ros.jit import inlined, kernel

_BUCKET_M = 4.0

_NO_COVARIANCE = np.zeros((3, 3))

_DETACHED = 1e-9 * np.eye(3)  # information of a step that says nothing

_MOVED_PER_SLICE = 2000  # keyframes: 10 ms on a desktop processor

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

    revision: number of corrections so far; anchor: number of the last added or reused keyframe, -1
    before the first; T_anchor_last (3,): the last keyframe scan relative to it, 0 unless it reuses
    one.
    """

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self.frames: list[Keyframe] = []
        self.steps = EdgeTable()  # from its anchor to each keyframe but the first
        self._poses = Rows(3)
        self._headings = HeadingTable()
        self._buckets = SpatialHash(_BUCKET_M)
        self._path = KeyframeTrajectory()
        self.revision = 0
        self.anchor = -1
        self.T_anchor_last = np.zeros(3)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def T_map_anchor(self) -> Array:  # noqa: N802
        """Pose (3,) of the anchor; the origin of the map without one."""
        return np.zeros(3) if self.anchor < 0 else self.frames[self.anchor].T_map_base

    def is_step(self, j: int, k: int) -> bool:
        """Whether keyframe j was the anchor of keyframe k."""
        return k < len(self.frames) and int(self.steps.ends[k - 1, 0]) == j

    def add(self, frame: Keyframe, step: Step) -> int:
        """Add a keyframe with an edge from the anchor, by its step; returns its number."""
        number = len(self.frames)
        if number:
            anchor = self.anchor
            T = se2.between(self.frames[anchor].T_map_base, frame.T_map_base)
            self.steps.append(
                Edge(anchor, number, T, inverse(step.covariance), False, step.systematic)
            )
        self._append(frame)
        return number

    def _append(self, frame: Keyframe) -> None:
        number = len(self.frames)
        self.frames.append(frame)
        self._poses.append(frame.T_map_base)
        self._headings.append(frame.heading)
        self._buckets.insert(number, float(frame.T_map_base[0]), float(frame.T_map_base[1]))
        self._come_to(number, frame.scan.stamp_ns, np.zeros(3))

    def _come_to(self, number: int, stamp_ns: int, T_anchor_last: Array) -> None:
        """Make a keyframe the anchor of a scan at a pose (3,) relative to it."""
        self.anchor = number
        self.T_anchor_last = T_anchor_last
        self._path.add(stamp_ns, number, T_anchor_last)

    def detach(self, numbers: Container[int]) -> None:
        """Forget the steps to keyframes from others: they do not say how these lie."""
        for step, (a, b) in enumerate(self.steps.ends.tolist()):
            if b in numbers and a not in numbers:
                self.steps.information[step] = _DETACHED

    def reuse(self, number: int, frame: Keyframe) -> None:
        """Reuse an earlier keyframe with nearly the same view (reduced pose graph)."""
        earlier = self.frames[number]
        self.frames[number] = replace(earlier, path_m=frame.path_m)
        offset = se2.between(earlier.T_map_base, frame.T_map_base)
        self._come_to(number, frame.scan.stamp_ns, offset)

    def load(self, frames: Sequence[Keyframe], steps: Sequence[Edge]) -> None:
        """Begin with saved keyframes, and the step to each but the first."""
        self.steps.extend(steps)
        for frame in frames:
            self._append(frame)

    def return_to(self, number: int) -> None:
        """Make a keyframe the anchor that the robot has come to by no known motion."""
        frame = self.frames[number]
        path_m = max(each.path_m for each in self.frames)
        self.frames[number] = replace(frame, path_m=path_m)
        self._come_to(number, frame.scan.stamp_ns, np.zeros(3))

    def headings(self, parameters: Array | None = None) -> EdgeArrays:
        """Measured headings as edges from the first keyframe, whose heading defines the map's.

        As they are, or would be with parameters (N, 4) of the calibration.
        """
        first = float(self._poses.values[0, 2]) if self.frames else 0.0
        return self._headings.edges(first, parameters)

    def covariances_from(
        self, root: int, poses: Array, edges: EdgeTable, wanted: Sequence[int] = ()
    ) -> tuple[Array, Array]:
        """Covariance (N, 3, 3) of each pose (N, 3) relative to pose `root`, map frame.

        Of independent errors; also returns the derivatives (N, 3, 4) by the calibration.

        edges: edges of the graph besides the steps; wanted: poses of which alone the result is
        needed; none: of all.
        """
        headings = heading_errors(self._headings.rows[: len(poses)], poses)
        start = Start(root)
        if root:
            # Both headings are measured by one direction, and its error is in neither difference.
            headings[:, 0] += headings[root, 0]
            headings[:, 1:] = 0.0
        else:
            start = Start(0, self.frames[0].covariance, self.frames[0].systematic)
        return covariances_from(start, poses, [self.steps, edges], headings, wanted)

    def poses(self) -> Array:
        """Poses (N, 3) of the keyframes."""
        return np.array(self._poses.values)

    def calibrate(self, parameters: Array) -> None:
        """Correct steps and headings by parameters (N, 4) of the calibration.

        The poses follow by `move`, and with them the headings of `frames`.
        """
        self.steps.calibrate(parameters)
        self._headings.calibrate(parameters)

    def move(self, poses: Array, edges: EdgeTable) -> Iterator[None]:
        """Set the poses (N, 3) of the first N keyframes, in slices; `edges`: besides the steps.

        All move at once, with the last slice. Keyframes that are added before that move with their
        anchors.
        """
        covariances, derivatives = self.covariances_from(0, poses, edges)
        before = self.frames[: len(poses)]
        moved: list[Keyframe] = []
        for number, frame in enumerate(before):
            if len(before) > _MOVED_PER_SLICE and number % _MOVED_PER_SLICE == 0:
                yield
            heading = self._headings.of(number)
            moved.append(
                Keyframe(
                    frame.scan,
                    frame.points,
                    poses[number],
                    frame.path_m,
                    covariances[number],
                    frame.submap,
                    heading,
                    derivatives[number],
                )
            )
        if len(before) > _MOVED_PER_SLICE:
            yield
        for number, frame in enumerate(before):
            if self.frames[number] is not frame:  # reused meanwhile
                moved[number] = replace(moved[number], path_m=self.frames[number].path_m)
        for step, frame in zip(
            self.steps[len(poses) - 1 :], self.frames[len(poses) :], strict=True
        ):
            poses = np.vstack([poses, se2.compose(poses[step.a], step.T_a_b)])
            moved.append(replace(frame, T_map_base=poses[-1]))
        self._set(moved, poses)

    def _set(self, frames: list[Keyframe], poses: Array) -> None:
        """Replace all keyframes, and their poses (N, 3)."""
        self.revision += 1
        before = self.poses()
        self.frames = frames
        self._poses.values[:] = poses
        are_elsewhere = before[:, :2] // _BUCKET_M != self._poses.values[:, :2] // _BUCKET_M
        for number in np.flatnonzero(are_elsewhere.any(axis=1)).tolist():
            x, y, _ = self._poses.values[number].tolist()
            self._buckets.insert(number, x, y)

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


def heading_errors(rows: Array, poses: Array) -> Array:
    """Errors (N, 6) of the headings that wall directions measure for poses (N, 3).

    rows (N, 7): as in `heading_row`. Columns: variance of the measurement and of its difference
    from the pose, infinite without one; variance of the main direction; its derivative (4,) by the
    calibration.
    """
    errors = np.array(rows[:, 1:])
    errors[:, 0] += se2.wrap(rows[:, 0] - poses[:, 2]) ** 2
    return errors


def with_heading(covariance: Array, derivative: Array, error: Array) -> tuple[Array, Array]:
    """Covariance (3, 3) and derivative (3, 4) of a pose that is turned to a measured heading.

    The position stays where it is, and so do its variance and its derivative. error (6,): of the
    measurement, as in `heading_errors`. The error of the main direction is that of earlier
    headings: it is in both, and stays.
    """
    found = (np.array(covariance), np.array(derivative))
    _measure_heading(*found, error)
    return found


@inlined
def _measure_heading(covariance: Array, derivative: Array, error: Array) -> None:
    """`with_heading`, in place."""
    own = covariance[2, 2] - error[1]  # not in common with the main direction
    if own <= 0.0 or not np.isfinite(error[0]):
        return
    gain = own / (own + error[0])
    for j in range(4):
        derivative[2, j] += gain * (error[2 + j] - derivative[2, j])
    # The update of a gain that turns the pose alone (Joseph form). An optimal one would also move
    # it by its correlation with the heading, but nothing moves it: the scan is turned in place.
    kept = 1.0 - gain * own / covariance[2, 2]
    for i in range(3):
        covariance[i, 2] *= kept
        if i < 2:
            covariance[2, i] = covariance[i, 2]


class Start(NamedTuple):
    """A pose from which covariances grow, with its own covariance and derivative."""

    root: int
    covariance: Array = _NO_COVARIANCE
    derivative: Array = NO_SHARE.derivative


def covariances_from(
    start: Start,
    poses: Array,
    tables: Sequence[EdgeTable],
    headings: Array,
    wanted: Sequence[int] = (),
) -> tuple[Array, Array]:
    """Covariance (N, 3, 3) of each pose (N, 3) relative to a start, map frame.

    Of independent errors; also returns the derivatives (N, 3, 4) by the calibration.

    Along the chain of edges with the smallest variance: an upper bound, because other chains are
    ignored. It is infinite for poses that are not connected. Edges to poses beyond N are ignored.
    headings (N, 6): as in `heading_errors`; wanted: poses of which alone the result is needed;
    none: of all.
    """
    ends = np.concatenate([table.ends for table in tables])
    are_known = ends[:, 1] < len(poses)
    is_wanted = np.zeros(len(poses), dtype=np.bool_)
    is_wanted[list(wanted) if len(wanted) else slice(None)] = True
    found: tuple[Array, Array] = _covariances(
        start.root,
        start.covariance,
        start.derivative,
        poses,
        ends[are_known],
        np.concatenate([table.information for table in tables])[are_known],
        np.concatenate([table.derivatives for table in tables])[are_known],
        headings,
        is_wanted,
    )
    return found


@inlined
def _set_inverse(C: Array, W: Array) -> None:
    """Make C (3, 3) the inverse of a symmetric matrix W (3, 3)."""
    C[0, 0] = W[1, 1] * W[2, 2] - W[1, 2] * W[1, 2]
    C[0, 1] = C[1, 0] = W[0, 2] * W[1, 2] - W[0, 1] * W[2, 2]
    C[0, 2] = C[2, 0] = W[0, 1] * W[1, 2] - W[0, 2] * W[1, 1]
    C[1, 1] = W[0, 0] * W[2, 2] - W[0, 2] * W[0, 2]
    C[1, 2] = C[2, 1] = W[0, 2] * W[0, 1] - W[0, 0] * W[1, 2]
    C[2, 2] = W[0, 0] * W[1, 1] - W[0, 1] * W[0, 1]
    determinant = W[0, 0] * C[0, 0] + W[0, 1] * C[0, 1] + W[0, 2] * C[0, 2]
    for i in range(3):
        for j in range(3):
            C[i, j] /= determinant


@inlined
def _turn_rows(matrix: Array, c: float, s: float) -> None:
    """Turn what has rows x and y by an angle of that cosine and sine, in place."""
    for j in range(matrix.shape[1]):
        x = matrix[0, j]
        y = matrix[1, j]
        matrix[0, j] = c * x - s * y
        matrix[1, j] = s * x + c * y


@inlined
def _carry_rows(matrix: Array, x: float, y: float) -> None:
    """`carried` with a lever (x, y), in place."""
    for j in range(matrix.shape[1]):
        matrix[0, j] -= y * matrix[2, j]
        matrix[1, j] += x * matrix[2, j]


@inlined
def _set_turned(own: Array, share: Array, W: Array, derivative: Array, yaw: float) -> None:
    """Make `own` (3, 3) and `share` (3, 4) covariance and derivative of an edge, map frame.

    W (3, 3): its information; derivative (3, 4), frame of its keyframe a with heading yaw, rad.
    """
    c = np.cos(yaw)
    s = np.sin(yaw)
    _set_inverse(own, W)
    _turn_rows(own, c, s)
    _turn_rows(own.T, c, s)
    share[:] = derivative
    _turn_rows(share, c, s)


@inlined
def _add_edge(
    new: Array, by: Array, own: Array, share: Array, x: float, y: float, is_forward: bool
) -> None:
    """Carry covariance `new` and derivative `by` over an edge with a lever (x, y), in place."""
    # In reverse direction the error of the edge, and so of its heading, acts at its other end.
    if not is_forward:
        new += own
        by -= share
    _carry_rows(new, x, y)
    _carry_rows(new.T, x, y)
    _carry_rows(by, x, y)
    if is_forward:
        new += own
        by += share


@kernel
def _edges_of_poses(
    count: int, ends: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Ties of the poses: those of pose k are numbers first[k] to first[k + 1].

    A tie n >= M is edge n - M of M (M, 2) in reverse direction.
    """
    first = np.zeros(count + 1, dtype=np.int64)
    for edge in range(len(ends)):
        first[ends[edge, 0] + 1] += 1
        first[ends[edge, 1] + 1] += 1
    first = np.cumsum(first)
    free = first[:-1].copy()
    ties = np.empty(2 * len(ends), dtype=np.int64)
    for side in range(2):
        for edge in range(len(ends)):
            ties[free[ends[edge, side]]] = edge + side * len(ends)
            free[ends[edge, side]] += 1
    return first, ties


@kernel
def _covariances(
    root: int,
    covariance: Array,
    derivative: Array,
    poses: Array,
    ends: NDArray[np.int64],
    information: Array,
    by_calibration: Array,
    headings: Array,
    is_wanted: NDArray[np.bool_],
) -> tuple[Array, Array]:
    """Dijkstra's algorithm, by the variance of the position, until all wanted poses are final.

    ends (M, 2): poses of the edges; headings (N, 6): as in `heading_errors`.
    """
    first, ties = _edges_of_poses(len(poses), ends)
    found = np.full((len(poses), 3, 3), np.inf)
    best = np.full(len(poses), np.inf)
    done = np.zeros(len(poses), dtype=np.bool_)
    found[root] = covariance
    derivatives = np.zeros((len(poses), 3, 4))
    derivatives[root] = derivative
    best[root] = 0.0
    heap = [(0.0, root)]
    waiting = is_wanted.sum()
    # Without temporary arrays: for these small ones they take most of the time.
    own = np.empty((3, 3))
    share = np.empty((3, 4))
    new = np.empty((3, 3))
    by = np.empty((3, 4))
    while len(heap) and waiting:
        _, k = heapq.heappop(heap)
        if done[k]:
            continue
        done[k] = True
        if is_wanted[k]:
            waiting -= 1
        for tie in ties[first[k] : first[k + 1]]:
            edge = tie % len(ends)
            is_forward = tie < len(ends)
            other = ends[edge, 1] if is_forward else ends[edge, 0]
            if done[other]:
                continue
            x = poses[other, 0] - poses[k, 0]
            y = poses[other, 1] - poses[k, 1]
            yaw = poses[ends[edge, 0], 2]
            _set_turned(own, share, information[edge], by_calibration[edge], yaw)
            new[:] = found[k]
            by[:] = derivatives[k]
            _add_edge(new, by, own, share, x, y, is_forward)
            _measure_heading(new, by, headings[other])
            variance = new[0, 0] + new[1, 1]
            if variance < best[other]:
                best[other] = variance
                found[other] = new
                derivatives[other] = by
                heapq.heappush(heap, (variance, other))
    return found, derivatives


MAX_KEYFRAMES = 1 << 16  # 45 km of new ground
MAX_EDGES = 1 << 18

_WHAT = 'keyframes'

_MAX_YAW_RAD = 4.0

MAX_VALUE = 1e12  # of covariances, information and lengths

_MIN_VARIANCE = 1e-12

ROUNDING = 1e-5  # relative error of a covariance in 32 bit

UPPER = np.triu_indices(3)

_LOW_POSE = (-2.0 * MAX_COORDINATE_M, -2.0 * MAX_COORDINATE_M, -_MAX_YAW_RAD)

_HIGH_POSE = (2.0 * MAX_COORDINATE_M, 2.0 * MAX_COORDINATE_M, _MAX_YAW_RAD)

_LOW_HEADING = (-_MAX_YAW_RAD, _MIN_VARIANCE, 0.0)

_HIGH_HEADING = (_MAX_YAW_RAD, MAX_VALUE, MAX_VALUE)

# n keyframes with s = n - 1 steps, and m edges between visits. Symmetric matrices: upper triangle.
FIELDS: Fields = {
    **tables.FIELDS,
    'poses': Field(
        np.float64,
        ('n', 3),
        (-MAX_COORDINATE_M, -MAX_COORDINATE_M, -_MAX_YAW_RAD),
        (MAX_COORDINATE_M, MAX_COORDINATE_M, _MAX_YAW_RAD),
    ),
    'path_m': Field(np.float32, ('n',), 0.0, MAX_VALUE),
    'covariances': Field(np.float32, ('n', 6), -MAX_VALUE, MAX_VALUE),
    'submaps': Field(np.int32, ('n',), 0, MAX_KEYFRAMES),
    'headings': Field(np.float32, ('n', 3), _LOW_HEADING, _HIGH_HEADING, nan=True),
    'step_from': Field(np.int32, ('s',), 0, MAX_KEYFRAMES),
    'step_poses': Field(np.float32, ('s', 3), _LOW_POSE, _HIGH_POSE),
    'step_information': Field(np.float64, ('s', 6), -MAX_VALUE, MAX_VALUE),
    'edges': Field(np.int32, ('m', 2), 0, MAX_KEYFRAMES),
    'edge_poses': Field(np.float32, ('m', 3), _LOW_POSE, _HIGH_POSE),
    'edge_information': Field(np.float64, ('m', 6), -MAX_VALUE, MAX_VALUE),
    'edge_inliers': Field(np.float32, ('m',), 0.0, 1.0),
}


@dataclass(frozen=True, eq=False)
class SavedKeyframes:
    """Keyframes (n >= 1), the step from its anchor to each but the first, and edges between visits.

    Those of a published map, as they are saved with a session.
    Nothing refers to a calibration of the odometry: its uncertainty when they were saved is part of
    the covariances, in each step by itself. Scans have the stamps 1, 2, 3, ... ns in their order,
    so that they are told from each other and from all scans of a robot. stamps_ns: those that the
    scans had; unknown of a session.
    """

    frames: list[Keyframe]
    steps: list[Edge]
    edges: list[Edge]
    stamps_ns: Sequence[int] = ()

    @staticmethod
    def of(
        frames: Sequence[Keyframe],
        steps: Sequence[Edge],
        edges: Sequence[Edge],
        is_saved: Sequence[bool],
        calibration: OdometryCalibration,
    ) -> 'SavedKeyframes':
        """Those of some keyframes that are saved, with the edges between these.

        steps: from its anchor to each keyframe but the first; calibration: of the odometry.
        """
        numbers = np.cumsum(is_saved) - 1  # new number of each keyframe that is saved
        kept = np.flatnonzero(is_saved).tolist()
        own_steps = [_step(steps[k - 1], frames, before, is_saved) for before, k in pairwise(kept)]
        own_edges = [edge for edge in edges if is_saved[edge.a] and is_saved[edge.b]]
        return SavedKeyframes(
            [
                _frame_with_calibration(frames[k], number + 1, calibration)
                for number, k in enumerate(kept)
            ],
            [with_calibration(edge, calibration).renumbered(numbers) for edge in own_steps],
            [with_calibration(edge, calibration).renumbered(numbers) for edge in own_edges],
            [frames[k].scan.stamp_ns for k in kept],
        )

    @staticmethod
    def of_graph(frames: Sequence[Keyframe], edges: Sequence[Edge]) -> 'SavedKeyframes':
        """Those of a graph that was joined, with covariances along all of its edges.

        The step to a keyframe is the first edge to it that is no loop. The others are between
        visits.
        """
        steps: dict[int, Edge] = {}
        others: list[Edge] = []
        for edge in edges:
            if edge.robust or edge.a > edge.b or edge.b in steps:
                others.append(edge)
            else:
                steps[edge.b] = edge
        numbers = range(1, len(frames))
        all_steps = [steps.get(k) or _unknown_step(frames, k - 1, k) for k in numbers]
        poses = np.array([frame.T_map_base for frame in frames])
        headings = np.array([tables.heading_row(frame.heading) for frame in frames])
        covariances, _ = covariances_from(
            Start(0, frames[0].covariance),
            poses,
            [EdgeTable(all_steps), EdgeTable(others)],
            heading_errors(headings, poses),
        )
        own = [
            replace(frame, scan=replace(frame.scan, stamp_ns=k + 1), covariance=covariance)
            for k, (frame, covariance) in enumerate(zip(frames, covariances, strict=True))
        ]
        return SavedKeyframes(own, all_steps, others)

    def extended(self, tail: 'SavedKeyframes') -> 'SavedKeyframes':
        """With the keyframes that came next; the first of these is the last one here.

        It may have been corrected in between: the others move along.
        """
        last = self.frames[-1]
        T = se2.compose(last.T_map_base, se2.invert(tail.frames[0].T_map_base))
        by = len(self.frames) - 1
        frames = [
            replace(frame, T_map_base=se2.compose(T, frame.T_map_base), submap=last.submap)
            for frame in tail.frames[1:]
        ]
        steps, edges = ([edge.shifted(by, by) for edge in own] for own in (tail.steps, tail.edges))
        return SavedKeyframes(
            self.frames + frames,
            self.steps + steps,
            self.edges + edges,
            [*self.stamps_ns, *tail.stamps_ns[1:]],
        )

    def with_stamps(self, stamps_ns: Sequence[int]) -> 'SavedKeyframes':
        """The keyframes with the stamps that their scans had: the same robot continues."""
        pairs = zip(self.frames, stamps_ns, strict=True)
        frames = [replace(f, scan=replace(f.scan, stamp_ns=stamp_ns)) for f, stamp_ns in pairs]
        return replace(self, frames=frames, stamps_ns=stamps_ns)

    @property
    def scans(self) -> list[tuple[Scan, Array]]:
        """The scans with their poses T_map_base (3,)."""
        return [(frame.scan, frame.T_map_base) for frame in self.frames]

    def state(self) -> State:
        """The keyframes as arrays by name, for `from_state`; ranges are rounded to 1 mm."""
        frames = self.frames
        submaps = np.unique([frame.submap for frame in frames], return_inverse=True)[1]
        return {
            **tables.packed_scans([frame.scan for frame in frames]),
            'poses': np.array([frame.T_map_base for frame in frames]),
            'path_m': np.array([frame.path_m for frame in frames], dtype=np.float32),
            'covariances': _triangles([f.covariance for f in frames]).astype(np.float32),
            'submaps': submaps.reshape(-1).astype(np.int32),
            'headings': np.array([_heading_row(f.heading) for f in frames], dtype=np.float32),
            'step_from': np.array([step.a for step in self.steps], dtype=np.int32),
            'step_poses': _relative_poses(self.steps),
            'step_information': _triangles([step.information for step in self.steps]),
            'edges': np.array([(e.a, e.b) for e in self.edges], np.int32).reshape(-1, 2),
            'edge_poses': _relative_poses(self.edges),
            'edge_information': _triangles([edge.information for edge in self.edges]),
            'edge_inliers': np.array([edge.inlier_ratio for edge in self.edges], np.float32),
        }

    @staticmethod
    def from_state(state: State, config: None = None) -> 'SavedKeyframes':
        """Restore a saved `state`. Raises InputError if it is invalid."""
        checked = snapshot.validate(state, FIELDS, _WHAT)
        _check_edges(checked)
        scans = tables.unpacked_scans(checked, _WHAT)
        covariances = symmetric_matrices(checked['covariances'].astype(np.float64))
        _require_definite(covariances, 'covariances', -ROUNDING)
        submaps = np.unique(checked['submaps'], return_inverse=True)[1].reshape(-1).tolist()
        frames = [
            Keyframe(
                scan,
                surface_points(scan),
                checked['poses'][k],
                float(checked['path_m'][k]),
                covariances[k],
                submaps[k],
                _heading_of(checked['headings'][k].astype(np.float64)),
            )
            for k, scan in enumerate(scans)
        ]
        ends = np.column_stack([checked['step_from'], np.arange(1, len(frames))])
        return SavedKeyframes(
            frames,
            _edges_of(checked, 'step', ends, np.zeros(len(ends)), is_robust=False),
            _edges_of(checked, 'edge', checked['edges'], checked['edge_inliers'], is_robust=True),
        )


def _step(step: Edge, frames: Sequence[Keyframe], before: int, is_saved: Sequence[bool]) -> Edge:
    """The step to a keyframe, or one from the keyframe before if its anchor is not saved."""
    return step if is_saved[step.a] else _unknown_step(frames, before, step.b)


def _unknown_step(frames: Sequence[Keyframe], a: int, b: int) -> Edge:
    """A step between two keyframes that says nothing about how they lie."""
    T = se2.between(frames[a].T_map_base, frames[b].T_map_base)
    return Edge(a, b, T, inverse(UNKNOWN), False)


def with_calibration(edge: Edge, calibration: OdometryCalibration) -> Edge:
    """The edge with the uncertainty of the calibration among its own."""
    systematic = calibration.covariance_of(edge.systematic.derivative)
    if not systematic.any():
        return replace(edge, systematic=NO_SHARE)
    information = inverse(inverse(edge.information) + systematic)
    return replace(edge, information=information, systematic=NO_SHARE)


def _frame_with_calibration(
    frame: Keyframe, stamp_ns: int, calibration: OdometryCalibration
) -> Keyframe:
    heading = frame.heading
    if heading is not None:
        by = heading.reference.systematic.derivative
        variance = heading.reference.variance + float(calibration.covariance_of(by)[2, 2])
        heading = Heading(heading.yaw, heading.variance, Reference(variance, NO_SHARE))
    return replace(
        frame,
        scan=replace(frame.scan, stamp_ns=stamp_ns),
        covariance=frame.covariance + calibration.covariance_of(frame.systematic),
        systematic=np.zeros((3, 4)),
        heading=heading,
    )


def _check_edges(checked: State) -> None:
    """Raise InputError unless there are as many steps and edges as allowed, of known keyframes."""
    count = len(checked['poses'])
    edges = checked['edges']
    snapshot.require(
        1 <= count <= MAX_KEYFRAMES, f'{_WHAT}: {count}', f'1 to {MAX_KEYFRAMES} keyframes'
    )
    steps = len(checked['step_from'])
    snapshot.require(steps == count - 1, f'{_WHAT}: {steps} steps', f'{count - 1}')
    is_few = len(edges) <= MAX_EDGES
    snapshot.require(is_few, f'{_WHAT}: {len(edges)} edges', f'at most {MAX_EDGES}')
    is_before = checked['step_from'] < np.arange(1, count)
    snapshot.require(bool(is_before.all()), f'{_WHAT}: step_from', 'an earlier keyframe each')
    are_two = (edges < count).all() and (edges[:, 0] != edges[:, 1]).all()
    snapshot.require(bool(are_two), f'{_WHAT}: edges', f'two of the {count} keyframes each')


def _require_definite(matrices: Array, name: str, least: float) -> None:
    """Raise InputError unless the eigenvalues of (N, 3, 3) are above a share of the greatest."""
    values = np.linalg.eigvalsh(matrices)
    greatest = np.abs(values).max(axis=-1, initial=0.0)
    are_so = (values[:, 0] >= least * greatest) & (greatest > 0.0 if least > 0.0 else True)
    snapshot.require(bool(np.all(are_so)), f'{_WHAT}: {name}', 'positive definite matrices')


def _edges_of(
    checked: State, name: str, ends: NDArray[Any], inliers: NDArray[Any], is_robust: bool
) -> list[Edge]:
    information = symmetric_matrices(checked[f'{name}_information'])
    _require_definite(information, f'{name}_information', _MIN_VARIANCE)
    poses = checked[f'{name}_poses'].astype(np.float64)
    rows = zip(ends.tolist(), poses, information, inliers.tolist(), strict=True)
    return [
        Edge(a, b, T_a_b, own, is_robust, inlier_ratio=ratio) for (a, b), T_a_b, own, ratio in rows
    ]


def _heading_row(heading: Heading | None) -> tuple[float, ...]:
    """Yaw, its variance and that of the main direction; NaN without a heading."""
    if heading is None:
        return (np.nan, np.nan, np.nan)
    return (float(se2.wrap(heading.yaw)), heading.variance, heading.reference.variance)


def _heading_of(row: Array) -> Heading | None:
    yaw, variance, of_reference = row.tolist()
    if np.isnan(row).any():
        return None
    return Heading(yaw, variance, Reference(of_reference, NO_SHARE))


def _relative_poses(edges: Sequence[Edge]) -> NDArray[np.float32]:
    poses = np.array([edge.T_a_b for edge in edges], dtype=np.float64).reshape(-1, 3)
    poses[:, 2] = se2.wrap(poses[:, 2])
    return poses.astype(np.float32)


def _triangles(matrices: Sequence[Array]) -> Array:
    """Upper triangles (N, 6) of symmetric matrices (N, 3, 3)."""
    whole = np.array(matrices, dtype=np.float64).reshape(-1, 3, 3)
    return np.asarray(0.5 * (whole + whole.transpose(0, 2, 1)))[:, UPPER[0], UPPER[1]]


def symmetric_matrices(triangles: Array) -> Array:
    """Matrices (N, 3, 3) of their upper triangles (N, 6)."""
    whole = np.zeros((len(triangles), 3, 3))
    whole[:, UPPER[0], UPPER[1]] = triangles
    whole[:, UPPER[1], UPPER[0]] = triangles
    return whole
