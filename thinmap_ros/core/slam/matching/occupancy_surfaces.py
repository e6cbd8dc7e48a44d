"""Surface points on the walls of an occupancy map, for scan matching."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.occupancy import OccupancyConfig
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array

# (row, col) from an occupied cell to the free one beside it.
_SIDES = ((0, 1), (0, -1), (1, 0), (-1, 0))


class WallFaces(NamedTuple):
    """Points (N, 2) on walls, m, map frame, in order along each wall, and their normal (2,)."""

    points: Array
    normal: Array


def occupied_surface_points(patch: GridPatch) -> list[WallFaces]:
    """Points on the faces between occupied and free cells, for each of the four directions.

    A beam occupies the cell that is surface_thickness_m behind its end. So the surface is on
    average half a cell, less that depth, behind the face of the cell.
    """
    depth_m = max(0.5 * patch.frame.resolution - OccupancyConfig().surface_thickness_m, 0.0)
    return [_faces(patch, row, col, depth_m) for row, col in _SIDES]


def free_cells(patch: GridPatch, cell_m: float) -> tuple[NDArray[np.bool_], int, int]:
    """Cells of a lattice with cells of cell_m that an occupancy map knows to be free.

    Returns them as (H, W), and row and column of the first one.
    """
    frame = patch.frame
    rows = _nearest(frame.origin_y, patch.shape[0], frame.resolution, cell_m)
    cols = _nearest(frame.origin_x, patch.shape[1], frame.resolution, cell_m)
    free = patch.free[rows.indices][:, cols.indices]
    return free, rows.first, cols.first


class _Axis(NamedTuple):
    """The first cell of a lattice along an axis, and the cell (N,) of a map at each of them."""

    first: int
    indices: NDArray[np.int64]


def _nearest(origin_m: float, count: int, resolution_m: float, cell_m: float) -> _Axis:
    """Cells of a lattice whose centres lie in a map with `count` cells from an origin."""
    first = math.ceil(origin_m / cell_m - 0.5)
    end = math.ceil((origin_m + count * resolution_m) / cell_m - 0.5)
    centres = (np.arange(first, end) + 0.5) * cell_m
    indices = np.floor((centres - origin_m) / resolution_m).astype(np.int64)
    return _Axis(first, np.clip(indices, 0, count - 1))


def _faces(patch: GridPatch, row: int, col: int, depth_m: float) -> WallFaces:
    """Faces of the occupied cells towards a free neighbour at the offset (row, col)."""
    rows, cols = patch.shape
    free = np.zeros((rows, cols), dtype=np.bool_)
    here = (slice(max(-row, 0), rows - max(row, 0)), slice(max(-col, 0), cols - max(col, 0)))
    there = (slice(max(row, 0), rows - max(-row, 0)), slice(max(col, 0), cols - max(-col, 0)))
    free[here] = patch.free[there]
    cells = _along(np.argwhere(patch.occupied & free), row)
    edge = patch.frame.resolution
    side = np.array([col, row], dtype=np.float64)
    middles = patch.frame.centres_of(cells) + (0.5 * edge - depth_m) * side
    along = 0.25 * edge * np.abs(side[::-1])
    points = np.stack([middles - along, middles + along], axis=1).reshape(-1, 2)
    return WallFaces(points, side)


def _along(cells: NDArray[np.int64], row: int) -> NDArray[np.int64]:
    """Cells (N, 2) in order along the walls: along rows if row is not 0, or else along columns."""
    order = (
        np.lexsort((cells[:, 1], cells[:, 0])) if row else np.lexsort((cells[:, 0], cells[:, 1]))
    )
    return cells[order]
