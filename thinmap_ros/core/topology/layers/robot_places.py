"""Where the robot has been, as cells of the free space and of the skeleton."""

import numpy as np

from thinmap_ros.core.topology.layers.free_space import nearest_free, nearest_kept
from thinmap_ros.core.topology.layers.lattice import Cells, Lattice

_BLOCK = 10  # cells; one place in a block is enough
_REACH = 160  # steps from a place to the skeleton that are tried first, in cells
_MAX_REACH = 2560


class RobotPlaces:
    """Places of the robot: parts of the skeleton without any are not published.

    A place that is no longer traversable is removed.
    """

    def __init__(self, reach: int) -> None:
        """reach: largest distance from the robot to a traversable cell, in cells."""
        self._reach = reach
        # Of each place a traversable cell, and the skeleton cell nearest to it; 0: removed.
        self._cells: Cells = np.empty(0, dtype=np.int64)
        self._kept: Cells = np.empty(0, dtype=np.int64)
        self._numbers: dict[tuple[int, int], int] = {}

    @property
    def cells(self) -> Cells:
        """A traversable cell (N,) at or near each place."""
        return np.asarray(self._cells[self._cells != 0])

    def add(self, lattice: Lattice, row: int, col: int) -> bool:
        """Add the place at a row and column; returns whether it is new."""
        block = (row // _BLOCK, col // _BLOCK)
        number = self._numbers.get(block)
        if number is not None and lattice.cells[self._cells[number]]['free']:
            return False
        cell = int(nearest_free(lattice, row, col, self._reach))
        if cell == 0:
            return False
        self._numbers[block] = len(self._cells)
        self._cells = np.append(self._cells, cell)
        self._kept = np.append(self._kept, 0)
        return True

    def owners(self, lattice: Lattice) -> Cells:
        """Chain or vertex of the skeleton nearest to each place, as `owner` of the cell."""
        is_gone = lattice.cells['free'][self._cells] == 0
        self._cells[is_gone] = 0
        self._kept[is_gone] = 0
        is_stale = (lattice.cells['kept'][self._kept] == 0) & ~is_gone
        for k in np.flatnonzero(is_stale).tolist():
            self._kept[k] = _nearest_kept(lattice, int(self._cells[k]))
        return np.asarray(lattice.cells['owner'][self._kept], dtype=np.int64)


def _nearest_kept(lattice: Lattice, cell: int) -> int:
    """The skeleton cell nearest to a cell over traversable cells; 0: none."""
    reach = _REACH
    found = int(nearest_kept(lattice, cell, reach))
    while found == 0 and reach < _MAX_REACH:
        reach *= 2
        found = int(nearest_kept(lattice, cell, reach))
    return found
