"""Viewpoints: from where a robot sees most of what a frontier hides.

Some points straight behind the frontier's cells stand for the unknown. A viewpoint has the shortest
path of all places from which most of these points could be seen if nothing stands in the unknown. A
robot on the known side of a corner sees along the frontier, but nothing that the corner hides; one
at the end of its laser's range has to come only a little nearer.
"""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import inlined, kernel

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
Cell = tuple[int, int]
# Not more: across a wall one cell thick places where a robot can stand are six cells apart, and
# stay apart in squares.
SQUARE = 3
# Most of what a border hides: so much of so many points. Of a long one, with a point every so many
# cells, as many.
_POINTS = 8
_SHARE = 0.7
_SPACING = 10
_STRIDE = 4
_SLACK_CELLS = 5


def place_for(
    free: Mask, passable: Mask, cells: Cells, allowed: Mask, ways: Array, depth: int, reach: float
) -> Cell | None:
    """Allowed cell with the shortest path that observes most of the space behind a frontier (N, 2).

    free, passable (all cells that are not occupied), allowed (H, W);
    ways (ceil(H / SQUARE), ceil(W / SQUARE)): path length to each square of SQUARE x SQUARE cells;
    the robot would stand in its middle; depth: of the space behind the frontier, in cells;
    reach: range of the laser, in cells.
    """
    most = max(_POINTS, len(cells) // _SPACING)
    points = _hidden_points(free, passable, cells, depth, most)
    need = math.ceil(_SHARE * min(len(points), _POINTS))
    row, col = _view_place(ways, SQUARE, allowed, passable, points, reach, need)
    return None if row < 0 else (int(row), int(col))


def search_beside(
    free: Mask, cells: Cells, allowed: Mask, standing: Mask, max_steps: int, towards: Cell
) -> tuple[Cell | None, bool]:
    """The allowed cell beside a frontier (N, 2) that is nearest to another cell; None: none.

    Of the allowed cells whose path to the frontier over free cells has at most max_steps cells, and
    is nearly the shortest: around a pillar all sides are equally near. Also whether the frontier is
    enclosed: no path leads from it to a cell where the robot could stand. free, standing (H, W).
    """
    row, col, is_enclosed = _search_beside(free, cells, allowed, standing, max_steps, towards)
    return (None if row < 0 else (int(row), int(col))), bool(is_enclosed)


@kernel
def _hidden_points(free: Mask, passable: Mask, cells: Cells, depth: int, most: int) -> Cells:
    """Cells behind some of a border's cells (N, 2).

    They lie straight on into the unknown, up to a depth or something known.
    """
    rows, cols = free.shape
    count = min(cells.shape[0], most)
    points = np.empty((count, 2), dtype=np.int64)
    for i in range(count):
        k = (2 * i + 1) * cells.shape[0] // (2 * count)
        row = cells[k, 0]
        col = cells[k, 1]
        # Which way the unknown lies, from the cells around.
        down = 0.0
        right = 0.0
        for r in range(max(row - 3, 0), min(row + 4, rows)):
            for c in range(max(col - 3, 0), min(col + 4, cols)):
                if not free[r, c] and passable[r, c]:
                    down += r - row
                    right += c - col
        length = max(math.hypot(down, right), 1e-9)
        points[i, 0] = row
        points[i, 1] = col
        for step in range(1, depth + 1):
            r = int(round(row + step * down / length))
            c = int(round(col + step * right / length))
            if r < 0 or r >= rows or c < 0 or c >= cols or not passable[r, c]:
                break
            points[i, 0] = r
            points[i, 1] = c
    return points


@kernel
def _view_place(
    ways: Array, factor: int, allowed: Mask, passable: Mask, points: Cells, reach: float, need: int
) -> tuple[int, int]:
    """Middle of the square with the shortest path that sees at least `need` points, or -1.

    A line of sight runs over passable cells, and is shorter than reach.
    """
    rows, cols = allowed.shape
    low_r = points[:, 0].min() - reach
    high_r = points[:, 0].max() + reach
    low_c = points[:, 1].min() - reach
    high_c = points[:, 1].max() + reach
    top = max(int(low_r) // factor, 0)
    bottom = min(int(high_r) // factor + 1, ways.shape[0])
    left = max(int(low_c) // factor, 0)
    right = min(int(high_c) // factor + 1, ways.shape[1])
    best = np.inf
    best_row = -1
    best_col = -1
    # First a few squares here and there: with a good place in hand most others need no look.
    for stride in (_STRIDE, 1):
        for r in range(top, bottom, stride):
            for c in range(left, right, stride):
                row = r * factor + factor // 2
                col = c * factor + factor // 2
                if ways[r, c] >= best or row >= rows or col >= cols or not allowed[row, col]:
                    continue
                if _sees_enough(passable, row, col, points, reach, need):
                    best = ways[r, c]
                    best_row = row
                    best_col = col
    return best_row, best_col


@inlined
def _sees_enough(
    passable: Mask, row: int, col: int, points: Cells, reach: float, need: int
) -> bool:
    """Whether so many of the points (N, 2) are in sight of a cell."""
    seen = 0
    for i in range(points.shape[0]):
        if seen + points.shape[0] - i < need:
            break
        away = math.hypot(points[i, 0] - row, points[i, 1] - col)
        if away < reach and line_is_clear(passable, points[i, 0], points[i, 1], row, col):
            seen += 1
    return seen >= need


@kernel
def _search_beside(
    free: Mask, cells: Cells, allowed: Mask, standing: Mask, most_steps: int, towards: Cell
) -> tuple[int, int, bool]:
    """Breadth first over free cells, from all frontier cells at once; see search_beside.

    It goes _SLACK_CELLS steps on after the first find.
    """
    rows, cols = free.shape
    seen = np.zeros((rows, cols), dtype=np.bool_)
    queue = np.empty((rows * cols, 3), dtype=np.int64)
    tail = 0
    for row, col in cells:
        queue[tail] = row, col, 0
        seen[row, col] = True
        tail += 1
    head = 0
    best = np.inf
    place = (-1, -1)
    is_enclosed = True
    while head < tail and (is_enclosed or queue[head, 2] <= most_steps):
        row, col, steps = queue[head]
        head += 1
        is_enclosed &= not standing[row, col]
        away = math.hypot(row - towards[0], col - towards[1])
        if allowed[row, col] and steps <= most_steps and away < best:
            if place[0] < 0:
                most_steps = min(most_steps, steps + _SLACK_CELLS)
            best = away
            place = (row, col)
        for r, c in ((row + 1, col), (row - 1, col), (row, col + 1), (row, col - 1)):
            if 0 <= r < rows and 0 <= c < cols and free[r, c] and not seen[r, c]:
                seen[r, c] = True
                queue[tail] = r, c, steps + 1
                tail += 1
    return place[0], place[1], is_enclosed
