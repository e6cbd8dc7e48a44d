"""Fields over cells: connected components, distances, what is nearest; and points near a point."""

import math
from collections.abc import Iterator
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array, Cell, Cells, Mask
from thinmap_ros.jit import inlined, kernel

FAR_CELLS = 1000  # distance if the set is empty
_STRIP_ROWS = 32
_Value = TypeVar('_Value', bound=np.generic)


def strips(rows: int) -> Iterator[slice]:
    """Slices of some rows each: NumPy copies indices that are not of 64 bits."""
    for first in range(0, rows, _STRIP_ROWS):
        yield slice(first, first + _STRIP_ROWS)


def looked_up(values: NDArray[_Value], numbers: NDArray[Any]) -> NDArray[_Value]:
    """Of each of the numbers (H, W) its value in a table (N,), from the end of it if negative."""
    found = np.empty(numbers.shape, dtype=values.dtype)
    for strip in strips(len(numbers)):
        found[strip] = values[numbers[strip]]
    return found


def counts_of(numbers: NDArray[Any], cells: Mask, count: int) -> Cells:
    """How many cells of a mask (H, W) have each of the numbers (H, W) below a count, (count,)."""
    found = np.zeros(count, dtype=np.int64)
    for strip in strips(len(numbers)):
        found += np.bincount(numbers[strip][cells[strip]], minlength=count)
    return found


def label(cells: Mask) -> tuple[NDArray[np.int32], Cells]:
    """Label the 8-connected components of a mask (H, W).

    Runs of true cells are joined row by row, with a union-find structure.
    Returns the component number of each true cell (0 elsewhere), (H, W), and the number of cells of
    each component. Components are numbered in the order of their first cells, row by row.
    """
    return _label(np.ascontiguousarray(cells))


def reachable(cells: Mask, seeds: Cells) -> Mask:
    """True cells (H, W) in the same 8-connected component as one of the seeds (N, 2)."""
    return _reachable(np.ascontiguousarray(cells), np.ascontiguousarray(seeds))


