"""Maps at a pose: with rows that are not parallel to the x axis, or laid over another map."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import OCCUPIED_AT_LEAST, UNKNOWN, GridPatch
from thinmap_ros.core.grid.tiles import MAX_CELLS
from thinmap_ros.core.se2 import Array

_ALIGNED_RAD = 1e-6


def aligned_patch(
    T_map_origin: Array, resolution_m: float, cells: NDArray[np.int8], max_cells: int = MAX_CELLS
) -> GridPatch:
    """Patch of cells (H, W) whose first corner and rows have a pose T_map_origin (3,) in the map.

    Rotated cells are resampled: each new cell has the value of the old cell at its centre, and one
    that contains the centre of an occupied cell is occupied, so that walls keep no gaps.
    Raises InputError where the resampled map would have more than max_cells.
    """
    if abs(T_map_origin[2]) < _ALIGNED_RAD:
        x, y, _ = T_map_origin.tolist()
        return GridPatch(GridFrame(x, y, resolution_m), cells)
    frame, (rows, cols) = _bounds(T_map_origin, resolution_m, cells.shape)
    if rows * cols > max_cells:
        raise InputError(
            f'map rotated by {T_map_origin[2]:.3f} rad: {rows} x {cols} cells: '
            f'expected {max_cells} at most'
        )
    return GridPatch(frame, _resampled(T_map_origin, resolution_m, cells, frame, (rows, cols)))


def overlaid(base: GridPatch, other: GridPatch, T_base_other: Array) -> GridPatch:
    """A map with what another one knows besides, whose frame has a pose (3,) in it.

    The cells are those of the base, which may be larger or smaller than those of the other map.
    Raises InputError where the map would have more than MAX_CELLS cells.
    """
    corner = np.array([other.frame.origin_x, other.frame.origin_y, 0.0])
    T_base_origin = se2.compose(T_base_other, corner)
    cell_m = base.frame.resolution
    own, shape = _bounds(T_base_origin, other.frame.resolution, other.shape)
    rows_cols = base.frame.cells_of(np.array([[own.origin_x, own.origin_y]]))[0]
    ends = rows_cols + np.ceil(np.array(shape) * own.resolution / cell_m).astype(int) + 1
    before = np.maximum(-rows_cols, 0)
    after = np.maximum(ends - base.shape, 0)
    rows, cols = (base.shape + before + after).tolist()
    if rows * cols > MAX_CELLS:
        raise InputError(f'joined map: {rows} x {cols} cells: expected {MAX_CELLS} at most')
    padded = base.padded((int(before[0]), int(before[1]), int(after[0]), int(after[1])))
    laid = _resampled(
        T_base_origin, other.frame.resolution, other.cells, padded.frame, padded.shape
    )
    return GridPatch(padded.frame, np.where(padded.cells == UNKNOWN, laid, padded.cells))


def _resampled(
    T_map_origin: Array,
    resolution_m: float,
    cells: NDArray[np.int8],
    frame: GridFrame,
    shape: tuple[int, int],
) -> NDArray[np.int8]:
    """Cells (H, W) at a pose (3,) on the lattice of another frame; see `aligned_patch`."""
    rows, cols = shape
    resampled = np.full((rows, cols), UNKNOWN, dtype=np.int8)
    for row in range(rows):  # one at a time: a large map needs little more memory than its cells
        new_cells = np.column_stack([np.full(cols, row), np.arange(cols)])
        old_cells = _cells_at(frame.centres_of(new_cells), T_map_origin, resolution_m)
        inside = ((old_cells >= 0) & (old_cells < cells.shape)).all(axis=1)
        resampled[row, inside] = cells[tuple(old_cells[inside].T)]
    occupied = np.argwhere(cells >= OCCUPIED_AT_LEAST)
    centres = (occupied[:, ::-1].astype(np.float64) + 0.5) * resolution_m
    centres = se2.transform_points(T_map_origin, centres)
    resampled[tuple(frame.cells_of(centres).T)] = cells[tuple(occupied.T)]
    return resampled


def _bounds(
    T_map_origin: Array, resolution_m: float, shape: tuple[int, ...]
) -> tuple[GridFrame, tuple[int, int]]:
    """Frame and shape of an aligned grid around a rotated one."""
    height_m = shape[0] * resolution_m
    width_m = shape[1] * resolution_m
    corners = np.array([[0.0, 0.0], [width_m, 0.0], [0.0, height_m], [width_m, height_m]])
    corners = se2.transform_points(T_map_origin, corners)
    low = corners.min(axis=0)
    # Rounded, so that a quarter turn keeps the number of cells.
    cols, rows = np.ceil(np.round((corners.max(axis=0) - low) / resolution_m, 6)).astype(int)
    return GridFrame(float(low[0]), float(low[1]), resolution_m), (int(rows), int(cols))


def _cells_at(points: Array, T_map_origin: Array, resolution_m: float) -> NDArray[np.int64]:
    """Rows and columns (N, 2) of the rotated grid in which points (N, 2) of the map lie."""
    inner = se2.transform_points(se2.invert(T_map_origin), points)
    return np.floor(inner[:, ::-1] / resolution_m + 1e-9).astype(np.int64)
