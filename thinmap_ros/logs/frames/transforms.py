"""Transforms between the frames of a robot: from /tf and /tf_static, interpolated, in the plane.

Our own buffer: tf2_ros has no wheel, and one buffer everywhere behaves the same everywhere.
"""

import math
from typing import Any

import numpy as np

from thinmap_ros.core import errors, se2
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.odometry import OdometryBuffer
from thinmap_ros.core.se2 import Array
from thinmap_ros.logs import decode
from thinmap_ros.logs.frames.laser_mount import rotation_matrix

_MAX_FRAMES = 10_000


class _Edge:
    """The transforms from a parent frame to one child; static ones hold at every time."""

    def __init__(self, parent: str) -> None:
        self.parent = parent
        self._fixed: Array | None = None
        self._samples = OdometryBuffer()

    @property
    def latest_stamp_ns(self) -> int | None:
        """Stamp of the newest sample; None for a static transform."""
        return None if self._fixed is not None else self._samples.latest_stamp_ns

    def add(self, stamp_ns: int, T_parent_child: Array, is_static: bool) -> None:
        """Add a transform (3,)."""
        if is_static:
            self._fixed = T_parent_child
        else:
            self._fixed = None
            self._samples.add(stamp_ns, T_parent_child)

    def at(self, stamp_ns: int) -> Array | None:
        """T_parent_child (3,) at a stamp; None outside of the samples."""
        return self._samples.interpolate(stamp_ns) if self._fixed is None else self._fixed


