"""Conversion between ROS messages and core values; message classes by name."""

import math
import re
from array import array
from collections.abc import Iterable
from importlib import import_module
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import (
    Point,
    Point32,
    Polygon,
    Pose,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    TransformStamped,
    Twist,
)
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import MapMetaData, OccupancyGrid, Odometry, Path
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header

from thinmap_msgs.msg import ProbabilityGrid, SlamStatus
from thinmap_msgs.msg import TopologicalMap as TopologicalMapMsg
from thinmap_ros.core import errors, se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.correction import CorrectedPoses
from thinmap_ros.core.grid.mapper import WholeMap
from thinmap_ros.core.grid.moved import aligned_patch
from thinmap_ros.core.grid.patch import MAX_RESOLUTION_M, MIN_RESOLUTION_M, GridPatch
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.slam.odometry import UNKNOWN
from thinmap_ros.core.stage import Estimate
from thinmap_ros.core.topology.graph import FIELDS, TopologicalMap, flat_topology
from thinmap_ros.logs import decode

# A bag or a publisher cannot name anything else to import.
_TYPE_NAME = re.compile(r'([a-z]\w*)/msg/([A-Z]\w*)', re.ASCII)


def message_class(type_name: str) -> Any:
    """Class of a message type such as sensor_msgs/msg/LaserScan.

    Raises InputError where it is not installed.
    """
    parts = _TYPE_NAME.fullmatch(type_name)
    if parts is None:
        raise InputError(f'message type {errors.quoted_name(type_name)}: expected PACKAGE/msg/NAME')
    try:
        return getattr(import_module(f'{parts[1]}.msg'), parts[2])
    except (ImportError, AttributeError) as error:
        raise InputError(
            f'message type {errors.quoted_name(type_name)}: not installed here'
        ) from error


def stamp_ns(stamp: Time) -> int:
    """Time message as whole nanoseconds. Raises InputError where it is invalid."""
    return decode.time_ns(stamp)


