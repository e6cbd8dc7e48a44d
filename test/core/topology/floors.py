"""Small floors of known regions: two rooms on a corridor."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch

CELL_M = 0.1
Cells = NDArray[np.int8]


def patch_of(cells: Cells, origin: tuple[float, float] = (-1.0, 2.0)) -> GridPatch:
    return GridPatch(GridFrame(*origin, CELL_M), cells)


def office() -> Cells:
    """A corridor of 16 x 2 m; above it rooms of 7.8 x 5 m and 7.8 x 5 m with doors of 1 m."""
    cells = np.full((75, 164), UNKNOWN, dtype=np.int8)
    cells[1:74, 1:163] = 100
    cells[2:22, 2:162] = 0
    cells[23:73, 2:80] = 0
    cells[23:73, 82:162] = 0
    cells[22, 30:40] = 0
    cells[22, 120:130] = 0
    return cells


def noisy(cells: Cells, rng: np.random.Generator) -> Cells:
    """With specks of unknown cells, a table's legs, and the wall between the rooms doubled."""
    found = cells.copy()
    free = np.argwhere(cells == 0)
    specks = free[rng.choice(len(free), len(free) // 50, replace=False)]
    found[tuple(specks.T)] = UNKNOWN
    for row, col in ((45, 40), (45, 50), (55, 40), (55, 50)):
        found[row, col] = 100
    found[23:73, 79:83] = 100
    found[25:70, 81] = 0
    return found
