"""Walls of the local map that beams would hit, or have passed through."""

import math
from typing import NamedTuple

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.tiles import NO_TILE
from thinmap_ros.core.scan import Scan, is_most_missed
from thinmap_ros.core.se2 import BOUND_SIGMAS, Array
from thinmap_ros.core.slam.matching.local_map import (
    MIN_HIT_RATIO,
    TILE_MASK,
    LocalMap,
    LocalMapView,
    cell_of,
    cells_to_wall,
    is_wall,
    slot_of,
)
from thinmap_ros.jit import kernel

_REACH = 0.9  # of range_max: a farther wall may be out of range
_STEP_CELLS = 0.5
_BETWEEN_CELLS = 2.0  # a way may end in a cell whose offset is longer by less than this
_BEHIND_M = 0.3  # by which a beam ends behind a wall that it has passed through
_MIN_HITS = 2  # of a cell that is a wall for certain
_MAX_COSINE = 0.5  # cosine; more oblique beams pass the cells of a wall beside them
_SAME_SIDE = 0.5  # length of the mean double-angle vector of normals that agree


def misses_walls(scan: Scan, local_map: LocalMap, T_map_base: Array, covariance: Array) -> bool:
    """Whether a scan has no return from most of the walls in range of a pose.

    T_map_base (3,) with covariance (3, 3), map frame.
    """
    reach_m = _REACH * scan.range_max_m - _uncertainty_m(covariance)
    if local_map.is_empty or not reach_m > 0.0:
        return False
    T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
    angles = T_map_laser[2] + scan.angles_rad[scan.no_return]
    missed = _count_walls(angles, T_map_laser, reach_m, local_map.lattice, MIN_HIT_RATIO)
    return is_most_missed(scan, missed)


class SeenThrough(NamedTuple):
    """Walls of the map (M, 2), m, map frame, behind which a scan has returns; ratio: of all."""

    walls: Array
    ratio: float


NOTHING = SeenThrough(np.empty((0, 2)), 0.0)


def seen_through(
    scan: Scan, local_map: LocalMap, T_map_base: Array, covariance: Array
) -> SeenThrough:
    """What a scan sees through, one wall for each return that lies behind one.

    T_map_base (3,) with covariance (3, 3), map frame: a return behind a wall by no more than the
    pose is uncertain may lie in front of it. So drift up to a loop is told from a robot that was
    carried off.
    """
    returned = scan.returned
    total = int(np.count_nonzero(returned))
    if local_map.is_empty or total == 0:
        return NOTHING
    T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
    angles = T_map_laser[2] + scan.angles_rad[returned]
    reaches_m = scan.ranges_m[returned] - _BEHIND_M - _uncertainty_m(covariance)
    walls = _walls_through(angles, reaches_m, T_map_laser, local_map.lattice, MIN_HIT_RATIO)
    return SeenThrough(walls, len(walls) / total)


def _uncertainty_m(covariance: Array) -> float:
    """How far a position with a covariance (3, 3) may be off, m."""
    return BOUND_SIGMAS * math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))


@kernel
def _walls_through(
    angles: Array, reaches_m: Array, laser: Array, lattice: LocalMapView, hit_ratio: float
) -> Array:
    """Nearest wall within the reach of each beam that has one, (M, 2), m, map frame.

    Of beams at angles (N,), map frame, with reaches (N,), m. laser (3,): its pose.
    """
    walls = np.empty((len(angles), 2))
    count = 0
    x0 = laser[0] / lattice.cell_m - lattice.first_col
    y0 = laser[1] / lattice.cell_m - lattice.first_row
    for i in range(len(angles)):
        cos = math.cos(angles[i])
        sin = math.sin(angles[i])
        steps = int(reaches_m[i] / (_STEP_CELLS * lattice.cell_m))
        step = 0
        while step < steps:
            step += 1
            row = cell_of(y0 + step * _STEP_CELLS * sin)
            col = cell_of(x0 + step * _STEP_CELLS * cos)
            slot = slot_of(lattice, row, col)
            if slot == NO_TILE:
                continue
            cell = lattice.pool[slot, row & TILE_MASK, col & TILE_MASK]
            free = min(cells_to_wall(cell), lattice.reach) - _BETWEEN_CELLS
            if free > 0.0:
                step += int(free / _STEP_CELLS)
                continue
            if cell['hits'] < _MIN_HITS or not is_wall(cell, hit_ratio):
                continue
            wall = lattice.surfaces[slot, row & TILE_MASK, col & TILE_MASK]
            if math.hypot(wall['cos2'], wall['sin2']) < _SAME_SIDE:
                continue
            normal = 0.5 * math.atan2(wall['sin2'], wall['cos2'])
            if abs(math.cos(normal) * cos + math.sin(normal) * sin) > _MAX_COSINE:
                walls[count, 0] = laser[0] + step * _STEP_CELLS * lattice.cell_m * cos
                walls[count, 1] = laser[1] + step * _STEP_CELLS * lattice.cell_m * sin
                count += 1
                break
    return walls[:count]


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
