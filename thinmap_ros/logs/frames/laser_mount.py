"""Poses of frames on a robot, from static transforms: chained in 3D, projected to the plane."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from thinmap_ros.core import errors, se2
from thinmap_ros.core.errors import ConfigError, InputError, quoted
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
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


def parse_laser_pose(text: str) -> Array:
    """Pose (3,) of a laser on its robot as "x,y,yaw" (m, m, rad). Raises ConfigError."""
    try:
        x, y, yaw = (float(part) for part in text.split(','))
        T = se2.pose(x, y, yaw)
    except ValueError:
        T = np.full(3, np.nan)
    if not se2.is_finite(T):
        raise ConfigError(f'laser_pose = {quoted(text)}: expected "x,y,yaw" in m, m, rad')
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
    """The transforms of /tf_static. Of several for one frame, the first one holds.

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
    target = _ancestors(links, target_frame)
    source = _ancestors(links, source_frame)
    for frame, placement in source.items():
        if frame in target:
            return target[frame].inverse().of(placement)
    return None


def _ancestors(links: _Links, frame: str) -> dict[str, _Placement]:
    """The frame and its ancestors, upwards, with its placement in each; a cycle ends it."""
    frame = _without_slash(frame)
    placement = _Placement(np.eye(3), np.zeros(3))
    found = {frame: placement}
    while frame in links:
        link = links[frame]
        frame = link.parent
        if frame in found:
            break
        placement = link.placement.of(placement)
        found[frame] = placement
    return found


def _without_slash(frame: str) -> str:
    """Frame name without the leading slash of ROS 1."""
    return str(frame).lstrip('/')
