"""Which cells hang together, over edges and corners.

Found row by row, from one run of true cells to the next.
"""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.jit import kernel

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]


def label(cells: Mask) -> tuple[NDArray[np.int32], Cells]:
    """Number of the part (joined over edges and corners) of each true cell, 0 elsewhere.

    Cells in each part.

    Parts are numbered in the order of their first cells, row after row.
    """
    numbers: NDArray[np.int32]
    numbers, sizes = _label(np.ascontiguousarray(cells))
    return numbers, sizes


def reachable(cells: Mask, seeds: Cells) -> Mask:
    """The true cells (H, W) that are joined to one of the seeds (N, 2), over edges and corners."""
    found: Mask = _reachable(np.ascontiguousarray(cells), seeds)
    return found


@kernel
def _runs(cells: Mask) -> tuple[Cells, Cells, Cells, int]:
    """Runs (R, 3) of true cells as (row, first column, end), row after row, and what they make.

    Also: which run is the first of each row, (H + 1,); the number of each run's part from 1 on,
    (R,); how many parts.
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
                a = _root(owner, k)
                b = _root(owner, other)
                owner[max(a, b)] = min(a, b)
                other += 1
    parts = np.empty(count, dtype=np.int64)
    number = 0
    for k in range(count):
        root = _root(owner, k)
        if root == k:
            number += 1
            parts[k] = number
        else:
            parts[k] = parts[root]
    return runs[:count], first, parts, number


@kernel
def _root(owner: Cells, k: int) -> int:
    """The earliest run known to be of the same part.

    The way there is made shorter for the next one who asks.
    """
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
