"""Cells of a local map, and the distances that they should hold."""

import math

import numpy as np
from scipy.ndimage import distance_transform_edt

from thinmap_ros.core.slam.matching.local_map import (
    MAX_WALL_DISTANCE_M,
    MIN_HIT_RATIO,
    LocalMapConfig,
    off_wall,
)
from thinmap_ros.jit import kernel

CELL_M = LocalMapConfig().resolution_m

REACH = round(MAX_WALL_DISTANCE_M / CELL_M)


def cells_of(local_map):
    """All cells (R, C) of the rectangle of tiles, and the first row and column."""
    top, left, end_row, end_col = local_map.tiles.bounds()
    return read_cells(local_map, top, left, end_row - top, end_col - left), top, left


def read_cells(local_map, *rectangle):
    """Cells (R, C) of a rectangle (first row, first column, rows, columns), with their surfaces."""
    stores = [store.read(*rectangle) for store in (local_map.tiles, local_map.surfaces)]
    cells = np.empty(rectangle[2:], [field for store in stores for field in store.dtype.descr])
    for store in stores:
        for name in store.dtype.names:
            cells[name] = store[name]
    return cells


def walls_of(cells):
    return cells['hits'] > MIN_HIT_RATIO * cells['seen']


def nearest(cells):
    """The plain reference: distance of each cell from the nearest wall, inf beyond the reach."""
    away = distance_transform_edt(~walls_of(cells))
    return np.where(away <= REACH, away, np.inf)


def wall_distances(local_map, points):
    """Distances (N,) of points (N, 2), map frame, from walls, m; at most the reach."""
    return _wall_distances(points, local_map.lattice)


@kernel
def _wall_distances(points, lattice):
    found = np.full(len(points), lattice.reach * lattice.cell_m)
    for i in range(len(points)):
        x = points[i, 0] / lattice.cell_m - lattice.first_col
        y = points[i, 1] / lattice.cell_m - lattice.first_row
        _, is_near, dx, dy, _, _ = off_wall(lattice, x, y)
        if is_near:
            found[i] = min(found[i], lattice.cell_m * math.hypot(dx, dy))
    return found