class TransformBuffer:
    """The last ten seconds of all transforms, looked up along the tree of frames."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._used: set[str] = set()

    def is_used(self, frame: str) -> bool:
        """Whether a transform to this child frame was needed for a lookup."""
        return _frame_name(frame) in self._used

    def clear(self) -> None:
        """Forget all but the static transforms: the time was set back."""
        self._edges = {
            child: edge for child, edge in self._edges.items() if edge.latest_stamp_ns is None
        }

    def add(self, transform: Any, is_static: bool) -> None:
        """Add a geometry_msgs/TransformStamped. Raises InputError where it is invalid."""
        child = _frame_name(transform.child_frame_id)
        parent = _frame_name(transform.header.frame_id)
        T_parent_child = _planar_pose(transform)
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent:
            if edge is None and len(self._edges) >= _MAX_FRAMES:
                raise InputError(f'transform to {quoted(child)}: more than {_MAX_FRAMES} frames')
            edge = _Edge(parent)
            self._edges[child] = edge
        edge.add(decode.stamp_ns(transform), T_parent_child, is_static)

    def lookup(self, target_frame: str, source_frame: str, stamp_ns: int | None = None) -> Array:
        """Pose of the source frame in the target frame, T_target_source (3,).

        stamp_ns: None for the newest time at which all transforms between them are known.
        Raises InputError where the frames are not connected, or not at that time.
        """
        up, down = self._path(target_frame, source_frame)
        self._used.update(up, down)
        ns = (self._latest_common_ns(up + down) or 0) if stamp_ns is None else stamp_ns
        return se2.compose(se2.invert(self._chain(up, ns)), self._chain(down, ns))

    def latest_common_ns(self, target_frame: str, source_frame: str) -> int | None:
        """Newest stamp at which all transforms between two frames are known; None: never."""
        try:
            up, down = self._path(target_frame, source_frame)
        except InputError:
            return None
        self._used.update(up, down)
        return self._latest_common_ns(up + down)

    def _path(self, target_frame: str, source_frame: str) -> tuple[list[str], list[str]]:
        """Frames from the target, and from the source, up to below their common ancestor."""
        target = self._path_to_root(_frame_name(target_frame))
        source = self._path_to_root(_frame_name(source_frame))
        common = next((frame for frame in source if frame in target), None)
        if common is None:
            raise InputError(
                f'no transform from {quoted(source_frame)} to {quoted(target_frame)}: '
                f'{self._missing(target_frame, source_frame)}'
            )
        return target[: target.index(common)], source[: source.index(common)]

    def _path_to_root(self, frame: str) -> list[str]:
        """The frame, its parent, and so on; a cycle ends where it closes."""
        path = [frame]
        while frame in self._edges:
            frame = self._edges[frame].parent
            if frame in path:
                break
            path.append(frame)
        return path

    def _chain(self, frames: list[str], ns: int) -> Array:
        """Pose of the first frame in the parent of the last one, (3,)."""
        T = np.zeros(3)
        for frame in frames:
            T_parent_frame = self._edges[frame].at(ns)
            if T_parent_frame is None:
                raise InputError(self._no_sample(frame, ns))
            T = se2.compose(T_parent_frame, T)
        return T

    def _latest_common_ns(self, frames: list[str]) -> int | None:
        stamps = [self._edges[frame].latest_stamp_ns for frame in frames]
        return min((stamp for stamp in stamps if stamp is not None), default=None)

    def _no_sample(self, frame: str, ns: int) -> str:
        edge = self._edges[frame]
        name = f'transform from {quoted(frame)} to {quoted(edge.parent)}'
        latest_ns = edge.latest_stamp_ns
        if latest_ns is not None and ns > latest_ns:
            return f'{name}: the newest is {(ns - latest_ns) / 1e9:.3f} s older than requested'
        return f'{name}: none at {ns / 1e9:.3f} s'

    def _missing(self, target_frame: str, source_frame: str) -> str:
        known = set(self._edges) | {edge.parent for edge in self._edges.values()}
        unknown = [f for f in (target_frame, source_frame) if _frame_name(f) not in known]
        if unknown:
            return f'frame {", ".join(quoted(frame) for frame in unknown)} is not on /tf'
        return 'they are in trees that are not connected'


def _planar_pose(transform: Any) -> Array:
    moved = transform.transform.translation
    name = f'transform to {quoted(transform.child_frame_id)}'
    errors.require_bounded(name, (moved.x, moved.y, moved.z))
    rotation = rotation_matrix(transform.transform.rotation)
    return se2.pose(moved.x, moved.y, math.atan2(rotation[1, 0], rotation[0, 0]))


def _frame_name(frame: str) -> str:
    """Frame name without the leading slash of ROS 1."""
    return str(frame).lstrip('/')


class TransformOdometry:
    """T_odom_base from transforms: a sample at each new time at which all of them are known.

    Of several static transforms for one frame, the first one holds.
    """

    def __init__(self, odom_frame: str, base_frame: str) -> None:
        self._odom_frame = odom_frame
        self._base_frame = base_frame
        self._buffer = TransformBuffer()
        self._static: set[str] = set()
        self._last_ns: int | None = None

    def clear(self) -> None:
        """Forget all but the static transforms: the time was set back."""
        self._buffer.clear()
        self._last_ns = None

    def is_used(self, frame: str) -> bool:
        """Whether the transform to this child frame is one of those to the robot."""
        return self._buffer.is_used(frame)

    def add(self, transform: Any, is_static: bool) -> None:
        """Add a geometry_msgs/TransformStamped. Raises InputError where it is invalid."""
        child = _frame_name(transform.child_frame_id)
        if not (is_static and child in self._static):
            self._buffer.add(transform, is_static)
        if is_static:
            self._static.add(child)

    def next_sample(self) -> tuple[int, Array] | None:
        """Stamp in ns and T_odom_base (3,) of the newest time; None if there is no new one.

        Raises InputError where a transform is not known at that time.
        """
        stamp_ns = self._buffer.latest_common_ns(self._odom_frame, self._base_frame)
        if stamp_ns is None or stamp_ns == self._last_ns:
            return None
        self._last_ns = stamp_ns
        return stamp_ns, self._buffer.lookup(self._odom_frame, self._base_frame, stamp_ns)

    @property
    def missing(self) -> str:
        """What is missing of the chain of transforms; '' if it is complete."""
        try:
            self._buffer.lookup(self._odom_frame, self._base_frame)
        except InputError as error:
            return str(error)
        return ''
