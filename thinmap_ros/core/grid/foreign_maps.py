"""Maps of any publisher: costs as occupancy, and what a robot would see in them."""

import math

import numpy as np

from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

_LETHAL = 100
_BEAMS = 360
_RANGE_MIN_M = 0.01


def occupancy_from_costs(patch: GridPatch) -> GridPatch:
    """Occupancy of a costmap, in which costs below lethal only keep the robot at a distance.

    The radius of the robot is a parameter of the exploration: inflated cells are free space.
    """
    cells = np.where(patch.cells < 0, UNKNOWN, np.where(patch.cells >= _LETHAL, _LETHAL, 0))
    return GridPatch(patch.frame, cells.astype(np.int8))


def scan_in_map(patch: GridPatch, T_map_base: Array, range_m: float, stamp_ns: int) -> Scan:
    """Scan all round that the known free space of a map shows from a pose (3,).

    Stands for the scans of a robot that publishes none. range_m: the farthest that is seen.
    """
    resolution = patch.frame.resolution
    x = (float(T_map_base[0]) - patch.frame.origin_x) / resolution
    y = (float(T_map_base[1]) - patch.frame.origin_y) / resolution
    step = 2.0 * math.pi / _BEAMS
    angles = float(T_map_base[2]) - math.pi + step * np.arange(_BEAMS, dtype=np.float64)
    opaque = (~patch.free).astype(np.uint8)
    ranges = resolution * cast_rays(opaque, x, y, angles, range_m / resolution)
    return Scan.create(stamp_ns, ranges, -math.pi, step, _RANGE_MIN_M, range_m)
