"""Erasing a part of a grid, so that scans from before do not draw it again."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.grid.patch import Bounds, GridFrame
from thinmap_ros.core.grid.polygon import Mask, touched_cells
from thinmap_ros.core.grid.tiles import TILE
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

_MARGIN_CELLS = 2  # by which the cells of a scan may lie beyond the ends of its beams


def erase(grid: OccupancyGrid, corners: Array) -> None:
    """Set the cells of a grid that a polygon (M, 2), m, touches to unknown."""
    tiles = grid.tiles()
    if not len(tiles):
        return
    low = tiles.min(axis=0) * TILE
    high = (tiles.max(axis=0) + 1) * TILE
    cells = grid.frame.cells_of(corners)
    row, col = np.maximum(cells.min(axis=0), low).tolist()
    end_row, end_col = np.minimum(cells.max(axis=0) + 1, high).tolist()
    if row >= end_row or col >= end_col:
        return
    bounds = (row, col, end_row, end_col)
    odds = grid.odds(bounds)
    odds[_erased(grid.frame, bounds, [corners])] = 0
    grid.set_odds(bounds, odds)


def add_scan_outside(
    grid: OccupancyGrid, scan: Scan, T_map_base: Array, polygons: Sequence[Array]
) -> None:
    """Add a scan made at a pose (3,), but for what it shows of some polygons (M, 2), m.

    Raises InputError as `OccupancyGrid.add_scan`.
    """
    bounds = _reach(grid, scan, T_map_base)
    near = [corners for corners in polygons if _touches(grid.frame.cells_of(corners), bounds)]
    if not near:
        grid.add_scan(scan, T_map_base)
        return
    cells = _erased(grid.frame, bounds, near)
    before = grid.odds(bounds)
    grid.add_scan(scan, T_map_base)
    grid.set_odds(bounds, np.where(cells, before, grid.odds(bounds)))


def _erased(frame: GridFrame, bounds: Bounds, polygons: Sequence[Array]) -> Mask:
    """Cells within bounds that one of some polygons (M, 2), m, touches."""
    row, col, end_row, end_col = bounds
    shape = (end_row - row, end_col - col)
    at = frame.with_origin_at(row, col)
    cells = np.zeros(shape, dtype=np.bool_)
    for corners in polygons:
        cells |= touched_cells(corners, at, shape)
    return cells


def _touches(cells: NDArray[np.int64], bounds: Bounds) -> bool:
    """Whether the rectangle of some cells (M, 2) and another have a cell in common."""
    low = cells.min(axis=0)
    high = cells.max(axis=0)
    return bool(
        low[0] < bounds[2] and bounds[0] <= high[0] and low[1] < bounds[3] and bounds[1] <= high[1]
    )


def _reach(grid: OccupancyGrid, scan: Scan, T_map_base: Array) -> Bounds:
    """Rectangle of all cells of a grid that a scan made at a pose (3,) can change."""
    T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
    row, col = grid.frame.cells_of(T_map_laser[None, :2])[0].tolist()
    reach_m = min(scan.max_range_m, scan.range_max_m + grid.config.surface_thickness_m)
    cells = math.ceil(reach_m / grid.frame.resolution) + _MARGIN_CELLS
    return row - cells, col - cells, row + cells + 1, col + cells + 1
