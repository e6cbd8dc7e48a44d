"""Free space of the whole map, kept up to date from the cells that change."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Cells, Mask
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.layers.deletion_times import skeleton_cells
from thinmap_ros.core.topology.layers.lattice import (
    COLS,
    ROWS,
    Lattice,
    LatticeStore,
    cell_at,
    col_of,
    moved,
    read_cells,
    replace_cells,
    row_of,
    rows_and_cols,
)
from thinmap_ros.core.topology.thinning import (
    UNKNOWN,
    close_gaps,
    column_distance,
    deletion_times,
    gap_cells,
    room_of_columns,
    states_of,
)
from thinmap_ros.jit import inlined, kernel

_MIN_FRONTIER_CELLS = 3


class FreeSpace:
    """States of cells -> known free cells -> traversable cells, of the whole map.

    Known is what is free, or an unknown gap between two free cells of a row or column: specks
    between beams. A cell is traversable if every cell whose centre is nearer than the robot's
    radius is known: it is looked for again in the tiles around what changed. The rules are those of
    `select_free_space`.
    Source: exploration paper section 2.1, "selection of free space"; the gaps are ours.
    """

    def __init__(self, config: TopologyConfig, resolution_m: float) -> None:
        self._radius = config.robot_radius_m / resolution_m
        self._gap = gap_cells(config, resolution_m)
        self._reach = max(math.ceil(self._radius), 2 * self._gap) + 2
        self._store = LatticeStore(self._reach)

    @property
    def lattice(self) -> Lattice:
        """The cells, for kernels; valid until the next update."""
        return self._store.view

    @property
    def is_empty(self) -> bool:
        """Whether no cell has ever been known."""
        return len(self.lattice.tiles) == 1

    def fill(
        self,
        patch: GridPatch,
        free: Mask | None,
        row: int,
        col: int,
        lines: Mask | None = None,
    ) -> Cells:
        """Set all cells at once by a patch whose first cell is at (row, col).

        The layer is empty before. free (H, W): traversable cells; None: all where the robot fits.
        lines (H, W): cells that are thinned instead of these. Returns the cells of the skeleton.
        """
        states = states_of(patch.cells)
        known = close_gaps(states, self._gap)
        columns = column_distance(known)
        fits = room_of_columns(columns, self._radius) if free is None else free
        self._store.add(row, col, patch.cells >= 0)
        fields = {'state': states, 'known': known, 'free': fits, 'column': columns}
        for name, values in fields.items():
            self._store.put(name, values, row, col)
        del states, columns, fields  # the map may be large
        times = deletion_times(fits if lines is None else lines)
        self._store.put('time', times, row, col)
        return skeleton_cells(self.lattice, times, row, col)

    def states(self) -> tuple[Cells, NDArray[np.uint8]]:
        """Row and column (N, 2) of the tiles with known states, and these (N, TILE, TILE)."""
        return self._store.states()

    def update(self, percent: NDArray[np.int8], row: int, col: int) -> tuple[Cells, Cells]:
        """Update cells (H, W) of the grid, the first at (row, col).

        Returns the cells whose state changed, and those that became, or ceased to be, traversable.
        """
        self._store.add(row, col, percent >= 0)
        lattice = self.lattice
        states = states_of(percent)
        changed = replace_cells(lattice, lattice.cells['state'], row, col, states)
        known = self._update_around(
            changed, self._gap, 'known', 'state', lambda states: close_gaps(states, self._gap)
        )
        _update_columns(lattice, known)
        flipped = self._update_around(
            known,
            math.ceil(self._radius),
            'free',
            'column',
            lambda columns: room_of_columns(columns, self._radius),
        )
        return changed, flipped

    def _update_around(
        self,
        changed: Cells,
        reach: int,
        field: str,
        source: str,
        rule: Callable[[NDArray[Any]], Mask],
    ) -> Cells:
        """Update a field by a rule where some cells of its source changed; returns what changed.

        reach: rows and columns, up to which the rule asks for cells of the source.
        """
        if not changed.size:
            return changed
        lattice = self.lattice
        places = rows_and_cols(lattice, changed)
        row, col = (places.min(axis=0) - 2 * reach).tolist()
        rows, cols = (np.ptp(places, axis=0) + 1 + 4 * reach).tolist()
        found = rule(read_cells(lattice, lattice.cells[source], row, col, (rows, cols)))
        inner = np.ascontiguousarray(found[reach : rows - reach, reach : cols - reach])
        return replace_cells(
            lattice, lattice.cells[field], row + reach, col + reach, inner.view(np.uint8)
        )


@kernel
def _update_columns(lattice: Lattice, changed: Cells) -> None:
    """Update the distances along columns to cells that are not known."""
    cells = lattice.cells
    for at in changed:
        if not cells[at]['known']:
            cells[at]['column'] = 0
            for sign in (-1, 1):
                k = 1
                to = moved(lattice, at, sign, 0)
                while cells[to]['column'] > k:
                    cells[to]['column'] = k
                    k += 1
                    to = moved(lattice, to, sign, 0)
            continue
        if cells[at]['column'] > 0:  # done with another new cell of the same run
            continue
        top = moved(lattice, at, -1, 0)
        above = 1
        while cells[top]['known']:
            top = moved(lattice, top, -1, 0)
            above += 1
        below = 1
        to = moved(lattice, at, 1, 0)
        while cells[to]['known']:
            to = moved(lattice, to, 1, 0)
            below += 1
        to = moved(lattice, top, 1, 0)
        for k in range(1 - above, below):
            cells[to]['column'] = min(k + above, below - k)
            to = moved(lattice, to, 1, 0)


@inlined
def squared_clearance(lattice: Lattice, at: int) -> int:
    """Squared distance, in cells, from a cell to the nearest one that is not known."""
    best = np.int64(lattice.cells[at]['column']) ** 2
    left = at
    right = at
    step = 1
    while step * step < best:
        left = moved(lattice, left, 0, -1)
        right = moved(lattice, right, 0, 1)
        near = np.int64(min(lattice.cells[left]['column'], lattice.cells[right]['column']))
        best = min(best, step * step + near * near)
        step += 1
    return int(best)


@kernel
def borders_unknown(lattice: Lattice, at: int, squared: int) -> bool:
    """Whether the free space around a cell ends at unknown cells, not only at obstacles.

    squared: squared clearance of the cell; some cells of the frontier within it, and one cell more,
    are enough.
    """
    reach = int(math.sqrt(squared) + 1.0)
    limit = (math.sqrt(squared) + 1.0) ** 2
    row = row_of(lattice, at)
    col = col_of(lattice, at)
    count = 0
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            if i * i + j * j > limit:
                continue
            to = cell_at(lattice, row + i, col + j)
            if not lattice.cells[to]['known']:
                continue
            for k in range(0, 8, 2):
                beside = lattice.cells[moved(lattice, to, ROWS[k], COLS[k])]
                if beside['state'] == UNKNOWN and not beside['known']:
                    count += 1
                    break
            if count >= _MIN_FRONTIER_CELLS:
                return True
    return False


@kernel
def nearest_free(lattice: Lattice, row: int, col: int, reach: int) -> int:
    """The traversable cell nearest to a cell, within a reach in cells; 0: none."""
    at = cell_at(lattice, row, col)
    if lattice.cells[at]['free']:
        return at
    best = 0
    best_squared = reach * reach + 1
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            squared = i * i + j * j
            if squared < best_squared:
                to = cell_at(lattice, row + i, col + j)
                if lattice.cells[to]['free']:
                    best = to
                    best_squared = squared
    return best


@kernel
def kept_above(lattice: Lattice, at: int, reach: int) -> int:
    """A skeleton cell of the part of a traversable cell, within a reach in cells; 0: none.

    No step is to a cell that is deleted earlier: the last remaining cell around each cell
    is of the skeleton.
    """
    side = 2 * reach + 1
    first_row = row_of(lattice, at) - reach
    first_col = col_of(lattice, at) - reach
    seen = np.zeros(side * side, dtype=np.bool_)
    stack = np.empty(side * side, dtype=np.int64)
    stack[0] = at
    count = 1
    while count > 0:
        count -= 1
        cell = stack[count]
        if lattice.cells[cell]['kept']:
            return int(cell)
        for k in range(8):
            to = moved(lattice, cell, ROWS[k], COLS[k])
            row = row_of(lattice, to) - first_row
            col = col_of(lattice, to) - first_col
            if not (0 <= row < side and 0 <= col < side) or seen[row * side + col]:
                continue
            time = lattice.cells[to]['time']
            if time >= lattice.cells[cell]['time'] and time > 0:
                seen[row * side + col] = True
                stack[count] = to
                count += 1
                # The latest one is the next.
                if count > 1 and lattice.cells[stack[count - 2]]['time'] > time:
                    stack[count - 1] = stack[count - 2]
                    stack[count - 2] = to
    return 0
