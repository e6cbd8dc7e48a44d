"""Free space of the whole map, kept up to date from the cells that change."""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import (
    FREE_AT_MOST,
    OCCUPIED_AT_LEAST,
    GridPatch,
)
from thinmap_ros.core.grid.tiles import TILE
from thinmap_ros.core.se2 import Cells, Mask
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.layers.deletion_times import skeleton_cells
from thinmap_ros.core.topology.layers.lattice import (
    COLS,
    FREE,
    OCCUPIED,
    ROWS,
    UNKNOWN,
    Lattice,
    LatticeStore,
    cell_at,
    cell_of,
    col_of,
    moved,
    row_of,
    tiles_around,
)
from thinmap_ros.core.topology.thinning import (
    column_distance,
    deletion_times,
    known_free,
    standing_room,
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
        self._config = config
        self._radius = config.robot_radius_m / resolution_m
        self._gap = int(config.max_unknown_gap_m / resolution_m + 1e-6)
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
        known = known_free(patch, self._config)
        columns = column_distance(known)
        fits = standing_room(columns, self._radius) if free is None else free
        occupied = patch.cells >= OCCUPIED_AT_LEAST
        state = np.uint8(FREE) * patch.free + np.uint8(OCCUPIED) * occupied
        self._store.add(row, col, patch.cells >= 0)
        fields = {'state': state, 'known': known, 'free': fits, 'column': columns}
        for name, values in fields.items():
            self._store.put(name, values, row, col)
        del occupied, state, columns, fields  # the map may be large
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
        # Views, and maps that are read-only, would compile further variants of the kernel.
        changed = _set_states(lattice, percent.copy(), row, col)
        known = _close_gaps(lattice, changed, self._gap)
        _update_columns(lattice, known)
        reach = math.ceil(self._radius)
        tiles = tiles_around(lattice, known, reach)
        room = standing_room(_columns_of(lattice, tiles, reach), self._radius)[:, reach:]
        # Of no tile the view is contiguous, and would compile a second variant of the kernel.
        return changed, _set_free(lattice, tiles, np.ascontiguousarray(room[:, :TILE]))


@inlined
def _state_of(percent: int) -> int:
    if percent < 0:
        return UNKNOWN
    if percent <= FREE_AT_MOST:
        return FREE
    return OCCUPIED if percent >= OCCUPIED_AT_LEAST else UNKNOWN


@kernel
def _set_states(lattice: Lattice, percent: NDArray[np.int8], row: int, col: int) -> Cells:
    """Set the states of cells (H, W), the first at (row, col); returns the cells that changed."""
    changed = np.empty(percent.size, dtype=np.int64)
    count = 0
    for i in range(percent.shape[0]):
        at = 0
        for j in range(percent.shape[1]):
            if j == 0 or (col + j) % TILE == 0:
                at = cell_at(lattice, row + i, col + j)
            elif at > 0:
                at += 1
            state = _state_of(percent[i, j])
            if at > 0 and lattice.cells[at]['state'] != state:
                lattice.cells[at]['state'] = state
                changed[count] = at
                count += 1
    return changed[:count].copy()


@inlined
def _is_gap(lattice: Lattice, at: int, rows: int, cols: int, longest: int) -> bool:
    """Whether an unknown cell is in a run of at most `longest` between two free cells."""
    length = 1
    for sign in (-1, 1):
        to = moved(lattice, at, sign * rows, sign * cols)
        while lattice.cells[to]['state'] == UNKNOWN and length <= longest:
            to = moved(lattice, to, sign * rows, sign * cols)
            length += 1
        if lattice.cells[to]['state'] != FREE:
            return False
    return length <= longest


@kernel
def _close_gaps(lattice: Lattice, changed: Cells, gap: int) -> Cells:
    """Update the known cells near changed cells; returns those that changed."""
    found = np.empty(changed.size * (4 * gap + 1), dtype=np.int64)
    count = 0
    for at in changed:
        count = _close_gap(lattice, at, gap, found, count)
        for k in range(0, 8, 2):
            to = moved(lattice, at, ROWS[k], COLS[k])
            length = 1
            # Only the run of unknown cells that ends here may have become a gap, or ceased to be.
            while length <= gap and lattice.cells[to]['state'] == UNKNOWN:
                count = _close_gap(lattice, to, gap, found, count)
                to = moved(lattice, to, ROWS[k], COLS[k])
                length += 1
    return found[:count].copy()


@inlined
def _close_gap(lattice: Lattice, at: int, gap: int, found: Cells, count: int) -> int:
    """Update whether a cell is known; if that changes it, it is appended to `found`."""
    state = lattice.cells[at]['state']
    is_known = state == FREE
    if state == UNKNOWN and gap > 0:
        is_known = _is_gap(lattice, at, 0, 1, gap) or _is_gap(lattice, at, 1, 0, gap)
    if is_known != lattice.cells[at]['known']:
        lattice.cells[at]['known'] = is_known
        found[count] = at
        count += 1
    return count


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


@kernel
def _columns_of(lattice: Lattice, tiles: Cells, margin: int) -> NDArray[np.int16]:
    """Distances along columns (N * TILE, TILE + 2 * margin) in tiles, and on both sides."""
    columns = np.empty((tiles.size * TILE, TILE + 2 * margin), dtype=np.int16)
    for i in range(len(columns)):
        tile = lattice.tiles[tiles[i // TILE]]
        row = tile[0] * TILE + i % TILE
        at = 0
        for j in range(-margin, TILE + margin):
            if j == -margin or j % TILE == 0:
                at = cell_at(lattice, row, tile[1] * TILE + j)
            elif at > 0:
                at += 1
            columns[i, j + margin] = lattice.cells[at]['column']
    return columns


@kernel
def _set_free(lattice: Lattice, tiles: Cells, room: Mask) -> Cells:
    """Set which cells (N * TILE, TILE) of tiles are traversable; returns those that changed."""
    flipped = np.empty(room.size, dtype=np.int64)
    count = 0
    for i in range(len(room)):
        first = cell_of(tiles[i // TILE], i % TILE)
        for j in range(TILE):
            if lattice.cells[first + j]['free'] != room[i, j]:
                lattice.cells[first + j]['free'] = room[i, j]
                flipped[count] = first + j
                count += 1
    return flipped[:count].copy()


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
