"""Tiles: storage for maps growing in any direction, in memory proportional to what was touched."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.frame import FINEST_M
from thinmap_ros.core.se2 import FARTHEST_M

TILE = 64  # cells along the edge of a tile
NO_TILE = -1
_MOST_TILES = 1 << 15  # 134 million cells, some 1.1 km in each direction at 0.1 m
MOST_CELLS = _MOST_TILES * TILE * TILE
FARTHEST_TILE = int(FARTHEST_M / FINEST_M) // TILE  # of the finest cells
_FIRST = 64  # tiles that there is room for at first; what is not used costs no memory
_BORDER = 4  # tiles by which the directory grows at a time


class TileStore:
    """An unbounded lattice of cells, in square tiles of TILE x TILE that exist only where needed.

    A cell is a number of the given type, or an array of them of shape per_cell; it begins as 0.
    `directory` (R, C) int32 says for each tile of a bounding rectangle which slot of `pool`
    (N, TILE, TILE, *per_cell) holds it, or NO_TILE; `first_row`, `first_col`: tile coordinates of
    directory[0, 0]. Only the directory, one number a tile, is ever laid anew when the map grows;
    the pool is lengthened by half, or more where more is needed at once.
    """

    def __init__(self, dtype: DTypeLike = np.int16, per_cell: tuple[int, ...] = ()) -> None:
        self.directory: NDArray[np.int32] = np.full((1, 1), NO_TILE, dtype=np.int32)
        self.pool: NDArray[Any] = np.zeros((_FIRST, TILE, TILE, *per_cell), dtype=dtype)
        self.first_row = 0
        self.first_col = 0
        self.used = 0

    def reach(self, row_a: int, col_a: int, row_b: int, col_b: int) -> None:
        """Lay out the directory for the tiles from (row_a, col_a) to (row_b, col_b), inclusive.

        Raises InputError where that would make it larger than any building: a pose is wrong then.
        """
        rows, cols = self.directory.shape
        low_row, low_col = min(row_a, self.first_row), min(col_a, self.first_col)
        high_row = max(row_b + 1, self.first_row + rows)
        high_col = max(col_b + 1, self.first_col + cols)
        if (high_row - low_row, high_col - low_col) == (rows, cols):
            return
        low_row, low_col = low_row - _BORDER, low_col - _BORDER
        high_row, high_col = high_row + _BORDER, high_col + _BORDER
        if (high_row - low_row) * (high_col - low_col) > _MOST_TILES:
            size = f'{high_row - low_row} x {high_col - low_col}'
            raise InputError(f'map of {size} tiles: expected {_MOST_TILES} at most')
        wider = np.full((high_row - low_row, high_col - low_col), NO_TILE, dtype=np.int32)
        row, col = self.first_row - low_row, self.first_col - low_col
        wider[row : row + rows, col : col + cols] = self.directory
        self.directory, self.first_row, self.first_col = wider, low_row, low_col

    def ensure(self, tiles: NDArray[np.int64]) -> None:
        """Make the tiles (N, 2), (row, col) in tile coordinates inside the directory, exist.

        Those that did not are stored in the order in which they are given.
        """
        at = tiles - (self.first_row, self.first_col)
        missing = at[self.directory[at[:, 0], at[:, 1]] == NO_TILE]
        missing = np.array(list(dict.fromkeys(map(tuple, missing.tolist()))), dtype=np.int64)
        missing = missing.reshape(-1, 2)
        used = self.used + len(missing)
        if used > self.pool.shape[0]:
            size = max(used, self.used + self.used // 2)
            longer = np.zeros((size, *self.pool.shape[1:]), dtype=self.pool.dtype)
            longer[: self.used] = self.pool[: self.used]
            self.pool = longer
        self.directory[missing[:, 0], missing[:, 1]] = np.arange(self.used, used)
        self.used = used

    def places(self) -> NDArray[np.int64]:
        """Tile coordinates (N, 2) as (row, col) of the tiles in the order of their slots."""
        found = np.argwhere(self.directory != NO_TILE)
        order = np.argsort(self.directory[found[:, 0], found[:, 1]])
        return np.asarray(found[order] + (self.first_row, self.first_col), dtype=np.int64)

    def bounds(self) -> tuple[int, int, int, int] | None:
        """First row, first col, end row, end col, in cells, of the rectangle of existing tiles.

        None if empty.
        """
        rows, cols = np.nonzero(self.directory != NO_TILE)
        if rows.size == 0:
            return None
        row_a, row_b = int(rows.min()) + self.first_row, int(rows.max()) + self.first_row + 1
        col_a, col_b = int(cols.min()) + self.first_col, int(cols.max()) + self.first_col + 1
        return row_a * TILE, col_a * TILE, row_b * TILE, col_b * TILE

    def read(self, row: int, col: int, rows: int, cols: int) -> NDArray[Any]:
        """Copy of the cells [row, row + rows) x [col, col + cols); 0 where no tile is."""
        cells = np.zeros((rows, cols, *self.pool.shape[3:]), dtype=self.pool.dtype)
        for tile_row, tile_col, slot in self._tiles_within(row, col, rows, cols):
            top, left = tile_row * TILE, tile_col * TILE
            row_a, row_b = max(row, top), min(row + rows, top + TILE)
            col_a, col_b = max(col, left), min(col + cols, left + TILE)
            cells[row_a - row : row_b - row, col_a - col : col_b - col] = self.pool[
                slot, row_a - top : row_b - top, col_a - left : col_b - left
            ]
        return cells

    def write(self, row: int, col: int, cells: NDArray[Any]) -> None:
        """Set the cells from (row, col) on to those given, (H, W, ...)."""
        rows, cols = cells.shape[:2]
        tiles = np.mgrid[
            row // TILE : (row + rows - 1) // TILE + 1, col // TILE : (col + cols - 1) // TILE + 1
        ]
        tiles = tiles.reshape(2, -1).T
        self.reach(int(tiles[0, 0]), int(tiles[0, 1]), int(tiles[-1, 0]), int(tiles[-1, 1]))
        self.ensure(tiles)
        for tile_row, tile_col, slot in self._tiles_within(row, col, rows, cols):
            top, left = tile_row * TILE, tile_col * TILE
            row_a, row_b = max(row, top), min(row + rows, top + TILE)
            col_a, col_b = max(col, left), min(col + cols, left + TILE)
            self.pool[slot, row_a - top : row_b - top, col_a - left : col_b - left] = cells[
                row_a - row : row_b - row, col_a - col : col_b - col
            ]

    def _tiles_within(self, row: int, col: int, rows: int, cols: int) -> list[tuple[int, int, int]]:
        """Existing tiles that touch a rectangle of cells: tile row, tile col, slot."""
        low = (row // TILE - self.first_row, col // TILE - self.first_col)
        high = (
            (row + rows - 1) // TILE - self.first_row,
            (col + cols - 1) // TILE - self.first_col,
        )
        part = self.directory[max(low[0], 0) : high[0] + 1, max(low[1], 0) : high[1] + 1]
        found = np.argwhere(part != NO_TILE)
        first = (max(low[0], 0), max(low[1], 0))
        return [
            (
                int(r) + first[0] + self.first_row,
                int(c) + first[1] + self.first_col,
                int(part[r, c]),
            )
            for r, c in found
        ]
