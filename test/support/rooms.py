"""Maps of single rooms with furniture, as a robot draws them: unknown outside."""

import numpy as np

from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.moved import overlaid
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch

_CELL_M = 0.05
_THICK_CELLS = 2.0

SIZE = (5.6, 4.4)
FLAT = (9.0, 7.5)

_PIECES = 14


def clutter(seed):
    """Corners of furniture (x, y, x, y), m."""
    rng = np.random.default_rng(seed)
    lows = rng.uniform(0.0, (5.0, 3.9), (_PIECES, 2))
    return np.hstack([lows, lows + rng.uniform(0.2, 0.7, (_PIECES, 2))]).tolist()


KITCHEN = clutter(2)
STUDY = clutter(6)


def room(boxes, size=SIZE):
    """A room of a size, m, with boxes in it: what walls and boxes hide is unknown."""
    cols, rows = (round(length / _CELL_M) for length in size)
    cells = np.zeros((rows, cols), dtype=np.int8)
    cells[:2] = cells[-2:] = 100
    cells[:, :2] = cells[:, -2:] = 100
    for box in boxes:
        left, low, right, high = (round(value / _CELL_M) for value in box)
        cells[low:high, left:right] = 100
    cells[distance_cells(cells == 0) > _THICK_CELLS] = UNKNOWN
    return GridPatch(GridFrame(0.0, 0.0, _CELL_M), cells)


def turned(patch, T):
    """The map in another frame, in which its own lies at a pose (3,)."""
    empty = GridPatch(GridFrame(0.0, 0.0, _CELL_M), np.full((1, 1), UNKNOWN, dtype=np.int8))
    return overlaid(empty, patch, T)
