"""Stretches of border: who owns what of them, and where their middle is."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.jit import kernel

Cells = NDArray[np.int64]


@kernel
def without_scraps(owners: Cells, numbers: Cells, fewest: int) -> Cells:
    """Owners (N,) of cells, such that in each part none but the largest holds too few.

    numbers (N,): the part of each cell, from 0 on.
    Of equally large ones that with the lowest id counts as the largest.
    """
    result = owners.copy()
    ids = np.unique(owners)
    counts = np.zeros((numbers.max() + 1 if numbers.size else 0, ids.size), dtype=np.int64)
    places = np.searchsorted(ids, owners)
    for i in range(owners.size):
        counts[numbers[i], places[i]] += 1
    for i in range(owners.size):
        if counts[numbers[i], places[i]] < fewest:
            result[i] = ids[counts[numbers[i]].argmax()]
    return result


@kernel
def middle_one(cells: Cells) -> int:
    """Index of the cell (N, 2) nearest to the centre of gravity of all.

    The first of equally near ones.
    """
    row = 0.0
    col = 0.0
    for i in range(cells.shape[0]):
        row = row + cells[i, 0]
        col = col + cells[i, 1]
    row = row / cells.shape[0]
    col = col / cells.shape[0]
    best = np.inf
    middle = 0
    for i in range(cells.shape[0]):
        away = (cells[i, 0] - row) ** 2 + (cells[i, 1] - col) ** 2
        if away < best:
            best = away
            middle = i
    return middle
