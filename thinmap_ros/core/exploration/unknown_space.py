"""Unknown space behind a frontier: its area in line of sight, and its depth straight behind.

Both are evidence of what the frontier hides: behind one that runs along a wall, inside of which no
cell is known, the unknown is two or three cells deep.
"""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.exploration.frontiers import FrontierMap, Place
from thinmap_ros.core.grid.raytrace import axis_setup
from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import inlined, kernel

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
HIDDEN_REACH_M = 4.0  # to which unknown area counts as in line of sight
DEPTH_REACH_M = 1.0  # deeper frontiers hide something alike often
_RAYS = 120
_DEPTH_RAYS = 64  # of a cluster at most
_DEPTH_QUANTILE = 0.8
_AROUND = 2  # cells on each side of a frontier cell that show where the unknown lies
_SKIPPED = 2  # free cells with which a ray at an angle may begin


def hidden_area_m2(frontiers: FrontierMap, place: Place, reach_m: float = HIDDEN_REACH_M) -> float:
    """Unknown area in line of sight of a place, m: through the unknown, up to an obstacle."""
    row, col = frontiers.frame.cells_of(np.array([place]))[0]
    resolution = frontiers.frame.resolution
    reach = reach_m / resolution
    return float(_hidden_cells(frontiers.free, frontiers.passable, row, col, reach)) * resolution**2


def depth_behind_m(frontiers: FrontierMap, cells: Cells) -> float:
    """Depth of the unknown straight behind a cluster (N, 2), up to the next known cell.

    80 % of its cells have at most this depth: where a doorway belongs to a cluster that runs along
    a wall, the doorway counts. At most DEPTH_REACH_M.
    """
    resolution = frontiers.frame.resolution
    reach = round(DEPTH_REACH_M / resolution)
    depths = _depths(frontiers.free, frontiers.passable, cells, reach)
    return float(np.quantile(depths, _DEPTH_QUANTILE)) * resolution


@kernel
def _hidden_cells(free: Mask, passable: Mask, row: int, col: int, reach: float) -> int:
    """Cells neither free nor occupied on rays from a cell, each counted once."""
    rows, cols = free.shape
    whole = int(reach) + 2
    seen = np.zeros((2 * whole + 1, 2 * whole + 1), dtype=np.bool_)
    count = 0
    for k in range(_RAYS):
        angle = 2.0 * math.pi * k / _RAYS
        c, step_x, next_x, delta_x = axis_setup(col + 0.5, math.cos(angle))
        r, step_y, next_y, delta_y = axis_setup(row + 0.5, math.sin(angle))
        travelled = 0.0
        while travelled <= reach:
            inside = 0 <= r < rows and 0 <= c < cols
            if inside and not passable[r, c] and not free[r, c]:
                break
            if not (inside and free[r, c]) and not seen[r - row + whole, c - col + whole]:
                seen[r - row + whole, c - col + whole] = True
                count += 1
            if next_x < next_y:
                travelled = next_x
                next_x += delta_x
                c += step_x
            else:
                travelled = next_y
                next_y += delta_y
                r += step_y
    return count


@kernel
def _depths(free: Mask, passable: Mask, cells: Cells, reach: int) -> Array:
    """Unknown cells in a row, at most `reach`, behind some of a cluster's cells (N, 2)."""
    count = min(cells.shape[0], _DEPTH_RAYS)
    depths = np.empty(count)
    for i in range(count):
        k = (2 * i + 1) * cells.shape[0] // (2 * count)
        depths[i] = _depth(free, passable, cells[k, 0], cells[k, 1], reach)
    return depths


@inlined
def _depth(free: Mask, passable: Mask, row: int, col: int, reach: int) -> float:
    """Unknown cells behind a cell, straight on, up to a known cell; outside all is unknown."""
    rows, cols = free.shape
    down = 0.0
    right = 0.0
    for r in range(row - _AROUND, row + _AROUND + 1):
        for c in range(col - _AROUND, col + _AROUND + 1):
            inside = 0 <= r < rows and 0 <= c < cols
            if not inside or (not free[r, c] and passable[r, c]):
                down += r - row
                right += c - col
    length = math.hypot(down, right)
    if length < 0.5:  # unknown on both sides: a cell or two
        return 1.0
    depth = 0.0
    for step in range(1, reach + _SKIPPED + 1):
        r = int(round(row + step * down / length))
        c = int(round(col + step * right / length))
        inside = 0 <= r < rows and 0 <= c < cols
        if inside and free[r, c] and depth == 0.0 and step <= _SKIPPED:
            continue
        if depth >= reach or (inside and (free[r, c] or not passable[r, c])):
            break
        depth += 1.0
    return depth
