"""The cells that all layers of the topological map share, in tiles that exist where needed.

The index of a cell is the slot of its tile and its place in the tile. It never changes while the
map grows, so layers refer to cells by it. The key of a cell orders cells by row and column,
whatever the order in which the tiles were made.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.tiles import MAX_TILES, NO_TILE, TILE, TileStore
from thinmap_ros.core.se2 import Cells, Mask
from thinmap_ros.jit import inlined, kernel

CELL = np.dtype(
    [
        ('state', np.uint8),  # UNKNOWN, FREE or OCCUPIED, see thinning.py
        ('known', np.uint8),  # free, or an unknown gap between free cells
        ('free', np.uint8),  # traversable: the robot's centre may be here
        ('kept', np.uint8),  # belongs to the skeleton
        ('due', np.uint8),  # beside a cell whose deletion time has just changed
        ('column', np.int16),  # rows to the nearest cell of the column that is not known
        ('time', np.int16),  # sub-iteration that deletes it, see deletion_times.py
        ('owner', np.int32),  # chain + 1 in a chain, -(vertex + 1) at a vertex, 0: neither
    ]
)
# The eight neighbours, clockwise from north (p2 to p9 of the paper).
ROWS = np.array([-1, -1, 0, 1, 1, 1, 0, -1], dtype=np.int64)
COLS = np.array([0, 1, 1, 1, 0, -1, -1, -1], dtype=np.int64)
_BITS = TILE.bit_length() - 1
_MASK = TILE - 1
_MOST_TILES = 3 * MAX_TILES  # the largest image of a map, and its margin
_OFFSET = 1 << 30  # makes rows and columns positive
_KEY_BITS = 31


class Lattice(NamedTuple):
    """View of the cells for kernels, valid until tiles are added.

    cells: of all tiles, one after the other, dtype CELL; directory: the slot of each tile, or
    NO_TILE; first_row, first_col: tile of its first entry; tiles (N, 2): row and column of the tile
    in each slot.
    """

    cells: NDArray[Any]
    directory: NDArray[np.int32]
    first_row: int
    first_col: int
    tiles: Cells


class LatticeStore:
    """Cells that begin as 0, in tiles; those around the map exist, too.

    margin_cells: distance from each cell of the map to which kernels read.
    """

    def __init__(self, margin_cells: int) -> None:
        # The margin may reach beyond the largest grid; slot 0 is read outside of all tiles.
        self._store = TileStore(
            CELL,
            (),
            4 * MAX_TILES,
            begins_at_origin=False,
            reserved=1,
            max_tiles=_MOST_TILES,
        )
        self._margin = -(-margin_cells // TILE)
        self._needed: set[tuple[int, ...]] = set()
        self.view = self._view()

    def add(self, row: int, col: int, is_needed: Mask) -> None:
        """Add the tiles with cells (H, W) that are needed, the first at (row, col).

        So are the tiles within the margin around them.
        """
        needed = needed_tiles(is_needed, row, col)
        fresh = [tile for tile in map(tuple, needed.tolist()) if tile not in self._needed]
        if not fresh:
            return
        steps = np.arange(-self._margin, self._margin + 1)
        around = np.stack(np.meshgrid(steps, steps, indexing='ij'), axis=-1).reshape(-1, 2)
        wanted = np.unique((np.array(fresh)[:, None] + around).reshape(-1, 2), axis=0)
        low_row, low_col = wanted.min(axis=0).tolist()
        high_row, high_col = wanted.max(axis=0).tolist()
        self._store.grow_to(low_row, low_col, high_row, high_col)
        self._store.allocate(wanted)
        self._needed.update(fresh)
        self.view = self._view()

    def put(self, field: str, values: NDArray[Any], row: int, col: int) -> None:
        """Set a field of those of the cells (H, W) that exist, the first at (row, col)."""
        self._store.overwrite(row, col, values, field)

    def states(self) -> tuple[Cells, NDArray[np.uint8]]:
        """Row and column (N, 2) of the tiles with known states, and these (N, TILE, TILE)."""
        cells = self._store.pool[1 : self._store.used]['state']
        is_known = cells.any(axis=(1, 2))
        return self.view.tiles[1:][is_known], np.ascontiguousarray(cells[is_known])

    def _view(self) -> Lattice:
        store = self._store
        return Lattice(
            store.pool.reshape(-1),
            store.directory,
            store.first_row,
            store.first_col,
            np.concatenate((np.zeros((1, 2), dtype=np.int64), store.tile_coordinates())),
        )


@kernel
def needed_tiles(is_needed: Mask, row: int, col: int) -> Cells:
    """Tiles (N, 2) with cells (H, W) that are needed, the first at (row, col)."""
    first_row = row >> _BITS
    first_col = col >> _BITS
    rows = ((row + is_needed.shape[0] - 1) >> _BITS) - first_row + 1
    cols = ((col + is_needed.shape[1] - 1) >> _BITS) - first_col + 1
    found = np.zeros((rows, cols), dtype=np.bool_)
    for i in range(is_needed.shape[0]):
        tile_row = ((row + i) >> _BITS) - first_row
        for j in range(is_needed.shape[1]):
            if is_needed[i, j]:
                found[tile_row, ((col + j) >> _BITS) - first_col] = True
    places = np.argwhere(found)
    places[:, 0] += first_row
    places[:, 1] += first_col
    return places


@kernel
def sorted_unique(cells: Cells) -> Cells:
    """Cells (N,) in order, each once."""
    ordered = np.sort(cells)
    count = 0
    for k in range(ordered.size):
        if k == 0 or ordered[k] != ordered[k - 1]:
            ordered[count] = ordered[k]
            count += 1
    return ordered[:count].copy()


@inlined
def cell_at(lattice: Lattice, row: int, col: int) -> int:
    """Index of the cell at a row and column; outside of all tiles that of a cell of zeros."""
    tile_row = (row >> _BITS) - lattice.first_row
    tile_col = (col >> _BITS) - lattice.first_col
    slot = NO_TILE
    if 0 <= tile_row < lattice.directory.shape[0] and 0 <= tile_col < lattice.directory.shape[1]:
        slot = lattice.directory[tile_row, tile_col]
    if slot == NO_TILE:
        return 0
    return (int(slot) << (2 * _BITS)) | ((row & _MASK) << _BITS) | (col & _MASK)


@inlined
def row_of(lattice: Lattice, at: int) -> int:
    """Row of a cell."""
    return (int(lattice.tiles[at >> (2 * _BITS), 0]) << _BITS) | ((at >> _BITS) & _MASK)


@inlined
def col_of(lattice: Lattice, at: int) -> int:
    """Column of a cell."""
    return (int(lattice.tiles[at >> (2 * _BITS), 1]) << _BITS) | (at & _MASK)


@inlined
def moved(lattice: Lattice, at: int, rows: int, cols: int) -> int:
    """Index of the cell so many rows and columns away."""
    row = ((at >> _BITS) & _MASK) + rows
    col = (at & _MASK) + cols
    if 0 <= row < TILE and 0 <= col < TILE:
        return at + (rows << _BITS) + cols
    slot = at >> (2 * _BITS)
    return cell_at(
        lattice, (lattice.tiles[slot, 0] << _BITS) + row, (lattice.tiles[slot, 1] << _BITS) + col
    )


@inlined
def neighbour(lattice: Lattice, at: int, k: int) -> int:
    """Index of a neighbour of a cell, k of 8."""
    return moved(lattice, at, ROWS[k], COLS[k])


@inlined
def is_inner(at: int, margin: int) -> bool:
    """Whether all cells within a margin of a cell are in its tile: `at + shift(rows, cols)`."""
    row = (at >> _BITS) & _MASK
    col = at & _MASK
    return bool(margin <= row < TILE - margin and margin <= col < TILE - margin)


@inlined
def shift(rows: int, cols: int) -> int:
    """What is added to the index of a cell for another in the same tile."""
    return (rows << _BITS) + cols


@inlined
def find_neighbours(lattice: Lattice, at: int, near: Cells) -> None:
    """Write the indices of the eight neighbours of a cell into near (8,)."""
    if is_inner(at, 1):
        for k in range(8):
            near[k] = at + shift(ROWS[k], COLS[k])
    else:
        for k in range(8):
            near[k] = moved(lattice, at, ROWS[k], COLS[k])


@inlined
def key_of(lattice: Lattice, at: int) -> int:
    """Key of a cell: orders cells by row, then by column."""
    row = row_of(lattice, at) + _OFFSET
    return (row << _KEY_BITS) | (col_of(lattice, at) + _OFFSET)


@inlined
def hash_of(lattice: Lattice, at: int) -> int:
    """Hash of a cell by its key. Source: splitmix64, Steele, Lea and Flood, 2014."""
    x = np.uint64(key_of(lattice, at)) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return int(np.int64(x ^ (x >> np.uint64(31))))


@inlined
def cell_of(slot: int, row: int) -> int:
    """Index of the first cell in a row of the tile in a slot."""
    return (slot << (2 * _BITS)) + (row << _BITS)


@kernel
def read_cells(
    lattice: Lattice, field: NDArray[Any], row: int, col: int, shape: tuple[int, int]
) -> NDArray[Any]:
    """Copy of a field (N,) of the cells in a rectangle (H, W), the first at (row, col)."""
    values = np.empty(shape, dtype=field.dtype)
    for i in range(shape[0]):
        at = 0
        for j in range(shape[1]):
            if j == 0 or (col + j) % TILE == 0:
                at = cell_at(lattice, row + i, col + j)
            elif at > 0:
                at += 1
            values[i, j] = field[at]
    return values


@kernel
def replace_cells(
    lattice: Lattice, field: NDArray[Any], row: int, col: int, values: NDArray[Any]
) -> Cells:
    """Set a field (N,) of those of the cells (H, W) from (row, col) on that exist.

    Returns the cells that changed.
    """
    changed = np.empty(values.size, dtype=np.int64)
    count = 0
    for i in range(values.shape[0]):
        at = 0
        for j in range(values.shape[1]):
            if j == 0 or (col + j) % TILE == 0:
                at = cell_at(lattice, row + i, col + j)
            elif at > 0:
                at += 1
            if at > 0 and field[at] != values[i, j]:
                field[at] = values[i, j]
                changed[count] = at
                count += 1
    return changed[:count].copy()


@kernel
def tiles_around(lattice: Lattice, cells: Cells, reach: int) -> Cells:
    """Slots (T,) of the tiles with cells that are at most `reach` rows and columns from some."""
    is_near = np.zeros(len(lattice.tiles), dtype=np.bool_)
    for at in cells:
        is_near[at >> (2 * _BITS)] = True
        if is_inner(at, reach):
            continue
        for row in range(-reach, reach + TILE, TILE):
            for col in range(-reach, reach + TILE, TILE):
                to = moved(lattice, at, min(row, reach), min(col, reach))
                is_near[to >> (2 * _BITS)] = True
    is_near[0] = False
    return np.flatnonzero(is_near)


@kernel
def rows_and_cols(lattice: Lattice, cells: Cells) -> Cells:
    """Row and column (N, 2) of cells (N,)."""
    found = np.empty((cells.size, 2), dtype=np.int64)
    for k in range(cells.size):
        found[k, 0] = row_of(lattice, cells[k])
        found[k, 1] = col_of(lattice, cells[k])
    return found


@kernel
def cells_at(lattice: Lattice, places: Cells) -> Cells:
    """Indices (N,) of the cells at rows and columns (N, 2)."""
    found = np.empty(len(places), dtype=np.int64)
    for k in range(len(places)):
        found[k] = cell_at(lattice, places[k, 0], places[k, 1])
    return found
