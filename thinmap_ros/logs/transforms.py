"""Transforms between the frames of a robot: from /tf and /tf_static, interpolated, in the plane.

Our own buffer: tf2_ros has no wheel, and one buffer everywhere behaves the same everywhere.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from thinmap_ros.core import errors, se2
from thinmap_ros.core.errors import ConfigError, InputError, quoted
from thinmap_ros.core.odometry import OdometryBuffer
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.logs import decode
from thinmap_ros.logs.decode import require_rotation

_MAX_TILT_DEG = 15.0
# Smaller changes are of rounding, or of a calibration that was refined.
_MAX_CHANGE_M = 0.01
_MAX_CHANGE_RAD = 0.01


def rotation_matrix(q: Any) -> Array:
    """Rotation (3, 3) of a quaternion with fields x, y, z, w.

    Raises InputError if its norm is not 1.
    """
    require_rotation(q)
    x = q.x
    y = q.y
    z = q.z
    w = q.w
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def tilt_of(rotation: Array) -> float:
    """Angle between the vertical and that of a rotation (3, 3), rad; upside down is level, too."""
    return math.acos(min(abs(float(rotation[2, 2])), 1.0))


def parse_pose(text: str, name: str = 'laser_pose', form: str = 'x,y,yaw') -> Array:
    """Pose (3,), m, m, rad, of the text of an option. Raises ConfigError with its name and form."""
    try:
        x, y, heading = (float(part) for part in text.split(','))
        T = se2.pose(x, y, heading)
    except ValueError:
        T = np.full(3, np.nan)
    if not se2.is_finite(T):
        raise ConfigError(f'{name} = {quoted(text)}: expected "{form}" in m, m, rad')
    return T


@dataclasses.dataclass(frozen=True, eq=False)
class Mount:
    """Pose of a laser on its robot.

    T_base_laser (3,), and whether it is mounted upside down, with clockwise beams.
    """

    T_base_laser: Array
    upside_down: bool

    def apply(self, scan: Scan) -> Scan:
        """Return the scan with the pose of this laser, counter-clockwise."""
        if not self.upside_down:
            return dataclasses.replace(scan, T_base_laser=self.T_base_laser)
        last = scan.angle_min_rad + scan.angle_increment_rad * (scan.ranges_m.size - 1)
        ranges = np.ascontiguousarray(scan.ranges_m[::-1])
        return dataclasses.replace(
            scan,
            ranges_m=ranges,
            angle_min_rad=-last,
            T_base_laser=self.T_base_laser,
            first_beam_s=scan.first_beam_s + scan.beam_period_s * (scan.ranges_m.size - 1),
            beam_period_s=-scan.beam_period_s,
            is_mirrored=True,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Placement:
    """Rotation (3, 3) and translation (3,), m, of a frame in another one."""

    rotation: Array
    translation: Array

    def of(self, inner: '_Placement') -> '_Placement':
        """Placement in the outer frame of what is placed in this frame."""
        return _Placement(
            self.rotation @ inner.rotation, self.rotation @ inner.translation + self.translation
        )

    def inverse(self) -> '_Placement':
        return _Placement(self.rotation.T, -self.rotation.T @ self.translation)

    @property
    def pose(self) -> Array:
        """Planar pose (3,)."""
        yaw = math.atan2(self.rotation[1, 0], self.rotation[0, 0])
        return se2.pose(float(self.translation[0]), float(self.translation[1]), yaw)


@dataclasses.dataclass(frozen=True, eq=False)
class _Link:
    """Placement of a frame in its parent."""

    parent: str
    placement: _Placement


_Links = Mapping[str, _Link]


class StaticTransforms:
    """The transforms of /tf_static, chained in 3D. Of several for one frame, the first one holds.

    The map is made with it; `change` describes how the newest differs.
    """

    def __init__(self) -> None:
        self._first: dict[str, _Link] = {}
        self._newest: dict[str, _Link] = {}

    @property
    def frames(self) -> list[str]:
        """Names of the frames with known parents."""
        return sorted(self._first)

    def names(self, frame: str) -> bool:
        """Whether a frame is named by any transform, as child or parent."""
        wanted = _without_slash(frame)
        return wanted in self._first or any(wanted == link.parent for link in self._first.values())

    def child_of(self, frame: str) -> str:
        """A frame with this parent; empty if there is none."""
        parent = _without_slash(frame)
        return next((child for child, link in self._first.items() if link.parent == parent), '')

    def add(self, message: Any) -> bool:
        """Add a geometry_msgs/TransformStamped; returns whether it is the first of its frame.

        Raises InputError if it is invalid.
        """
        moved = message.transform.translation
        translation = np.array([moved.x, moved.y, moved.z], dtype=np.float64)
        errors.require_bounded(
            f'transform to {quoted(message.child_frame_id)}', translation.tolist()
        )
        placement = _Placement(rotation_matrix(message.transform.rotation), translation)
        child = _without_slash(message.child_frame_id)
        link = _Link(_without_slash(message.header.frame_id), placement)
        self._newest[child] = link
        return self._first.setdefault(child, link) is link

    def pose(self, target_frame: str, source_frame: str) -> Array | None:
        """Planar pose (3,) of the source frame in the target frame; None if not connected."""
        found = _connection(self._first, target_frame, source_frame)
        return None if found is None else found.pose

    def rotation(self, target_frame: str, source_frame: str) -> Array:
        """Rotation (3, 3) of the source frame in the target frame; none if not connected."""
        found = _connection(self._first, target_frame, source_frame)
        return np.eye(3) if found is None else found.rotation

    def laser_mount(self, laser_frame: str, base_frame: str) -> Mount | None:
        """Mount of a laser; None if no transforms connect its frame to that of the robot.

        Raises InputError if the laser is tilted: its scans are not planar.
        """
        return _mount(self._first, laser_frame, base_frame)

    def change(self, frame: str, base_frame: str) -> str:
        """How the newest pose of a frame on the robot differs from the first one; else ''.

        While its chain of frames is not complete, nothing is known.
        """
        try:
            used = _mount(self._first, frame, base_frame)
            found = _mount(self._newest, frame, base_frame)
        except InputError as error:
            return f'has changed: {error}'
        if used is None or found is None:
            return ''
        x, y, yaw = np.abs(se2.pose_difference(found.T_base_laser, used.T_base_laser)).tolist()
        moved_m = math.hypot(x, y)
        if found.upside_down != used.upside_down:
            return 'has been turned over'
        if moved_m <= _MAX_CHANGE_M and yaw <= _MAX_CHANGE_RAD:
            return ''
        return f'has changed by {moved_m:.2f} m, {yaw:.2f} rad'


def _mount(links: _Links, frame: str, base_frame: str) -> Mount | None:
    found = _connection(links, base_frame, frame)
    if found is None:
        return None
    up = float(found.rotation[2, 2])
    if abs(up) < math.cos(math.radians(_MAX_TILT_DEG)):
        tilt = math.degrees(math.acos(min(abs(up), 1.0)))
        expected = f'expected at most {_MAX_TILT_DEG:.0f}'
        raise InputError(f'laser {quoted(frame)} is tilted by {tilt:.0f} deg: {expected}')
    return Mount(found.pose, up < 0.0)


def _connection(links: _Links, target_frame: str, source_frame: str) -> _Placement | None:
    """Placement of the source frame in the target frame, by their common ancestor."""
    paths = _paths(links, target_frame, source_frame)
    if paths is None:
        return None
    target, source = (_placement(links, frames) for frames in paths)
    return target.inverse().of(source)


def _placement(links: _Links, frames: list[str]) -> _Placement:
    """Placement of the first frame in the parent of the last one."""
    placement = _Placement(np.eye(3), np.zeros(3))
    for frame in frames:
        placement = links[frame].placement.of(placement)
    return placement


def _paths(
    links: Mapping[str, '_Link | _Edge'], target_frame: str, source_frame: str
) -> tuple[list[str], list[str]] | None:
    """Frames from the target, and from the source, up to below their common ancestor, if any."""
    target = _path_to_root(links, _without_slash(target_frame))
    source = _path_to_root(links, _without_slash(source_frame))
    common = next((frame for frame in source if frame in target), None)
    if common is None:
        return None
    return target[: target.index(common)], source[: source.index(common)]


def _path_to_root(links: Mapping[str, '_Link | _Edge'], frame: str) -> list[str]:
    """The frame, its parent, and so on; a cycle ends where it closes."""
    path = [frame]
    while frame in links:
        frame = links[frame].parent
        if frame in path:
            break
        path.append(frame)
    return path


def _without_slash(frame: str) -> str:
    """Frame name without the leading slash of ROS 1."""
    return str(frame).lstrip('/')


_MAX_FRAMES = 10_000


class _Edge:
    """The transforms from a parent frame to one child; static ones hold at every time."""

    def __init__(self, parent: str) -> None:
        self.parent = parent
        self.rotation: Array = np.eye(3)  # (3, 3), the newest
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
        return _without_slash(frame) in self._used

    def clear(self) -> None:
        """Forget all but the static transforms: the time was set back."""
        self._edges = {
            child: edge for child, edge in self._edges.items() if edge.latest_stamp_ns is None
        }

    def add(self, transform: Any, is_static: bool) -> None:
        """Add a geometry_msgs/TransformStamped. Raises InputError where it is invalid."""
        child = _without_slash(transform.child_frame_id)
        parent = _without_slash(transform.header.frame_id)
        rotation = rotation_matrix(transform.transform.rotation)
        T_parent_child = _planar_pose(transform, rotation)
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent:
            if edge is None and len(self._edges) >= _MAX_FRAMES:
                raise InputError(f'transform to {quoted(child)}: more than {_MAX_FRAMES} frames')
            edge = _Edge(parent)
            self._edges[child] = edge
        edge.add(decode.stamp_ns(transform), T_parent_child, is_static)
        edge.rotation = rotation

    def lookup(self, target_frame: str, source_frame: str, stamp_ns: int | None = None) -> Array:
        """Pose of the source frame in the target frame, T_target_source (3,).

        stamp_ns: None for the newest time at which all transforms between them are known.
        Raises InputError where the frames are not connected, or not at that time.
        """
        up, down = self._path(target_frame, source_frame)
        self._used.update(up, down)
        ns = (self._latest_common_ns(up + down) or 0) if stamp_ns is None else stamp_ns
        return se2.compose(se2.invert(self._chain(up, ns)), self._chain(down, ns))

    def newest_tilt(self, target_frame: str, source_frame: str) -> float:
        """Tilt of the source frame against the target frame, by the newest transforms, rad.

        Raises InputError where the frames are not connected.
        """
        up, down = self._path(target_frame, source_frame)
        return tilt_of(self._rotation(up).T @ self._rotation(down))

    def _rotation(self, frames: list[str]) -> Array:
        """Rotation (3, 3) of the first frame in the parent of the last one."""
        R = np.eye(3)
        for frame in frames:
            R = self._edges[frame].rotation @ R
        return R

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
        paths = _paths(self._edges, target_frame, source_frame)
        if paths is None:
            raise InputError(
                f'no transform from {quoted(source_frame)} to {quoted(target_frame)}: '
                f'{self._missing(target_frame, source_frame)}'
            )
        return paths

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
        unknown = [f for f in (target_frame, source_frame) if _without_slash(f) not in known]
        if unknown:
            return f'frame {", ".join(quoted(frame) for frame in unknown)} is not on /tf'
        return 'they are in trees that are not connected'


def _planar_pose(transform: Any, rotation: Array) -> Array:
    moved = transform.transform.translation
    name = f'transform to {quoted(transform.child_frame_id)}'
    errors.require_bounded(name, (moved.x, moved.y, moved.z))
    return se2.pose(moved.x, moved.y, math.atan2(rotation[1, 0], rotation[0, 0]))


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
        child = _without_slash(transform.child_frame_id)
        if not (is_static and child in self._static):
            self._buffer.add(transform, is_static)
        if is_static:
            self._static.add(child)

    def next_sample(self) -> tuple[int, Array, float] | None:
        """Stamp in ns, T_odom_base (3,) and tilt (rad) of the newest time; None if it is not new.

        Raises InputError where a transform is not known at that time.
        """
        stamp_ns = self._buffer.latest_common_ns(self._odom_frame, self._base_frame)
        if stamp_ns is None or stamp_ns == self._last_ns:
            return None
        self._last_ns = stamp_ns
        tilt_rad = self._buffer.newest_tilt(self._odom_frame, self._base_frame)
        return stamp_ns, self._buffer.lookup(self._odom_frame, self._base_frame, stamp_ns), tilt_rad

    @property
    def missing(self) -> str:
        """What is missing of the chain of transforms; '' if it is complete."""
        try:
            self._buffer.lookup(self._odom_frame, self._base_frame)
        except InputError as error:
            return str(error)
        return ''


class OdometryFrames:
    """Reads T_odom_base of messages whose frames static transforms connect to odom and base frame.

    The transform from the map to the odom frame follows from these poses: in another frame they
    would place it wrongly. An empty frame is held to be that of the parameter. The first transform
    of a frame is kept.
    """

    def __init__(
        self,
        odom_frame: str,
        base_frame: str,
        subscribe: Callable[[], None],
        note: Callable[[str], None],
        static: StaticTransforms | None = None,
    ) -> None:
        """subscribe: is called once, when static transforms are needed: for `add_static`.

        note: receives, once for each field, that it is empty. static: those that are known already.
        """
        self._odom_frame = odom_frame.lstrip('/')
        self._base_frame = base_frame.lstrip('/')
        self._subscribe = subscribe
        self._is_subscribed = False
        self._note = note
        self._noted: set[str] = set()
        self._static = StaticTransforms() if static is None else static
        self._found: dict[tuple[str, str], Array] = {}

    def add_static(self, transform: Any) -> None:
        """Add a static geometry_msgs/TransformStamped. Raises InputError where it is invalid."""
        self._static.add(transform)

    def pose(self, message: Any) -> Array:
        """T_odom_base (3,) of a nav_msgs/Odometry.

        Raises InputError where it is invalid, or its frames.
        """
        T_parent_child = decode.checked_pose(message.pose.pose)
        parent = message.header.frame_id.lstrip('/')
        child = message.child_frame_id.lstrip('/')
        if parent != self._odom_frame:
            T_odom_parent = self._fixed('frame_id', parent, 'odom_frame', self._odom_frame)
            T_parent_child = se2.compose(T_odom_parent, T_parent_child)
        if child != self._base_frame:
            T_base_child = self._fixed('child_frame_id', child, 'base_frame', self._base_frame)
            T_parent_child = se2.compose(T_parent_child, se2.invert(T_base_child))
        return T_parent_child

    def tilt_rad(self, message: Any) -> float:
        """Tilt of the robot by a nav_msgs/Odometry, rad.

        The odometry frame is level. Raises InputError where the orientation is no rotation.
        """
        R_odom_child = rotation_matrix(message.pose.pose.orientation)
        child = message.child_frame_id.lstrip('/')
        return tilt_of(R_odom_child @ self._static.rotation(child, self._base_frame))

    def _fixed(self, field: str, frame: str, parameter: str, expected: str) -> Array:
        """Pose (3,) of a frame in the expected one."""
        if not frame:
            self._note_once(field, expected)
            return np.zeros(3)
        self._subscribe_once()
        key = (expected, frame)
        found = self._found.get(key)
        if found is None:
            found = self._static.pose(expected, frame)
        if found is None:
            raise InputError(
                f'{field} {quoted(frame)}: expected {quoted(expected)} ({parameter}), '
                'or a frame that static transforms connect to it'
            )
        self._found[key] = found
        return found

    def _subscribe_once(self) -> None:
        if not self._is_subscribed:
            self._is_subscribed = True
            self._subscribe()

    def _note_once(self, field: str, expected: str) -> None:
        if field not in self._noted:
            self._noted.add(field)
            self._note(f'{field} is empty: it is held to be {quoted(expected)}')