def time_msg(ns: int) -> Time:
    """Whole nanoseconds as a time message."""
    return Time(sec=ns // SECOND_NS, nanosec=ns % SECOND_NS)


def duration_msg(seconds: float) -> Duration:
    """Duration message of seconds."""
    ns = round(max(seconds, 0.0) * SECOND_NS)
    return Duration(sec=ns // SECOND_NS, nanosec=ns % SECOND_NS)


def seconds(duration: Duration) -> float:
    """Duration message as seconds."""
    return float(duration.sec) + float(duration.nanosec) / SECOND_NS


def header(frame_id: str, ns: int) -> Header:
    """Header with frame and stamp."""
    return Header(frame_id=frame_id, stamp=time_msg(ns))


def scan_from_msg(
    message: LaserScan, T_base_laser: Array, laser: LaserConfig | None = None
) -> Scan:
    """Scan of a message; T_base_laser (3,); laser: parameters, None for their defaults.

    Raises InputError as `decode.scan`, and where its stamp is invalid.
    """
    ns = stamp_ns(message.header.stamp)
    return decode.scan(message, ns, T_base_laser, laser)


def scan_msg(scan: Scan, frame_id: str, scan_time_s: float) -> LaserScan:
    """Message of a scan."""
    ranges = array('f')
    ranges.frombytes(scan.ranges_m.astype(np.float32).tobytes())
    return LaserScan(
        header=header(frame_id, scan.stamp_ns),
        angle_min=scan.angle_min_rad,
        angle_max=scan.angle_min_rad + scan.angle_increment_rad * (scan.ranges_m.size - 1),
        angle_increment=scan.angle_increment_rad,
        time_increment=scan.beam_period_s,
        range_min=scan.range_min_m,
        range_max=scan.range_max_m,
        scan_time=scan_time_s,
        ranges=ranges,
    )


def quaternion_msg(yaw_rad: float) -> Quaternion:
    """Quaternion of a rotation about z."""
    return Quaternion(z=math.sin(yaw_rad / 2.0), w=math.cos(yaw_rad / 2.0))


def require_layout(message: Any) -> None:
    """Raise InputError where the bytes of a message are not of the layout of its definition."""
    if message.layout != message.LAYOUT:
        raise InputError(
            f'{type(message).__name__} of layout {message.layout}: expected {message.LAYOUT}: is '
            'its robot of another version?'
        )


def pose_from_msg(message: Pose) -> Array:
    """Planar pose (3,). Raises InputError where it is beyond 1000 km or no rotation."""
    return decode.checked_pose(message)


def pose_msg(T: Array) -> Pose:
    """Planar pose (3,) as a message."""
    return Pose(
        position=Point(x=float(T[0]), y=float(T[1])), orientation=quaternion_msg(float(T[2]))
    )


def pose_stamped_msg(T: Array, frame_id: str, ns: int) -> PoseStamped:
    """Planar pose (3,) in a frame at a time."""
    return PoseStamped(header=header(frame_id, ns), pose=pose_msg(T))


def pose_with_covariance_msg(
    T: Array, covariance: Array, frame_id: str, ns: int
) -> PoseWithCovarianceStamped:
    """Planar pose (3,) with its covariance (3, 3) over x, y, theta."""
    message = PoseWithCovarianceStamped(header=header(frame_id, ns))
    message.pose.pose = pose_msg(T)
    full = np.zeros((6, 6))
    full[np.ix_((0, 1, 5), (0, 1, 5))] = covariance
    message.pose.covariance = full.ravel()
    return message


def estimate_msg(estimate: Estimate, frame_id: str, ns: int) -> PoseWithCovarianceStamped:
    """Pose of an estimate; where the robot is lost, its covariance says so to all who know no mode.

    As AMCL and robot_localization have it.
    """
    unsure = UNKNOWN if estimate.is_lost else np.zeros((3, 3))
    return pose_with_covariance_msg(estimate.T_map_base, estimate.covariance + unsure, frame_id, ns)


def covariance_from_msg(message: PoseWithCovarianceStamped) -> Array:
    """Covariance (3, 3) over x, y, theta.

    Raises InputError where it is not finite or has a negative eigenvalue.
    """
    full = np.asarray(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    part = full[np.ix_((0, 1, 5), (0, 1, 5))]
    errors.require_bounded('covariance', part.ravel().tolist())
    part = (part + part.T) / 2.0
    if np.linalg.eigvalsh(part).min() < -1e-9:
        raise InputError(f'covariance {part.tolist()}: expected no negative eigenvalue')
    return part


def odometry_msg(
    T: Array, velocity: tuple[float, float], frames: tuple[str, str], ns: int
) -> Odometry:
    """Odometry: pose (3,), (v m/s, w rad/s), (frame, child frame)."""
    message = Odometry(header=header(frames[0], ns), child_frame_id=frames[1])
    message.pose.pose = pose_msg(T)
    message.twist.twist.linear.x, message.twist.twist.angular.z = velocity
    return message


def polygon_msg(corners: Iterable[tuple[float, float]]) -> Polygon:
    """Polygon of corners x, y, m."""
    return Polygon(points=[Point32(x=x, y=y) for x, y in corners])


def twist_msg(v: float, w: float) -> Twist:
    """Velocity command: v m/s ahead, w rad/s to the left."""
    message = Twist()
    message.linear.x = v
    message.angular.z = w
    return message


def transform_msg(T: Array, frame_id: str, child_frame_id: str, ns: int) -> TransformStamped:
    """Planar transform (3,)."""
    message = TransformStamped(header=header(frame_id, ns), child_frame_id=child_frame_id)
    message.transform.translation.x = float(T[0])
    message.transform.translation.y = float(T[1])
    message.transform.rotation = quaternion_msg(float(T[2]))
    return message


def path_msg(points: Array, frame_id: str, ns: int) -> Path:
    """Path through points (N, 2) or poses (N, 3)."""
    poses = points if points.shape[1] == 3 else np.column_stack([points, np.zeros(len(points))])
    return Path(
        header=header(frame_id, ns), poses=[pose_stamped_msg(T, frame_id, ns) for T in poses]
    )


def trajectory_msg(stamps_ns: list[int], poses: Array, frame_id: str, ns: int) -> Path:
    """Path of poses (N, 3) with their stamps."""
    message = path_msg(poses, frame_id, ns)
    for pose, stamp in zip(message.poses, stamps_ns, strict=True):
        pose.header.stamp = time_msg(stamp)
    return message


def trajectory_from_msg(message: Path) -> tuple[NDArray[np.int64], Array]:
    """Stamps (N,) and poses (N, 3) of a path. Raises InputError where a pose is invalid."""
    stamps = np.array([stamp_ns(pose.header.stamp) for pose in message.poses], dtype=np.int64)
    return stamps, np.array([pose_from_msg(pose.pose) for pose in message.poses]).reshape(-1, 3)


def grid_msg(patch: GridPatch, frame_id: str, ns: int, load_ns: int = 0) -> OccupancyGrid:
    """Map message; load_ns: time at which the map was loaded or begun."""
    message = OccupancyGrid(header=header(frame_id, ns), info=_map_info(patch, load_ns))
    message.data = _int8_array(patch.cells)
    return message


def map_update_msg(
    whole: GridPatch, part: GridPatch, frame_id: str, ns: int
) -> OccupancyGridUpdate:
    """Message with the part of a whole map that has changed."""
    row, col = whole.offset_of(part)
    update = OccupancyGridUpdate(header=header(frame_id, ns), x=col, y=row)
    update.height, update.width = part.shape
    update.data = _int8_array(part.cells)
    return update


def probability_grid_msg(
    patch: GridPatch,
    frame_id: str,
    ns: int,
    load_ns: int = 0,
    corrected_ns: int = 0,
    map_id: int = 0,
) -> ProbabilityGrid:
    """Message of occupancy probabilities.

    load_ns: time at which the map was loaded or begun; corrected_ns: stamp of the newest trajectory
    that all cells follow; map_id: as in SlamStatus.
    """
    message = ProbabilityGrid(header=header(frame_id, ns), info=_map_info(patch, load_ns))
    message.correction_stamp = time_msg(corrected_ns)
    message.map_id = map_id
    message.data = _int8_array(patch.cells)
    return message


def whole_map_msg(
    whole: WholeMap, frame_id: str, ns: int, load_ns: int = 0, map_id: int = 0
) -> ProbabilityGrid:
    """Message of a whole map, and of where the newest correction has moved it."""
    message = probability_grid_msg(whole.patch, frame_id, ns, load_ns, whole.corrected_ns, map_id)
    message.previous_correction_stamp = time_msg(whole.previous_ns)
    message.poses_before = array('d', whole.moved.before.tobytes())
    message.poses_after = array('d', whole.moved.after.tobytes())
    return message


def whole_map_from_msg(message: ProbabilityGrid) -> WholeMap:
    """Map of a message. Raises InputError where cells, a stamp or a pose is invalid."""
    return WholeMap(
        grid_from_msg(message),
        stamp_ns(message.correction_stamp),
        stamp_ns(message.previous_correction_stamp),
        _moved(message),
    )


def _moved(message: ProbabilityGrid) -> CorrectedPoses:
    before = np.array(message.poses_before)
    after = np.array(message.poses_after)
    if before.size != after.size or before.size % 3:
        raise InputError(
            f'map with {before.size} numbers of poses before a correction and {after.size} after '
            'it: expected three for each pose'
        )
    if not (np.abs([before, after]) <= se2.MAX_COORDINATE_M).all():
        raise InputError('map with a pose of a correction that is no place: expected numbers')
    return CorrectedPoses(before.reshape(-1, 3), after.reshape(-1, 3))


def _map_info(patch: GridPatch, load_ns: int) -> MapMetaData:
    info = MapMetaData(map_load_time=time_msg(load_ns), resolution=patch.frame.resolution)
    info.height, info.width = patch.shape
    info.origin = pose_msg(np.array([patch.frame.origin_x, patch.frame.origin_y, 0.0]))
    return info


def _int8_array(cells: NDArray[np.int8]) -> 'array[int]':
    data = array('b')
    data.frombytes(np.ascontiguousarray(cells).tobytes())
    return data


def grid_from_msg(message: OccupancyGrid | ProbabilityGrid) -> GridPatch:
    """Patch of a map message; one that is rotated is resampled.

    Raises InputError where size and data disagree, or cells or resolution are out of range.
    """
    info = message.info
    # The message holds a float32: 0.1 must be the same number on both sides.
    resolution = round(float(info.resolution), 6)
    size_fits = len(message.data) == info.width * info.height
    if not size_fits or not MIN_RESOLUTION_M <= resolution <= MAX_RESOLUTION_M:
        raise InputError(
            f'map of {info.width} x {info.height} cells of {resolution} m '
            f'with {len(message.data)} values: expected a value for each cell, '
            f'and cells of {MIN_RESOLUTION_M} to {MAX_RESOLUTION_M} m'
        )
    origin = pose_from_msg(info.origin)
    cells = np.frombuffer(message.data, dtype=np.int8).reshape(info.height, info.width)
    errors.require_occupancy(cells)
    return aligned_patch(origin, resolution, cells)


def is_lost(status: SlamStatus) -> bool:
    """Whether the place of the robot in the map is unknown."""
    return status.state in (SlamStatus.LOST, SlamStatus.MAPPING_APART)


def topology_msg(
    topology: TopologicalMap, frame_id: str, ns: int, map_id: int = 0
) -> TopologicalMapMsg:
    """Message of a topological map; map_id: of its grid."""
    message = TopologicalMapMsg(header=header(frame_id, ns), map_id=map_id)
    for name, values in flat_topology(topology).items():
        # An array of the field's type: rclpy copies it as it is, and anything else value by value.
        getattr(message, name).frombytes(values.tobytes())
    return message


def is_same_topology(one: TopologicalMapMsg, other: TopologicalMapMsg) -> bool:
    """Whether two messages hold the same graph of the same map, at whatever time."""
    names = ('map_id', *FIELDS)
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)
