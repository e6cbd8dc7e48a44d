"""What a scan sees, and where it may have changed the map."""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import kernel

Mask = NDArray[np.bool_]
_RIM_M = 0.5


def field_of_view(scan: Scan) -> tuple[float, float]:
    """Field of view of a scan: its first and last direction, rad, laser frame.

    The outer beams, and as much again as between two beams.
    """
    last = scan.angle_min_rad + scan.angle_increment_rad * (scan.ranges_m.size - 1)
    more = abs(scan.angle_increment_rad)
    return min(scan.angle_min_rad, last) - more, max(scan.angle_min_rad, last) + more


def visible_places(
    places: Array, scan: Scan, T_map_laser: Array, free: Mask, frame: GridFrame
) -> Mask:
    """Which places (N, 2), m, a scan made by a laser at a pose (3,) sees, (N,).

    They lie in its range and field of view, with free cells (H, W) of a frame all the way.
    """
    low, high = field_of_view(scan)
    at = (frame.origin_x, frame.origin_y, frame.resolution)
    view = (scan.range_max_m, 0.5 * (low + high), 0.5 * (high - low))
    return np.asarray(_visible(free, at, T_map_laser, places, view))


def box_of_scan(scan: Scan, T_map_base: Array) -> Array:
    """Lower left and upper right corner (2, 2), m, of what a scan made at (3,) may have changed."""
    T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
    # Some drivers publish an infinite range_max.
    limits = (scan.range_min_m, min(scan.range_max_m, se2.MAX_COORDINATE_M))
    return np.asarray(
        _box(scan.ranges_m, limits, scan.angle_min_rad, scan.angle_increment_rad, T_map_laser)
    )


@kernel
def _box(
    ranges: Array, limits: tuple[float, float], first: float, step: float, laser: Array
) -> Array:
    """Corners (2, 2) of what beams (N,) from a laser at a pose (3,) reach, and _RIM_M more.

    See box_of_scan.
    """
    left = bottom = right = top = 0.0
    for i in range(ranges.size):
        if (ranges[i] >= limits[0] and ranges[i] > 0.0) or ranges[i] >= limits[1]:
            reach = min(ranges[i], limits[1])
            angle = first + step * i + laser[2]
            x = reach * math.cos(angle)
            y = reach * math.sin(angle)
            left = min(left, x)
            right = max(right, x)
            bottom = min(bottom, y)
            top = max(top, y)
    box = np.empty((2, 2))
    box[0, 0] = laser[0] + left - _RIM_M
    box[0, 1] = laser[1] + bottom - _RIM_M
    box[1, 0] = laser[0] + right + _RIM_M
    box[1, 1] = laser[1] + top + _RIM_M
    return box


@kernel
def _visible(
    free: Mask,
    frame: tuple[float, float, float],
    laser: Array,
    places: Array,
    view: tuple[float, float, float],
) -> Mask:
    """Which places a laser sees, see visible_places.

    frame: origin and resolution, m; view: range, m, middle and half of the field of view, rad.
    """
    x, y, resolution = frame
    reach_m, middle, half = view
    seen = np.zeros(places.shape[0], dtype=np.bool_)
    row = int(math.floor((laser[1] - y) / resolution))
    col = int(math.floor((laser[0] - x) / resolution))
    for i in range(places.shape[0]):
        dx = places[i, 0] - laser[0]
        dy = places[i, 1] - laser[1]
        if dx * dx + dy * dy >= reach_m * reach_m:
            continue
        off = math.pi - (math.pi - (math.atan2(dy, dx) - (laser[2] + middle))) % (2.0 * math.pi)
        if abs(off) <= half:
            to_row = int(math.floor((places[i, 1] - y) / resolution))
            to_col = int(math.floor((places[i, 0] - x) / resolution))
            seen[i] = line_is_clear(free, row, col, to_row, to_col)
    return seen
