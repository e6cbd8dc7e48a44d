"""What beams of a scan see through: walls of the map that they pass on their way.

From the right place a scan sees through what has changed since, as a door; from another place,
through walls all around.
"""

import math
from typing import NamedTuple

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.tiles import NO_TILE
from thinmap_ros.core.scan import SURE_REACH, Scan, is_most_missed
from thinmap_ros.core.se2 import BOUND_SIGMAS, Array, Mask
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

# Ratio of returns behind walls, between that of the worst real log (mean 0.11, of an office with
# much glass) and that of robots that were kidnapped (mean 0.4 in the first seconds).
MOST_SEEN_THROUGH = 0.25

_STEP_CELLS = 0.5

_BETWEEN_CELLS = 2.0  # a step may end in a cell whose offset is longer by less than this

_BEHIND_M = 0.3  # by which a beam ends behind a wall that it has passed through

_MIN_HITS = 2  # of a cell that is a wall for certain

_MAX_COSINE = 0.5  # cosine; more oblique beams pass the cells of a wall beside them

_SAME_SIDE = 0.5  # length of the mean double-angle vector of normals that agree


class SeenThrough(NamedTuple):
    """Walls of the map (M, 2), m, map frame, that beams have passed; ratio: of all that tell."""

    walls: Array
    ratio: float


NOTHING = SeenThrough(np.empty((0, 2)), 0.0)


def seen_through(
    scan: Scan, local_map: LocalMap, T_map_base: Array, covariance: Array
) -> SeenThrough:
    """What a scan sees through, one wall for each return that lies behind one.

    T_map_base (3,) with covariance (3, 3), map frame: a return behind a wall by no more than the
    pose is uncertain may lie in front of it. So drift up to a loop is told from a robot that was
    kidnapped.
    """
    total = int(np.count_nonzero(scan.returned))
    if total == 0:
        return NOTHING
    reaches_m = scan.ranges_m - _BEHIND_M - BOUND_SIGMAS * se2.sigma_m(covariance)
    walls = _passed(scan, scan.returned, reaches_m, local_map, T_map_base)
    return SeenThrough(walls, len(walls) / total)


def misses_walls(scan: Scan, local_map: LocalMap, T_map_base: Array, covariance: Array) -> bool:
    """Whether a scan has no return from most of the walls in range of a pose.

    T_map_base (3,) with covariance (3, 3), map frame.
    """
    return is_most_missed(scan, len(_missed(scan, local_map, T_map_base, covariance)))


def is_seen_through(scan: Scan, local_map: LocalMap, T_map_base: Array) -> bool:
    """Whether a scan at a pose (3,) sees through more of a map than has changed since.

    Beams without a return count where a wall is in range: of parallel walls each fits like the
    next one, and the space between them tells which one it is.
    """
    exact = np.zeros((3, 3))
    missed = len(_missed(scan, local_map, T_map_base, exact))
    returned = int(np.count_nonzero(scan.returned))
    through = returned * seen_through(scan, local_map, T_map_base, exact).ratio
    return missed + through > MOST_SEEN_THROUGH * (missed + returned)


def _missed(scan: Scan, local_map: LocalMap, T_map_base: Array, covariance: Array) -> Array:
    """Walls (M, 2), m, map frame, in range of a pose (3,), of which a scan has no return."""
    reach_m = SURE_REACH * scan.range_max_m - BOUND_SIGMAS * se2.sigma_m(covariance)
    reaches_m = np.full(scan.ranges_m.shape, reach_m)
    return _passed(scan, scan.no_return, reaches_m, local_map, T_map_base)


def _passed(
    scan: Scan, beams: Mask, reaches_m: Array, local_map: LocalMap, T_map_base: Array
) -> Array:
    """Nearest wall (M, 2), m, map frame, within the reach (N,), m, of each of some beams (N,)."""
    if local_map.is_empty:
        return NOTHING.walls
    T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
    angles = T_map_laser[2] + scan.angles_rad[beams]
    reaches = reaches_m[beams]
    return _walls_through(angles, reaches, T_map_laser, local_map.lattice, MIN_HIT_RATIO)


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
