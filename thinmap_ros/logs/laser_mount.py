"""Poses of lasers on a robot, from static transforms: chained in 3D, projected to the plane."""

import dataclasses
import math
from typing import Any

import numpy as np

from thinmap_ros.core import se2, validation
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

_MAX_TILT_DEG = 15.0


def rotation_matrix(q: Any) -> Array:
    """Rotation (3, 3) of a quaternion with fields x, y, z, w.

    Raises InputError if its norm is not 1.
    """
    norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
    if not abs(norm - 1.0) < 0.01:
        raise InputError(f'quaternion ({q.x}, {q.y}, {q.z}, {q.w}): expected norm 1, not {norm}')
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


class StaticTransforms:
    """The transforms of /tf_static by child frame."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array, Array]] = {}

    @property
    def frames(self) -> list[str]:
        """Names of the frames with known parents."""
        return sorted(self._parents)

    def add(self, message: Any) -> None:
        """Add a geometry_msgs/TransformStamped. Raises InputError if it is invalid."""
        moved = message.transform.translation
        translation = np.array([moved.x, moved.y, moved.z], dtype=np.float64)
        validation.require_bounded(
            f'transform to {quoted(message.child_frame_id)}', translation.tolist()
        )
        rotation = rotation_matrix(message.transform.rotation)
        self._parents[_without_slash(message.child_frame_id)] = (
            _without_slash(message.header.frame_id),
            rotation,
            translation,
        )

    def laser_mount(self, laser_frame: str, base_frame: str) -> Mount | None:
        """Mount of a laser; None if no transforms connect its frame to that of the robot.

        Raises InputError if the laser is tilted: its scans are not planar.
        """
        rotation = np.eye(3)
        translation = np.zeros(3)
        frame = _without_slash(laser_frame)
        for _ in range(len(self._parents) + 1):
            if frame == _without_slash(base_frame):
                return _projected(laser_frame, rotation, translation)
            if frame not in self._parents:
                return None
            frame, turned, moved = self._parents[frame]
            rotation = turned @ rotation
            translation = turned @ translation + moved
        return None  # a cycle of frames


def _projected(frame: str, rotation: Array, translation: Array) -> Mount:
    up = float(rotation[2, 2])
    if abs(up) < math.cos(math.radians(_MAX_TILT_DEG)):
        tilt = math.degrees(math.acos(min(abs(up), 1.0)))
        expected = f'expected at most {_MAX_TILT_DEG:.0f}'
        raise InputError(f'laser {quoted(frame)} is tilted by {tilt:.0f} deg: {expected}')
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    return Mount(se2.pose(float(translation[0]), float(translation[1]), yaw), up < 0.0)


def _without_slash(frame: str) -> str:
    """Frame name without the leading slash of ROS 1."""
    return frame.lstrip('/')
