"""Basins of the clearance: a watershed by merge tree, cut where a passage is a neck.

Cells are flooded from the roomiest one down. A cell beside one basin joins it; a cell beside two is
their saddle, the widest place of the narrowest path between them: they become one basin, unless the
saddle is a neck. So a path round a table, where basins meet again lower down, is no door.
Source: watershed after F. Meyer, "Topographic distance and watershed lines", 1994; compared for
maps by R. Bormann et al., "Room segmentation: survey, implementation, and analysis", ICRA 2016.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.jit import inlined, kernel

Labels = NDArray[np.int32]
Cells = NDArray[np.int64]


@dataclass(frozen=True)
class Neck:
    """When a saddle separates two basins.

    ratio: clearance there relative to the smaller peak, at most. widest: largest clearance there,
    m. least_cells: of the smaller basin.
    """

    ratio: float
    widest: float
    least_cells: int


def flood(clearance: NDArray[np.float64], neck: Neck) -> tuple[Labels, Cells]:
    """Basins of a clearance (H, W), m, 0 outside of the space.

    Returns the basin of each cell, from 1, 0 outside, (H, W); and the saddles between basins,
    widest first (N, 3): flat index of the cell, lower and higher basin.
    """
    flat = np.ascontiguousarray(clearance).ravel()
    basin, parent, saddles = _flood(
        flat, _from_widest(flat), clearance.shape[1], neck.ratio, neck.widest, neck.least_cells
    )
    number = np.zeros(len(parent) + 1, dtype=np.int32)  # the last: of cells outside
    number[:-1] = 1 + np.unique(parent, return_inverse=True)[1]
    pairs = np.sort(number[saddles[:, 1:]], axis=1)
    apart = pairs[:, 0] != pairs[:, 1]
    labels: Labels = number[basin].reshape(clearance.shape)
    return labels, np.column_stack([saddles[apart, 0], pairs[apart]])


def _from_widest(flat: NDArray[np.float64]) -> Cells:
    """Indices of the cells inside, the roomiest first."""
    inside = np.flatnonzero(flat > 0.0)
    return inside[np.argsort(-flat[inside], kind='stable')]


@inlined
def _root(parent: Cells, k: int) -> int:
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@kernel
def _flood(
    flat: NDArray[np.float64],
    order: Cells,
    cols: int,
    ratio: float,
    widest: float,
    least_cells: int,
) -> tuple[Labels, Cells, Cells]:
    """Basin of each cell (-1 outside), basin that each one was merged into, saddles (N, 3)."""
    basin = np.full(flat.size, -1, dtype=np.int32)
    parent = np.empty(order.size, dtype=np.int64)
    peak = np.empty(order.size)
    cells = np.zeros(order.size, dtype=np.int64)
    saddles = np.empty((3 * order.size, 3), dtype=np.int64)
    count = 0
    basins = 0
    for at in order:
        best = -1  # basin beside this cell, of several merged ones their union
        uphill = -1  # basin of the neighbour with the largest clearance
        highest = 0.0
        col = at % cols
        for step in range(9):
            to_col = col + step % 3 - 1
            other_cell = at + (step // 3 - 1) * cols + step % 3 - 1
            outside = not (0 <= to_col < cols and 0 <= other_cell < flat.size)
            if outside or basin[other_cell] < 0:
                continue
            if flat[other_cell] > highest:
                highest = flat[other_cell]
                uphill = basin[other_cell]
            other = _root(parent, basin[other_cell])
            if best < 0 or best == other:
                best = other
                continue
            low = min(peak[best], peak[other])
            is_narrow = flat[at] < ratio * low and flat[at] <= widest
            if is_narrow and min(cells[best], cells[other]) >= least_cells:
                saddles[count] = (at, best, other)
                count += 1
                continue
            parent[other] = best
            peak[best] = max(peak[best], peak[other])
            cells[best] += cells[other]
        if best < 0:
            uphill = basins
            parent[uphill] = uphill
            peak[uphill] = flat[at]
            basins += 1
        # Up the steepest path, so that a boundary runs through its saddle.
        own = _root(parent, uphill)
        basin[at] = own
        cells[own] += 1
    for k in range(basins):
        parent[k] = _root(parent, k)
    return basin, parent[:basins].copy(), saddles[:count].copy()
