"""Rays and segments through cells: map update, simulated laser and line of sight.

Rays that may be stopped step from cell border to cell border. Segments that are drawn as a whole
step by columns (or rows): these steps do not depend on each other. Source: Amanatides and Woo, "A
fast voxel traversal algorithm for ray tracing", 1987. All numbers are in units of cells: x runs
along columns, y along rows, and cell (row, col) covers [col, col + 1) x [row, row + 1).
"""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array, Mask
from thinmap_ros.jit import inlined, kernel

Ray = tuple[float, int, int, float, float, int, int, float, float]
_FRACTION_BITS = 32
_ONE = float(1 << _FRACTION_BITS)


@inlined
def axis_setup(start: float, direction: float) -> tuple[int, int, float, float]:
    """One axis of the traversal.

    First cell, step, distance to the first border, distance between borders.
    """
    cell = int(math.floor(start))
    if direction > 0.0:
        return cell, 1, (cell + 1 - start) / direction, 1.0 / direction
    if direction < 0.0:
        return cell, -1, (cell - start) / direction, -1.0 / direction
    return cell, 0, np.inf, np.inf


@inlined
def begin_ray(x: float, y: float, cos: float, sin: float) -> Ray:
    """A ray from a point in a direction: length so far, row and column, and what `next_cell` needs.

    The rest is, for each axis, the length at the next border, the step and the length of a cell.
    """
    col, step_x, next_x, delta_x = axis_setup(x, cos)
    row, step_y, next_y, delta_y = axis_setup(y, sin)
    return 0.0, row, col, next_x, next_y, step_x, step_y, delta_x, delta_y


@inlined
def next_cell(ray: Ray) -> Ray:
    """The ray where it enters the next cell."""
    _, row, col, next_x, next_y, step_x, step_y, delta_x, delta_y = ray
    if next_x < next_y:
        border = next_x + delta_x
        return next_x, row, col + step_x, border, next_y, step_x, step_y, delta_x, delta_y
    border = next_y + delta_y
    return next_y, row + step_y, col, next_x, border, step_x, step_y, delta_x, delta_y


@kernel
def cast_rays(
    occupied: NDArray[np.uint8], x_cell: float, y_cell: float, angles: Array, max_cells: float
) -> Array:
    """Distance, in cells, at which each ray enters the first occupied cell.

    occupied (H, W) uint8; x_cell, y_cell: where the rays start; angles (N,): their directions, rad.
    Returns (N,): inf where nothing is met within max_cells or before the ray leaves the array, 0
    where the start is occupied.
    """
    rows, cols = occupied.shape
    distances = np.full(angles.size, np.inf)
    for i in range(angles.size):
        ray = begin_ray(x_cell, y_cell, math.cos(angles[i]), math.sin(angles[i]))
        travelled, row, col = ray[:3]
        while travelled <= max_cells and 0 <= row < rows and 0 <= col < cols:
            if occupied[row, col]:
                distances[i] = travelled
                break
            ray = next_cell(ray)
            travelled, row, col = ray[:3]
    return distances


@kernel
def line_is_clear(free: Mask, row_a: int, col_a: int, row_b: int, col_b: int) -> bool:
    """Whether every cell on the straight line between the centres of two cells is free.

    free (H, W) bool. A line through the corner of four cells visits one of the two beside it; cells
    outside the array are not free.
    """
    rows, cols = free.shape
    length = math.hypot(row_b - row_a, col_b - col_a)
    steps = abs(row_b - row_a) + abs(col_b - col_a)
    scale = 1.0 if length == 0.0 else length
    cos = (col_b - col_a) / scale
    ray = begin_ray(col_a + 0.5, row_a + 0.5, cos, (row_b - row_a) / scale)
    for _ in range(steps + 1):
        _, row, col = ray[:3]
        if row < 0 or row >= rows or col < 0 or col >= cols or not free[row, col]:
            return False
        ray = next_cell(ray)
    return True


@inlined
def fill_segment(
    cells: NDArray[np.int16],
    width: int,
    start: tuple[float, float],
    end: tuple[float, float],
    value: int,
) -> None:
    """Give a value to each cell that a segment passes, the first and the last included.

    cells (H * W,) with W = width; start, end: (x, y) inside. In each column that the segment passes
    (row, where it is steep), it lies in the cell where it enters and in that where it leaves, which
    may be the same one; the rows of these are counted in fixed point, 2**-32 of a cell. No cell is
    left out but where the segment cuts less than a millionth of a cell off its corner.
    """
    d_x = end[0] - start[0]
    d_y = end[1] - start[1]
    steep = abs(d_y) > abs(d_x)
    along, across = (start[1], start[0]) if steep else (start[0], start[1])
    along_end, across_end = (end[1], end[0]) if steep else (end[0], end[1])
    stride, side = (width, 1) if steep else (1, width)
    first = int(math.floor(along))
    last = int(math.floor(along_end))
    slope = (across_end - across) / max(abs(along_end - along), 1e-9)
    to_border = first + 1 - along if last > first else along - first
    crossing = int(math.floor((across + slope * to_border) * _ONE))
    rise = int(math.floor(slope * _ONE))
    at = first * stride
    entered = int(math.floor(across)) * side
    stride = stride if last > first else -stride
    for _ in range(abs(last - first)):
        left = (crossing >> _FRACTION_BITS) * side
        # An unsigned index needs no test for counting from the end.
        cells[np.uint64(at + entered)] = value
        cells[np.uint64(at + left)] = value
        at = at + stride
        entered = left
        crossing = crossing + rise
    cells[np.uint64(at + entered)] = value
    cells[np.uint64(at + int(math.floor(across_end)) * side)] = value