@kernel
def _runs(cells: Mask) -> tuple[Cells, Cells, Cells, int]:
    """Runs (R, 3) of true cells as (row, first column, end), row by row, and their components.

    Also: index of the first run of each row, (H + 1,); component number of each run, from 1,
    (R,); number of components.
    """
    rows, cols = cells.shape
    runs = np.empty((rows * (cols // 2 + 1), 3), dtype=np.int64)
    first = np.zeros(rows + 1, dtype=np.int64)
    count = 0
    for row in range(rows):
        first[row] = count
        was = False
        line = cells[row]
        for col in range(cols):
            if line[col] == was:
                continue
            if was:
                runs[count - 1, 2] = col
            else:
                runs[count, 0] = row
                runs[count, 1] = col
                runs[count, 2] = cols
                count += 1
            was = not was
    first[rows] = count
    owner = np.arange(count)
    for row in range(1, rows):
        above = first[row - 1]
        for k in range(first[row], first[row + 1]):
            while above < first[row] and runs[above, 2] < runs[k, 1]:
                above += 1
            other = above
            while other < first[row] and runs[other, 1] <= runs[k, 2]:
                a = root_of(owner, k)
                b = root_of(owner, other)
                owner[max(a, b)] = min(a, b)
                other += 1
    parts = np.empty(count, dtype=np.int64)
    number = 0
    for k in range(count):
        root = root_of(owner, k)
        if root == k:
            number += 1
            parts[k] = number
        else:
            parts[k] = parts[root]
    return runs[:count], first, parts, number


@inlined
def root_of(owner: Cells, k: int) -> int:
    """Root of a member in a union-find structure (N,), with path compression."""
    while owner[k] != k:
        owner[k] = owner[owner[k]]
        k = owner[k]
    return k


@kernel
def _label(cells: Mask) -> tuple[NDArray[np.int32], Cells]:
    runs, _, parts, count = _runs(cells)
    numbers = np.zeros(cells.shape, dtype=np.int32)
    sizes = np.zeros(count + 1, dtype=np.int64)
    for k in range(parts.size):
        row = numbers[runs[k, 0]]
        for col in range(runs[k, 1], runs[k, 2]):
            row[col] = parts[k]
        sizes[parts[k]] += runs[k, 2] - runs[k, 1]
    return numbers, sizes


@kernel
def _reachable(cells: Mask, seeds: Cells) -> Mask:
    runs, first, parts, count = _runs(cells)
    reached = np.zeros(count + 1, dtype=np.bool_)
    for i in range(seeds.shape[0]):
        for k in range(first[seeds[i, 0]], first[seeds[i, 0] + 1]):
            if runs[k, 1] <= seeds[i, 1] < runs[k, 2]:
                reached[parts[k]] = True
                break
    found = np.zeros(cells.shape, dtype=np.bool_)
    for k in range(parts.size):
        if reached[parts[k]]:
            row = found[runs[k, 0]]
            for col in range(runs[k, 1], runs[k, 2]):
                row[col] = True
    return found


def nearest_true(cells: Mask, cell: Cell, reach: float) -> Cell | None:
    """The true cell (H, W) nearest to a cell, or None if there is none within `reach` cells."""
    whole = math.floor(reach)
    top = max(cell[0] - whole, 0)
    left = max(cell[1] - whole, 0)
    part = cells[top : max(cell[0] + whole + 1, 0), left : max(cell[1] + whole + 1, 0)]
    near = np.argwhere(part) + (top, left)
    squared = np.square(near - cell).sum(axis=1)
    if near.size == 0 or squared.min() > reach * reach:
        return None
    best = near[squared.argmin()]
    return int(best[0]), int(best[1])


def distance_cells(marked: Mask) -> Array:
    """Exact distance, in cells between centres, from each cell (H, W) to the nearest marked one.

    1000 if no cell is marked.
    """
    return np.asarray(np.sqrt(squared_distance(marked)))


def squared_distance(marked: Mask, is_rim_marked: bool = False) -> NDArray[np.int32]:
    """Squared `distance_cells` (H, W), in half the memory; is_rim_marked: as if cells outside were.

    Source: Felzenszwalb and Huttenlocher, "Distance transforms of sampled functions", 2012: the
    lower envelope of parabolas, along columns and then along rows.
    """
    return _squared_distance(np.ascontiguousarray(marked), is_rim_marked)


@kernel
def _squared_distance(marked: Mask, is_rim_marked: bool) -> NDArray[np.int32]:
    rows, cols = marked.shape
    squared = np.empty((rows, cols), dtype=np.int32)
    outside = 0 if is_rim_marked else FAR_CELLS
    # Along columns, two sweeps count the steps from marked cells.
    steps = np.full(cols, outside, dtype=np.int32)
    for row in range(rows):
        for col in range(cols):
            steps[col] = 0 if marked[row, col] else min(steps[col] + 1, FAR_CELLS)
            squared[row, col] = steps[col]
    steps[:] = outside
    for row in range(rows - 1, -1, -1):
        for col in range(cols):
            steps[col] = min(steps[col] + 1, squared[row, col])
            squared[row, col] = steps[col] * steps[col]
    vertex = np.empty(cols, dtype=np.int64)
    border = np.empty(cols + 1)
    heights = np.empty(cols)
    for row in range(rows):
        heights[:] = squared[row]
        last = 0
        vertex[0] = 0
        border[0] = -np.inf
        border[1] = np.inf
        for col in range(1, cols):
            while True:
                other = vertex[last]
                meet = (heights[col] + col * col - heights[other] - other * other) / (
                    2.0 * (col - other)
                )
                if meet > border[last]:
                    break
                last -= 1
            last += 1
            vertex[last] = col
            border[last] = meet
            border[last + 1] = np.inf
        last = 0
        for col in range(cols):
            while border[last + 1] < col:
                last += 1
            step = col - vertex[last]
            least = min(step * step + heights[vertex[last]], FAR_CELLS * FAR_CELLS)
            if is_rim_marked:
                rim = min(col + 1, cols - col)
                least = min(least, rim * rim)
            squared[row, col] = least
    return squared


class SpatialHash:
    """Numbers by square of the plane: finds the points near a point.

    The time of a query does not depend on the number of points elsewhere.
    """

    def __init__(self, edge_m: float) -> None:
        self._edge_m = edge_m
        self._numbers: dict[tuple[int, int], set[int]] = {}
        self._bucket_of: dict[int, tuple[int, int]] = {}

    def insert(self, number: int, x: float, y: float) -> None:
        """Add a number at a point, or move it there, m.

        A point that is not finite removes the number.
        """
        if not (math.isfinite(x) and math.isfinite(y)):
            self.remove(number)
            return
        bucket = (math.floor(x / self._edge_m), math.floor(y / self._edge_m))
        if self._bucket_of.get(number) != bucket:
            self.remove(number)
            self._bucket_of[number] = bucket
            self._numbers.setdefault(bucket, set()).add(number)

    def remove(self, number: int) -> None:
        """Remove a number, if present."""
        bucket = self._bucket_of.pop(number, None)
        if bucket is not None:
            self._numbers[bucket].discard(number)
            if not self._numbers[bucket]:
                del self._numbers[bucket]

    def query_radius(self, x: float, y: float, reach_m: float) -> list[int]:
        """All numbers within reach_m of a point, m, sorted.

        Some more distant ones may be among them.
        """
        if not (math.isfinite(x) and math.isfinite(y)):
            return []
        low_col, high_col = (
            math.floor((x + reach) / self._edge_m) for reach in (-reach_m, reach_m)
        )
        low_row, high_row = (
            math.floor((y + reach) / self._edge_m) for reach in (-reach_m, reach_m)
        )
        found: list[int] = []
        for col in range(low_col, high_col + 1):
            for row in range(low_row, high_row + 1):
                found.extend(self._numbers.get((col, row), ()))
        return sorted(found)
