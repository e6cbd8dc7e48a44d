"""Conversion of messages of a bag (rosbags' classes, with the fields of ROS) to core values."""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import errors, se2
from thinmap_ros.core.errors import InputError, one_line
from thinmap_ros.core.grid.edits import KeepOut, KeepOutArea
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.se2 import SECOND_NS, Array, Place
from thinmap_ros.core.topology.regions import RegionKind


def time_ns(stamp: Any) -> int:
    """Time message as whole nanoseconds. Raises InputError if it is invalid."""
    if stamp.sec < 0 or stamp.nanosec >= SECOND_NS:
        raise InputError(
            f'stamp {stamp.sec} s, {stamp.nanosec} ns: '
            f'expected a time after 1970, ns below {SECOND_NS}'
        )
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def stamp_ns(message: Any) -> int:
    """Stamp of a message's header, ns. Raises InputError if it is invalid."""
    return time_ns(message.header.stamp)


def require_rotation(q: Any) -> None:
    """Raise InputError unless the norm of a quaternion with fields x, y, z, w is 1."""
    norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
    if not abs(norm - 1.0) < 0.01:
        raise InputError(f'quaternion ({q.x}, {q.y}, {q.z}, {q.w}): expected norm 1, not {norm}')


def yaw(q: Any) -> float:
    """Heading of a quaternion, rad."""
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def pose(message: Any) -> Array:
    """Planar pose (3,) of a geometry_msgs/Pose."""
    return se2.pose(message.position.x, message.position.y, yaw(message.orientation))


def checked_pose(message: Any) -> Array:
    """Planar pose (3,) of a geometry_msgs/Pose.

    Raises InputError where it is beyond 1000 km or no rotation.
    """
    errors.require_bounded('position', (message.position.x, message.position.y))
    require_rotation(message.orientation)
    return pose(message)


def scan(
    message: Any, ns: int, T_base_laser: Array | None = None, laser: LaserConfig | None = None
) -> Scan:
    """Scan of a sensor_msgs/LaserScan at a stamp (ns), of a bag or live.

    T_base_laser (3,): pose of the laser; laser: its parameters, None for their defaults. Raises
    InputError as `Scan.create`, and where it has no beams, too many, or impossible angles.
    """
    count = len(message.ranges)
    if not 0 < count <= errors.MAX_BEAMS:
        raise InputError(f'{count} beams: expected 1 to {errors.MAX_BEAMS}')
    errors.require_angles(message.angle_min, message.angle_increment, count)
    with np.errstate(invalid='ignore'):  # NaN is kept, whatever its bits
        made = Scan.create(
            ns,
            message.ranges,
            message.angle_min,
            message.angle_increment,
            message.range_min,
            message.range_max,
            T_base_laser,
            laser,
            message.time_increment,
            message.scan_time,
        )
    warning = errors.angle_warning(
        message.angle_min, message.angle_max, message.angle_increment, count
    )
    return replace(made, warning=warning, frame=message.header.frame_id.lstrip('/'))


def patch(message: Any) -> GridPatch:
    """Cells of a nav_msgs/OccupancyGrid."""
    info = message.info
    frame = GridFrame(
        info.origin.position.x, info.origin.position.y, round(float(info.resolution), 6)
    )
    return GridPatch(
        frame, np.asarray(message.data, dtype=np.int8).reshape(info.height, info.width)
    )


def map_update(message: Any) -> tuple[int, int, NDArray[np.int8]]:
    """Row, column and cells (H, W) of a map_msgs/OccupancyGridUpdate, of a bag or live.

    Raises InputError where size and data disagree, or cells are out of range.
    """
    if len(message.data) != message.width * message.height:
        raise InputError(
            f'update of {message.width} x {message.height} cells '
            f'with {len(message.data)} values: expected a value for each cell'
        )
    cells = np.frombuffer(message.data, dtype=np.int8).reshape(message.height, message.width)
    errors.require_occupancy(cells)
    return int(message.y), int(message.x), cells


class ShownRegion(NamedTuple):
    """A region as viewers show it: name, or kind and id; centre (x, y), m; outline (K, 2), m."""

    id: int
    kind: RegionKind
    name: str
    centre: Place
    area_m2: float
    outline: Array


def regions(message: Any) -> list[ShownRegion]:
    """Regions of a thinmap_msgs/RegionArray.

    Raises InputError where a kind is unknown or a number is invalid.
    """
    return [_region(each) for each in message.regions]


def _region(message: Any) -> ShownRegion:
    try:
        kind = RegionKind(message.kind)
    except ValueError as error:
        raise InputError(f'region {message.id}: kind {message.kind}: expected 0 to 2') from error
    centre = (float(message.center.x), float(message.center.y))
    area_m2 = float(message.area_m2)
    outline = corners(message.outline)
    numbers = [*centre, area_m2, *outline.ravel().tolist()]
    errors.require_bounded(f'region {message.id}', numbers)
    name = one_line(message.name) or f'{kind.name.lower()} {message.id}'
    return ShownRegion(int(message.id), kind, name, centre, area_m2, outline)


class ShownEndNode(NamedTuple):
    """An end node as its explorer shows it: place, m, position probability, and expected area.

    id: in the topological map. area_m2: that probably lies behind it.
    """

    id: int
    x: float
    y: float
    probability: float
    area_m2: float
    is_target: bool


def end_nodes(message: Any) -> list[ShownEndNode]:
    """End nodes of a thinmap_msgs/EndNodeArray. Raises InputError where a number is invalid."""
    found = []
    for node in message.end_nodes:
        place = (float(node.position.x), float(node.position.y))
        probability = float(node.position_probability)
        errors.require_bounded(f'end node {node.node_id}', place)
        errors.require_bounded(f'probability of end node {node.node_id}', (probability,), 1.0)
        area_m2 = float(node.expected_area_m2)
        found.append(
            ShownEndNode(int(node.node_id), *place, probability, area_m2, bool(node.is_target))
        )
    return found


def path(message: Any) -> Array:
    """Points (K, 2) of a nav_msgs/Path, m. Raises InputError where one is invalid."""
    positions = [each.pose.position for each in message.poses]
    points = np.array([[p.x, p.y] for p in positions], dtype=np.float64).reshape(-1, 2)
    errors.require_bounded('path', points.ravel().tolist())
    return points


def corners(polygon: Any) -> Array:
    """Corners (K, 2) of a geometry_msgs/Polygon."""
    return np.array([[p.x, p.y] for p in polygon.points], dtype=np.float64).reshape(-1, 2)


def keep_out(message: Any) -> KeepOut:
    """Areas of a thinmap_msgs/KeepOut. Raises InputError where one is invalid."""
    areas = [
        KeepOutArea(int(area.id), corners(area.corners), bool(area.is_wall))
        for area in message.areas
    ]
    return KeepOut([area.checked() for area in areas])
