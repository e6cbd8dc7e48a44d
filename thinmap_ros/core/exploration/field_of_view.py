"""What a scan looks at, and how far it may have changed the map."""

import math

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

_RIM_M = 0.5


def field_of_view(scan: Scan) -> tuple[float, float]:
    """Directions between which a scan looks, rad, laser frame.

    Its outer beams and as much again as between two.
    """
    last = scan.angle_min_rad + scan.angle_increment_rad * (scan.ranges_m.size - 1)
    more = abs(scan.angle_increment_rad)
    return min(scan.angle_min_rad, last) - more, max(scan.angle_min_rad, last) + more


def directions_of_view(scan: Scan, T_map_base: Array) -> Array:
    """First (smaller) and last direction of view (2,) of a scan at a pose (3,), rad, map frame."""
    last = scan.angle_min_rad + scan.angle_increment_rad * (scan.ranges_m.size - 1)
    heading = float(T_map_base[2] + scan.T_base_laser[2])
    return np.array(
        [heading + min(scan.angle_min_rad, last), heading + max(scan.angle_min_rad, last)]
    )


def box_of_scan(scan: Scan, T_map_base: Array) -> Array:
    """Lower left and upper right corner (2, 2), m, of what a scan at (3,) can have changed."""
    T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
    # Some drivers say that their laser's range has no end.
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
