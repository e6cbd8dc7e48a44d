"""Lengths of shortest paths on the grid from one cell to many.

Dijkstra with chamfer steps of 5 and 7 (a fifth of a cell) and a circular bucket queue; lengths are
at most 8 % above the straight line. Source: Dial, "Algorithm 360: shortest-path forest with
topological ordering", 1969; Borgefors, "Distance transformations in digital images", 1986.
"""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import kernel

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
# Enough buckets for steps of up to four times the diagonal one.
_STRAIGHT = 5
_DIAGONAL = 7
_BUCKETS = 32
_FAR = 2**31 - 1


def path_lengths_from(allowed: Mask, start: tuple[int, int], goals: Cells) -> Array:
    """Path length (N,), cells, over allowed cells (H, W) from (row, col) to each goal (N, 2).

    inf if there is no path, if the goal is not allowed, or if the start is outside the grid. The
    start itself need not be allowed.
    """
    weights = np.ascontiguousarray(allowed, dtype=np.uint8)
    steps = _path_lengths_from(
        weights, start[0], start[1], np.ascontiguousarray(goals, dtype=np.int64)
    )
    return _cells(steps)


def distance_field_from(allowed: Mask, start: tuple[int, int]) -> Array:
    """Path length, cells, over allowed cells from a start (row, col) to each cell (H, W).

    inf if there is no path, or if the start is outside the grid.
    """
    nothing = np.zeros((allowed.shape[0] + 2, allowed.shape[1] + 2), dtype=np.bool_)
    return _cells(_field(allowed.astype(np.uint8), start[0], start[1], nothing, -1)[1:-1, 1:-1])


def downsample_mask(allowed: Mask, factor: int) -> Mask:
    """Squares of factor x factor cells of a mask (H, W) with at least one true cell.

    Their shape is (ceil(H / factor), ceil(W / factor)).
    """
    return np.asarray(_downsample(allowed, factor, 0, 0))


def _cells(steps: NDArray[np.int32]) -> Array:
    """Steps as lengths in cells."""
    return np.where(steps == _FAR, np.inf, steps / _STRAIGHT)


@kernel
def _downsample(allowed: Mask, factor: int, shift_row: int, shift_col: int) -> Mask:
    """Squares with a true cell; the first cell is (shift_row, shift_col) in its square."""
    rows, cols = allowed.shape
    height = -(-(rows + shift_row) // factor)
    width = -(-(cols + shift_col) // factor)
    squares = np.zeros((height, width), dtype=np.bool_)
    line = np.zeros(width * factor, dtype=np.uint8)
    for square in range(height):
        line[:] = 0
        top = max(square * factor - shift_row, 0)
        bottom = min((square + 1) * factor - shift_row, rows)
        for row in range(top, bottom):
            # All rows of a square into one line (vectorized), then its columns.
            cells = allowed[row].view(np.uint8)
            part = line[shift_col : shift_col + cols]
            for col in range(cols):
                part[col] |= cells[col]
        for col in range(width):
            for k in range(factor):
                squares[square, col] |= line[col * factor + k] != 0
    return squares


@kernel
def _path_lengths_from(
    weights: NDArray[np.uint8], start_row: int, start_col: int, goals: Cells
) -> NDArray[np.int32]:
    rows, cols = weights.shape
    wanted = np.zeros((rows + 2, cols + 2), dtype=np.bool_)
    found = np.full(goals.shape[0], _FAR, dtype=np.int32)
    left = 0
    for i in range(goals.shape[0]):
        row = goals[i, 0]
        col = goals[i, 1]
        if (
            0 <= row < rows
            and 0 <= col < cols
            and weights[row, col]
            and not wanted[row + 1, col + 1]
        ):
            wanted[row + 1, col + 1] = True
            left += 1
    steps = _field(weights, start_row, start_col, wanted, left)
    for i in range(goals.shape[0]):
        row = goals[i, 0]
        col = goals[i, 1]
        if (
            0 <= row < rows
            and 0 <= col < cols
            and weights[row, col]
            and not wanted[row + 1, col + 1]
        ):
            found[i] = steps[row + 1, col + 1]
    return found


@kernel
def _field(
    weights: NDArray[np.uint8], start_row: int, start_col: int, wanted: Mask, left: int
) -> NDArray[np.int32]:
    """Steps to each cell, padded by one cell, until all `left` wanted cells are reached.

    wanted (H + 2, W + 2): cells to reach; reached ones are cleared.
    """
    rows, cols = wanted.shape
    field = np.full((rows, cols), _FAR, dtype=np.int32)
    # The estimated pose may lie outside the map: never index outside the arrays.
    if not (0 <= start_row < rows - 2 and 0 <= start_col < cols - 2):
        return field
    # A blocked margin of one cell makes bounds checks unnecessary.
    framed = np.zeros((rows, cols), dtype=np.uint8)
    framed[1:-1, 1:-1] = weights
    weight = framed.ravel()
    asked = wanted.ravel()
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
    while waiting > 0 and left != 0:
        bucket = now % _BUCKETS
        while counts[bucket] > 0:
            counts[bucket] -= 1
            waiting -= 1
            cell = queue[bucket, counts[bucket]]
            if steps[cell] != now:
                continue
            if asked[cell]:
                asked[cell] = False
                left -= 1
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
