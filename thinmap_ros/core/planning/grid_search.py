"""Traversable cells, those that are reachable, and lengths of shortest paths over them.

Dijkstra with chamfer steps of 5 and 7 (a fifth of a cell) and a circular bucket queue; lengths are
at most 8 % above the straight line. Source: Dial, "Algorithm 360: shortest-path forest with
topological ordering", 1969; Borgefors, "Distance transformations in digital images", 1986.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.fields import reachable
from thinmap_ros.core.grid.patch import OCCUPIED_AT_LEAST, GridFrame, GridPatch
from thinmap_ros.core.se2 import Array, Cell, Cells, Mask
from thinmap_ros.core.topology.thinning import column_distance, standing_room
from thinmap_ros.jit import kernel

_STRAIGHT = 5
_DIAGONAL = 7
_BUCKETS = 32  # enough for steps of up to MAX_WEIGHT times the diagonal one
MAX_WEIGHT = 4
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


def distance_field_from(allowed: Mask, start: Cell) -> Array:
    """Path length, cells, over allowed cells from a start (row, col) to each cell (H, W).

    inf if there is no path, or if the start is outside the grid.
    """
    return weighted_distance_field_from(allowed.astype(np.uint8), start)


def weighted_distance_field_from(weights: NDArray[np.uint8], start: Cell) -> Array:
    """As `distance_field_from`; the length of a step is multiplied by the weight of its end.

    weights (H, W): 0 where there is no path, at most MAX_WEIGHT.
    """
    nothing = np.zeros((weights.shape[0] + 2, weights.shape[1] + 2), dtype=np.bool_)
    return _cells(_field(weights, start[0], start[1], nothing, -1)[1:-1, 1:-1])


@kernel
def downsample_mask(allowed: Mask, factor: int) -> Mask:
    """Squares of factor x factor cells of a mask (H, W) with at least one true cell.

    Their shape is (ceil(H / factor), ceil(W / factor)).
    """
    rows, cols = allowed.shape
    height = -(-rows // factor)
    width = -(-cols // factor)
    squares = np.zeros((height, width), dtype=np.bool_)
    line = np.zeros(width * factor, dtype=np.uint8)
    for square in range(height):
        line[:] = 0
        for row in range(square * factor, min((square + 1) * factor, rows)):
            # All rows of a square into one line (vectorized), then its columns.
            cells = allowed[row].view(np.uint8)
            part = line[:cols]
            for col in range(cols):
                part[col] |= cells[col]
        for col in range(width):
            for k in range(factor):
                squares[square, col] |= line[col * factor + k] != 0
    return squares


def _cells(steps: NDArray[np.int32]) -> Array:
    """Steps as lengths in cells."""
    return np.where(steps == _FAR, np.inf, steps / _STRAIGHT)


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


def traversable_cells(free: Mask, radius_m: float, resolution: float) -> Mask:
    """Cells (H, W) in which the centre of a robot of a radius may be.

    All cells that are not free count as obstacles.
    """
    return standing_room(column_distance(free), radius_m / resolution)


def escape_cells(
    standing: Mask,
    free: Mask,
    frame: GridFrame,
    xy: tuple[float, float],
    escape_distance_m: float,
    trail: Cells | None = None,
) -> Mask:
    """Traversable cells (H, W) for a robot at a point (m), including an escape from a collision.

    A robot closer to obstacles than its radius may cross free cells up to escape_distance_m away.
    trail: cells (N, 2) of its recent path; it may return over those that are free.
    """
    allowed = standing.copy()
    if trail is not None:
        allowed[trail[:, 0], trail[:, 1]] |= free[trail[:, 0], trail[:, 1]]
    row, col = (int(v) for v in frame.cells_of(np.array([xy]))[0])
    if not (0 <= row < free.shape[0] and 0 <= col < free.shape[1]) or standing[row, col]:
        return allowed
    part, within = disc(allowed, (row, col), escape_distance_m / frame.resolution)
    allowed[part] |= within & free[part]
    allowed[row, col] = True
    return allowed


def reachable_cells(allowed: Mask, start: tuple[int, int]) -> Mask:
    """Allowed cells (H, W) that are reachable from a start (row, col), with 8-connectivity.

    No cells if the start is outside the mask.
    """
    if not (0 <= start[0] < allowed.shape[0] and 0 <= start[1] < allowed.shape[1]):
        return np.zeros_like(allowed)
    return reachable(allowed, np.array([start]))


def path_collides(patch: GridPatch, path: Array, radius_m: float) -> bool:
    """Whether an occupied cell is closer to a path (K, 2), m, map frame, than a radius."""
    frame = patch.frame
    at = (frame.origin_x, frame.origin_y, frame.resolution)
    return bool(_collides(patch.cells, at, path, radius_m / frame.resolution - 1e-6))


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
