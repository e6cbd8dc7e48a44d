"""Lengths of shortest paths over cells, and whether a path touches a wall.

Dijkstra with chamfer steps of 5 and 7 (a fifth of a cell) and a circular bucket queue; lengths are
at most 8 % above the straight line. Source: Dial, "Algorithm 360: shortest-path forest with
topological ordering", 1969; Borgefors, "Distance transformations in digital images", 1986.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import OCCUPIED_AT_LEAST, GridPatch
from thinmap_ros.core.se2 import Array, Cell, Cells, Mask
from thinmap_ros.jit import kernel

_STRAIGHT = 5
_DIAGONAL = 7
_BUCKETS = 32  # enough for steps of up to MAX_WEIGHT times the diagonal one
MAX_WEIGHT = 4
_FAR = 2**31 - 1


def path_lengths_from(allowed: Mask, start: Cell, goals: Cells) -> Array:
    """Path length (N,), cells, over allowed cells (H, W) from (row, col) to each goal (N, 2).

    inf if there is no path, if the goal is not allowed, or if the start is outside the grid. The
    start itself need not be allowed.
    """
    return values_at(distance_field_from(allowed, start), goals)


def values_at(field: NDArray[np.floating[Any]], cells: Cells) -> Array:
    """Values (N,) of a field (H, W) at cells (N, 2); inf outside."""
    inside = np.all((cells >= 0) & (cells < field.shape), axis=1)
    found = np.full(len(cells), np.inf)
    found[inside] = field[tuple(cells[inside].T)]
    return found


def distance_field_from(weights: Mask | NDArray[np.uint8], start: Cell) -> Array:
    """Path length, cells, from a start (row, col) to each cell (H, W).

    weights (H, W): by which the length of a step to a cell is multiplied, at most MAX_WEIGHT, or
    whether a cell is allowed; 0 where there is no path. inf if there is no path, or if the start is
    outside the grid.
    """
    steps = _field(weights.astype(np.uint8), start[0], start[1])[1:-1, 1:-1]
    return np.where(steps == _FAR, np.inf, steps / _STRAIGHT)


@kernel
def _field(weights: NDArray[np.uint8], start_row: int, start_col: int) -> NDArray[np.int32]:
    """Steps to each cell, padded by one cell."""
    rows = weights.shape[0] + 2
    cols = weights.shape[1] + 2
    field = np.full((rows, cols), _FAR, dtype=np.int32)
    # The estimated pose may lie outside the map: never index outside the arrays.
    if not (0 <= start_row < rows - 2 and 0 <= start_col < cols - 2):
        return field
    # A blocked margin of one cell makes bounds checks unnecessary.
    framed = np.zeros((rows, cols), dtype=np.uint8)
    framed[1:-1, 1:-1] = weights
    weight = framed.ravel()
    steps = field.ravel()
    capacity = 2 * weight.size + 1
    queue = np.empty((_BUCKETS, capacity), dtype=np.int32)
    counts = np.zeros(_BUCKETS, dtype=np.int64)
    start = (start_row + 1) * cols + start_col + 1
    steps[start] = 0
    queue[0, 0] = start
    counts[0] = 1
    now = 0
    waiting = 1
    while waiting > 0:
        bucket = now % _BUCKETS
        while counts[bucket] > 0:
            counts[bucket] -= 1
            waiting -= 1
            cell = queue[bucket, counts[bucket]]
            if steps[cell] != now:
                continue
            for down in (-cols, 0, cols):
                for right in (-1, 0, 1):
                    to = cell + down + right
                    if weight[to] == 0:
                        continue
                    length = _STRAIGHT
                    if down and right:
                        # No corner is cut where a path over edges leads around it.
                        if (weight[cell + down] == 0) != (weight[cell + right] == 0):
                            continue
                        length = _DIAGONAL
                    reached = now + weight[to] * length
                    if reached < steps[to]:
                        bucket_to = reached % _BUCKETS
                        if counts[bucket_to] < capacity:
                            steps[to] = reached
                            queue[bucket_to, counts[bucket_to]] = to
                            counts[bucket_to] += 1
                            waiting += 1
        now += 1
    return field


def path_collides(patch: GridPatch, path: Array, radius_m: float) -> bool:
    """Whether an occupied cell is closer to a path (K, 2), m, map frame, than a radius."""
    frame = patch.frame
    at = (frame.origin_x, frame.origin_y, frame.resolution)
    points = np.ascontiguousarray(path)  # backwards, a path has another layout in memory
    return bool(_collides(patch.cells, at, points, radius_m / frame.resolution - 1e-6))


def disc(
    of: NDArray[Any], centre: tuple[int, int], reach: float
) -> tuple[tuple[slice, slice], Mask]:
    """The part of an array (H, W) around a cell, and the mask of its cells within reach."""
    whole = math.ceil(reach)
    rows = slice(max(centre[0] - whole, 0), min(centre[0] + whole + 1, of.shape[0]))
    cols = slice(max(centre[1] - whole, 0), min(centre[1] + whole + 1, of.shape[1]))
    row, col = np.ogrid[rows, cols]
    return (rows, cols), np.asarray(np.hypot(row - centre[0], col - centre[1]) <= reach)


@kernel
def _collides(
    cells: NDArray[np.int8], frame: tuple[float, float, float], path: Array, radius: float
) -> bool:
    """Whether an occupied cell of a map (H, W) is within a radius, cells, of a path (K, 2), m.

    frame: origin x, origin y and resolution of the map, m.
    """
    reach = int(math.ceil(radius))
    last_row = -1
    last_col = -1
    for k in range(path.shape[0]):
        row = int(math.floor((path[k, 1] - frame[1]) / frame[2]))
        col = int(math.floor((path[k, 0] - frame[0]) / frame[2]))
        if row == last_row and col == last_col:
            continue
        last_row = row
        last_col = col
        for r in range(max(row - reach, 0), min(row + reach + 1, cells.shape[0])):
            for c in range(max(col - reach, 0), min(col + reach + 1, cells.shape[1])):
                if (
                    cells[r, c] >= OCCUPIED_AT_LEAST
                    and (r - row) ** 2 + (c - col) ** 2 < radius * radius
                ):
                    return True
    return False
