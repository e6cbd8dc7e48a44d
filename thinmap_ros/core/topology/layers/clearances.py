"""Clearances along paths, and the paths that a changed cell may concern."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.topology.layers.free_space import squared_clearance
from thinmap_ros.core.topology.layers.lattice import Cells, Lattice
from thinmap_ros.jit import kernel


@kernel
def squared_clearances(lattice: Lattice, cells: Cells) -> Cells:
    """Squared clearance of each cell (K,), in cells."""
    squared = np.empty(cells.size, dtype=np.int64)
    for k in range(cells.size):
        squared[k] = squared_clearance(lattice, cells[k])
    return squared


@kernel
def least_between(squared: Cells, stops: Cells) -> Cells:
    """Smallest squared clearance of each piece of a path between two stops."""
    least = np.empty(stops.size - 1, dtype=np.int64)
    for k in range(stops.size - 1):
        least[k] = squared[stops[k] : stops[k + 1] + 1].min()
    return least


@kernel
def box_of(places: Cells, squared: Cells) -> Cells:
    """First row and column, last row and column of the space around a path (K, 2) of cells."""
    reach = int(np.sqrt(squared.max())) + 3
    rows = places[:, 0]
    cols = places[:, 1]
    return np.array(
        [rows.min() - reach, cols.min() - reach, rows.max() + reach, cols.max() + reach]
    )


@kernel
def touched_boxes(boxes: Cells, places: Cells) -> NDArray[np.bool_]:
    """Which boxes (N, 4), see `box_of`, hold one of the cells (K, 2)."""
    found = np.zeros(len(boxes), dtype=np.bool_)
    low_row = places[:, 0].min()
    high_row = places[:, 0].max()
    low_col = places[:, 1].min()
    high_col = places[:, 1].max()
    for k in range(len(boxes)):
        if boxes[k, 0] > high_row or boxes[k, 2] < low_row:
            continue
        if boxes[k, 1] > high_col or boxes[k, 3] < low_col:
            continue
        for i in range(len(places)):
            is_row = boxes[k, 0] <= places[i, 0] <= boxes[k, 2]
            if is_row and boxes[k, 1] <= places[i, 1] <= boxes[k, 3]:
                found[k] = True
                break
    return found
