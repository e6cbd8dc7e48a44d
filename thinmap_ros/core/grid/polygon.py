"""Polygons on the cells of a map."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import Array

Mask = NDArray[np.bool_]
_WALL = np.int8(100)
_STEPS_PER_CELL = 8  # along a line


def inside(points: Array, polygon: Array) -> NDArray[np.bool_]:
    """Which points (N, 2) lie in a polygon (M, 2), by the even-odd rule, (N,)."""
    result = np.zeros(len(points), dtype=np.bool_)
    x = points[:, 0]
    y = points[:, 1]
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        crosses = (ay > y) != (by > y)
        if ay != by:
            result ^= crosses & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return result


def masked_outside(patch: GridPatch, polygon: Array) -> GridPatch:
    """Map with all cells outside a polygon (M, 2) as walls; polygon in the map frame, m."""
    centres = patch.frame.centres_of(np.argwhere(np.ones(patch.shape, dtype=np.bool_)))
    within = inside(centres, polygon).reshape(patch.shape)
    return with_walls(patch, ~within)


def with_walls(patch: GridPatch, cells: Mask) -> GridPatch:
    """Map with some cells (H, W) as walls."""
    return replace(patch, cells=np.where(cells, _WALL, patch.cells))


def touched_cells(
    corners: Array, frame: GridFrame, shape: tuple[int, int], is_closed: bool = True
) -> Mask:
    """Cells (H, W) of a lattice that a polygon (M, 2), m, touches; those of its line if it is open.

    A polygon that crosses itself is filled by the even-odd rule.
    """
    at = frame.in_cells(corners)
    ends = np.roll(at, -1, axis=0) if is_closed else at[1:]
    begins = at if is_closed else at[:-1]
    cells = _filled(begins, ends, shape) if is_closed else np.zeros(shape, dtype=np.bool_)
    for begin, end in zip(begins, ends, strict=True):
        _draw_line(cells, begin, end)
    return cells


def _filled(begins: Array, ends: Array, shape: tuple[int, int]) -> Mask:
    """Cells (H, W) whose centre is in a polygon with edges from begins (M, 2) to ends (M, 2).

    Each edge toggles the cells to the right of it in the rows that it crosses.
    """
    rows, cols = shape
    toggled = np.zeros((rows, cols + 1), dtype=np.bool_)
    for (ax, ay), (bx, by) in zip(begins, ends, strict=True):
        low, high = sorted((ay, by))
        first = max(math.ceil(low - 0.5), 0)
        crossed = np.arange(first, max(min(math.ceil(high - 0.5), rows), first))
        if crossed.size:
            x = ax + (crossed + 0.5 - ay) * (bx - ax) / (by - ay)
            toggled[crossed, np.clip(np.ceil(x - 0.5), 0, cols).astype(np.int64)] ^= True
    return np.asarray(np.logical_xor.accumulate(toggled, axis=1)[:, :cols])


def _draw_line(cells: Mask, begin: Array, end: Array) -> None:
    """Set the cells (H, W) on the line between two points (2,), x and y in cells.

    They join over their edges: no way leads between two of them.
    """
    count = math.ceil(_STEPS_PER_CELL * float(np.abs(end - begin).max())) + 1
    cols, rows = np.floor(np.linspace(begin, end, count)).astype(np.int64).T
    # Where a step leads over a corner, the cell beside it, too.
    cols = np.append(cols, cols[1:])
    rows = np.append(rows, rows[:-1])
    inside = (rows >= 0) & (rows < cells.shape[0]) & (cols >= 0) & (cols < cells.shape[1])
    cells[rows[inside], cols[inside]] = True
