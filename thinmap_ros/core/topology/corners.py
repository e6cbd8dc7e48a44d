"""Corner nodes: where chains of cells break so that straight lines stay where the robot fits."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import inlined, kernel

Cells = NDArray[np.int64]


def corner_indices(cells: Cells, room: Array) -> Cells:
    """Indices into a chain's cells (K, 2) at which corner nodes stand, in order, without its ends.

    room (K,): how far, in cells, the robot's centre may leave each cell in any direction (clearance
    less radius). Where the straight line between two neighbouring nodes is blocked, the cell
    farthest from it becomes a node, again and again until every line is clear. A line counts as
    clear when each cell it touches lies within `room` of a cell of the very piece it stands for: by
    the triangle inequality the robot then fits everywhere on it, and no grid has to be kept to know
    this. A closed chain is always broken.
    Source: exploration paper section 2.2, Fig. 3(c) and (d).
    """
    broken = _split(np.ascontiguousarray(cells), np.maximum(room, 0.0))
    found: Cells = np.flatnonzero(broken)
    return found


def corners_between(cells: Cells, room: Array, stops: Cells) -> Cells:
    """Indices `stops` of a chain's cells (K, 2), and the corners of the pieces between them.

    room (K,): see `corner_indices`.
    """
    found = [stops]
    for first, last in pairwise(stops.tolist()):
        piece = slice(first, last + 1)
        found.append(first + corner_indices(cells[piece], room[piece]))
    return np.unique(np.concatenate(found))


def with_middles(
    cells: Cells, stops: Cells, clearances: Array, longest: float, even: float
) -> Cells:
    """Indices `stops` of a chain's cells (K, 2), and between them those that split long pieces.

    A piece is split into equal parts of at most `longest` cells, unless it is a corridor: as
    straight, and its clearances (K,) as equal, as `even` cells. Elsewhere there are places beside a
    long piece from which the nodes at both of its ends are out of sight.
    """
    steps = np.hypot(*np.diff(cells, axis=0).T)
    path = np.concatenate(([0.0], np.cumsum(steps)))
    middles = [stops]
    for first, last in pairwise(stops.tolist()):
        count = int((path[last] - path[first]) / longest)
        piece = slice(first, last + 1)
        if count == 0 or max(_bend(cells[piece]), float(np.ptp(clearances[piece]))) <= even:
            continue
        shares = np.arange(1, count + 1) / (count + 1)
        middles.append(np.searchsorted(path, path[first] + shares * (path[last] - path[first])))
    return np.unique(np.concatenate(middles))


def _bend(cells: Cells) -> float:
    """Largest distance of cells (K, 2) from the line through the first and the last one."""
    line = (cells[-1] - cells[0]).astype(np.float64)
    off = cells - cells[0]
    length = max(float(np.hypot(*line)), 1.0)
    return float(np.abs(off[:, 0] * line[1] - off[:, 1] * line[0]).max() / length)


@inlined
def _held(cells: Cells, room: Array, first: int, last: int, hint: int, row: int, col: int) -> int:
    """A member of the piece within whose room a cell lies, or -1.

    `hint` and those after it are tried first.
    """
    for k in range(hint, last + 1):
        if (cells[k, 0] - row) ** 2 + (cells[k, 1] - col) ** 2 <= room[k] ** 2:
            return k
    for k in range(first, hint):
        if (cells[k, 0] - row) ** 2 + (cells[k, 1] - col) ** 2 <= room[k] ** 2:
            return k
    return -1


@inlined
def _is_clear(cells: Cells, room: Array, first: int, last: int) -> bool:
    """Whether every cell that the line between two members touches is held.

    At a cell's corner, both beside it.
    """
    row = cells[first, 0]
    col = cells[first, 1]
    rows = abs(cells[last, 0] - row)
    cols = abs(cells[last, 1] - col)
    up = 1 if cells[last, 0] > row else -1
    right = 1 if cells[last, 1] > col else -1
    i = j = 0
    hint = first
    while i < rows or j < cols:
        side = (1 + 2 * j) * rows - (1 + 2 * i) * cols
        if side == 0:
            if _held(cells, room, first, last, hint, row + up * (i + 1), col + right * j) < 0:
                return False
            if _held(cells, room, first, last, hint, row + up * i, col + right * (j + 1)) < 0:
                return False
        i += side >= 0
        j += side <= 0
        hint = _held(cells, room, first, last, hint, row + up * i, col + right * j)
        if hint < 0:
            return False
    return True


@inlined
def _farthest(cells: Cells, first: int, last: int) -> int:
    """The member strictly between two others that is farthest from the line between them."""
    d_row = cells[last, 0] - cells[first, 0]
    d_col = cells[last, 1] - cells[first, 1]
    squared = d_row * d_row + d_col * d_col
    best = (first + last) // 2
    best_distance = 1e-9
    for k in range(first + 1, last):
        row = cells[k, 0] - cells[first, 0]
        col = cells[k, 1] - cells[first, 1]
        share = 0.0 if squared == 0 else min(max((row * d_row + col * d_col) / squared, 0.0), 1.0)
        distance = (row - share * d_row) ** 2 + (col - share * d_col) ** 2
        if distance > best_distance + 1e-9:
            best = k
            best_distance = distance
    return best


@kernel
def _split(cells: Cells, room: Array) -> NDArray[np.bool_]:
    broken = np.zeros(cells.shape[0], dtype=np.bool_)
    stack = np.empty((cells.shape[0] + 1, 2), dtype=np.int64)
    stack[0, 0] = 0
    stack[0, 1] = cells.shape[0] - 1
    count = 1
    while count > 0:
        count -= 1
        first = stack[count, 0]
        last = stack[count, 1]
        if last - first < 2:
            continue
        closed = cells[first, 0] == cells[last, 0] and cells[first, 1] == cells[last, 1]
        if not closed and _is_clear(cells, room, first, last):
            continue
        middle = _farthest(cells, first, last)
        broken[middle] = True
        stack[count, 0] = first
        stack[count, 1] = middle
        stack[count + 1, 0] = middle
        stack[count + 1, 1] = last
        count += 2
    return broken
