"""Walls of the local map that beams would hit."""

import math

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.tiles import NO_TILE
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.scan import Scan, is_most_missed
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.matching.local_map import (
    TILE_MASK,
    LocalMap,
    LocalMapView,
    cell_of,
    is_wall,
    slot_of,
)

_REACH = 0.9  # of range_max: a farther wall may be out of range
_STEP_CELLS = 0.5
_SIGMAS = 3.0


def misses_walls(scan: Scan, local_map: LocalMap, T_map_base: Array, covariance: Array) -> bool:
    """Whether a scan has no return from most of the walls in range of a pose.

    T_map_base (3,) with covariance (3, 3), map frame.
    """
    sigma_m = math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    reach_m = _REACH * scan.range_max_m - _SIGMAS * sigma_m
    if local_map.is_empty or not reach_m > 0.0:
        return False
    T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
    angles = T_map_laser[2] + scan.angles_rad[scan.no_return]
    hit_ratio = local_map.config.occupied_min_hit_ratio
    missed = _count_walls(angles, T_map_laser, reach_m, local_map.lattice, hit_ratio)
    return is_most_missed(scan, missed)


@kernel
def _count_walls(
    angles: Array, laser: Array, reach_m: float, lattice: LocalMapView, hit_ratio: float
) -> int:
    """Number of beams at angles (N,), map frame, that hit a wall; laser (3,): its pose."""
    steps = int(reach_m / (_STEP_CELLS * lattice.cell_m))
    count = 0
    for i in range(len(angles)):
        x = laser[0] / lattice.cell_m - lattice.first_col
        y = laser[1] / lattice.cell_m - lattice.first_row
        dx = _STEP_CELLS * math.cos(angles[i])
        dy = _STEP_CELLS * math.sin(angles[i])
        for _ in range(steps):
            x += dx
            y += dy
            row = cell_of(y)
            col = cell_of(x)
            slot = slot_of(lattice, row, col)
            if slot == NO_TILE:
                continue
            if is_wall(lattice.pool[slot, row & TILE_MASK, col & TILE_MASK], hit_ratio):
                count += 1
                break
    return count
