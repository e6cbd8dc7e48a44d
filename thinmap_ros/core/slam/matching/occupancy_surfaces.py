"""Points on the walls of an occupancy map, for scans to be matched with."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.occupancy import OccupancyConfig
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array

# (row, col) from an occupied cell to the free one beside it.
_SIDES = ((0, 1), (0, -1), (1, 0), (-1, 0))


class WallFaces(NamedTuple):
    """Points (N, 2) on walls, m, in order along each, and the normal (2,) of all of them."""

    points: Array
    normal: Array


def occupied_surface_points(patch: GridPatch) -> list[WallFaces]:
    """Points on the faces of a map's occupied cells towards free ones, for each of four sides.

    A beam fills the cell that lies surface_thickness_m behind what it met. So the surface is on
    average half a cell, less that depth, behind the face of the cell.
    """
    depth_m = max(0.5 * patch.frame.resolution - OccupancyConfig().surface_thickness_m, 0.0)
    return [_faces(patch, row, col, depth_m) for row, col in _SIDES]


def _faces(patch: GridPatch, row: int, col: int, depth_m: float) -> WallFaces:
    """The faces of the occupied cells towards the neighbour at (row, col)."""
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
    """Cells (N, 2) in the order of the walls that their faces make.

    Along rows, or along columns.
    """
    order = (
        np.lexsort((cells[:, 1], cells[:, 0])) if row else np.lexsort((cells[:, 0], cells[:, 1]))
    )
    return cells[order]
