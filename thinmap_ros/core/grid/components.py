"""Connected components of a mask, with 8-connectivity.

Runs of true cells are joined row by row, with a union-find structure.
"""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.jit import kernel

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]


def label(cells: Mask) -> tuple[NDArray[np.int32], Cells]:
    """Label the 8-connected components of a mask (H, W).

    Returns the component number of each true cell (0 elsewhere), (H, W), and the number of cells of
    each component. Components are numbered in the order of their first cells, row by row.
    """
    numbers: NDArray[np.int32]
    numbers, sizes = _label(np.ascontiguousarray(cells))
    return numbers, sizes


def reachable(cells: Mask, seeds: Cells) -> Mask:
    """True cells (H, W) in the same 8-connected component as one of the seeds (N, 2)."""
    found: Mask = _reachable(np.ascontiguousarray(cells), np.ascontiguousarray(seeds))
    return found


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
    """Root of a run in the union-find structure, with path compression."""
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
