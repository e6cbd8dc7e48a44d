"""What a scan sees, and where it may have changed the map."""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame
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
    offsets = places - T_map_laser[:2]
    bearings = np.arctan2(offsets[:, 1], offsets[:, 0]) - T_map_laser[2]
    is_ahead = np.abs(se2.wrap(bearings - 0.5 * (low + high))) <= 0.5 * (high - low)
    seen = is_ahead & (np.hypot(*offsets.T) < scan.range_max_m)
    laser = frame.cells_of(T_map_laser[:2])[0]
    cells = frame.cells_of(places)
    seen[seen] = [line_is_clear(free, *laser, *cell) for cell in cells[seen]]
    return np.asarray(seen)


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
