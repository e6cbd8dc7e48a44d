"""Tile storage for maps that grow in any direction; memory is proportional to the area touched."""

import math
import mmap
import resource
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import MIN_RESOLUTION_M, Bounds, bounds_of
from thinmap_ros.core.se2 import MAX_COORDINATE_M, Cells

TILE = 64  # cells along the edge of a tile
NO_TILE = -1
MAX_TILES = 1 << 15  # 134 million cells, some 1.1 km in each direction at 0.1 m
MAX_CELLS = MAX_TILES * TILE * TILE
MAX_TILE_INDEX = int(MAX_COORDINATE_M / MIN_RESOLUTION_M) // TILE  # of the finest cells
_MIN_POOL_TILES = 64  # minimum capacity of a pool, tiles
# Room beyond what is needed, on a side of the directory that grows: a share of its length, and at
# least some tiles.
_ROOM_SHARE = 0.25
_MIN_ROOM = 4
_MAP_NORESERVE = 0x4000  # of Linux: a process with some of these can still fork


class _Span(NamedTuple):
    """Rows or columns of tiles from `first` to `end`, exclusive."""

    first: int
    end: int

    @property
    def length(self) -> int:
        """Number of rows or columns."""
        return self.end - self.first

    def covering(self, other: '_Span') -> '_Span':
        """The smallest span that holds this one, unless it is empty, and another."""
        if self.length == 0:
            return other
        return _Span(min(self.first, other.first), max(self.end, other.end))

    def grown_to(self, other: '_Span') -> '_Span':
        """A span that holds this one and another, with room to spare on each side that grew."""
        if self.length == 0:
            return other
        first, end = self.covering(other)
        room = max(_MIN_ROOM, int(_ROOM_SHARE * (end - first)))
        return _Span(
            first - room if first < self.first else first, end + room if end > self.end else end
        )


class TileStore:
    """An unbounded lattice of cells, in square tiles of TILE x TILE that exist only where needed.

    A cell is a number of the given type, or an array of them of shape per_cell; it begins as 0.
    `directory` (R, C) int32 says for each tile of a bounding rectangle which slot of `pool`
    (N, TILE, TILE, *per_cell) holds it, or NO_TILE; `first_row`, `first_col`: tile coordinates of
    directory[0, 0]. When the map grows, the directory (one number a tile) is copied into a larger
    one. The pool is not copied: it has the address space of the largest map, and the operating
    system allocates its pages on first write. If that much address space is not available, the pool
    is copied into one that is longer by half.
    """

    def __init__(
        self,
        dtype: DTypeLike = np.int16,
        per_cell: tuple[int, ...] = (),
        max_extent_tiles: int = MAX_TILES,
        begins_at_origin: bool = True,
        reserved: int = 0,
        max_tiles: int = MAX_TILES,
    ) -> None:
        """max_extent_tiles: area of the largest bounding rectangle, of which most may be empty.

        max_tiles: how many of them can exist.
        begins_at_origin: the rectangle always includes the origin; else only what is stored.
        reserved: number of slots at the beginning of the pool that hold no tile.
        """
        begin = int(begins_at_origin)
        self._max_extent_tiles = max_extent_tiles
        self._max_tiles = max_tiles
        self.directory: NDArray[np.int32] = np.full((begin, begin), NO_TILE, dtype=np.int32)
        self.pool: NDArray[Any] = _empty_pool(
            (TILE, TILE, *per_cell), dtype, _MIN_POOL_TILES, max_tiles
        )
        self.first_row = 0
        self.first_col = 0
        self.used = reserved

    def grow_to(self, row_a: int, col_a: int, row_b: int, col_b: int) -> None:
        """Extend the directory to the tiles from (row_a, col_a) to (row_b, col_b), inclusive.

        A side that grows gets spare room, the others do not: a long building is not wide.
        Raises InputError if the directory would exceed that of any building: then a pose is wrong.
        """
        end_row = self.first_row + self.directory.shape[0]
        end_col = self.first_col + self.directory.shape[1]
        is_inside = self.first_row <= row_a and self.first_col <= col_a
        if is_inside and row_b < end_row and col_b < end_col:
            return
        farthest = max(-row_a, row_b, -col_a, col_b)
        if farthest > MAX_TILE_INDEX:
            raise InputError(f'map {farthest} tiles from its origin: expected {MAX_TILE_INDEX}')
        rows = _Span(row_a, row_b + 1)
        cols = _Span(col_a, col_b + 1)
        height, width = self._spans()
        taller = height.grown_to(rows)
        wider = width.grown_to(cols)
        limit = self._max_extent_tiles
        if taller.length * wider.length > limit:
            # Unused spare room is given up.
            used_height, used_width = self._used_spans()
            taller = used_height.covering(rows)
            wider = used_width.covering(cols)
        if taller.length * wider.length > limit:
            size = f'{taller.length} x {wider.length}'
            raise InputError(f'map of {size} tiles: expected {limit} at most')
        self._rebuild_directory(taller, wider)

    def _spans(self) -> tuple['_Span', '_Span']:
        """Rows and columns of tiles of the directory."""
        rows, cols = self.directory.shape
        height = _Span(self.first_row, self.first_row + rows)
        width = _Span(self.first_col, self.first_col + cols)
        return height, width

    def _used_spans(self) -> tuple['_Span', '_Span']:
        """Rows and columns of the tiles that exist; those of the directory if there are none."""
        places = self.tile_coordinates()
        if not len(places):
            return self._spans()
        low_row, low_col = places.min(axis=0).tolist()
        high_row, high_col = places.max(axis=0).tolist()
        return _Span(low_row, high_row + 1), _Span(low_col, high_col + 1)

    def _rebuild_directory(self, height: '_Span', width: '_Span') -> None:
        """Rebuild the directory with these rows and columns, which include all existing tiles."""
        found = np.argwhere(self.directory != NO_TILE)
        slots = self.directory[found[:, 0], found[:, 1]]
        at = found + (self.first_row - height.first, self.first_col - width.first)
        self.directory = np.full((height.length, width.length), NO_TILE, dtype=np.int32)
        self.directory[at[:, 0], at[:, 1]] = slots
        self.first_row = height.first
        self.first_col = width.first

    def allocate(self, tiles: Cells) -> None:
        """Allocate the tiles (N, 2), (row, col) in tile coordinates inside the directory.

        New ones are stored in the given order; existing ones are unchanged. Raises InputError if
        there would be more than of any building.
        """
        at = tiles - (self.first_row, self.first_col)
        missing = at[self.directory[at[:, 0], at[:, 1]] == NO_TILE]
        missing = np.array(list(dict.fromkeys(map(tuple, missing.tolist()))), dtype=np.int64)
        missing = missing.reshape(-1, 2)
        used = self.used + len(missing)
        if used > self._max_tiles:
            raise InputError(f'map of {used} tiles: expected {self._max_tiles} at most')
        if used > self.pool.shape[0]:
            least = max(used, self.used + self.used // 2)
            longer = _empty_pool(self.pool.shape[1:], self.pool.dtype, least, self._max_tiles)
            longer[: self.used] = self.pool[: self.used]
            self.pool = longer
        self.directory[missing[:, 0], missing[:, 1]] = np.arange(self.used, used)
        self.used = used

    def __getstate__(self) -> dict[str, Any]:
        """State for copies and pickles, without the unused part of the pool."""
        return {**self.__dict__, 'pool': self.pool[: self.used].copy()}

    def tile_coordinates(self) -> Cells:
        """Tile coordinates (N, 2) as (row, col) of the tiles in the order of their slots."""
        found = np.argwhere(self.directory != NO_TILE)
        order = np.argsort(self.directory[found[:, 0], found[:, 1]])
        return np.asarray(found[order] + (self.first_row, self.first_col), dtype=np.int64)

    def bounds(self) -> Bounds | None:
        """Bounds of the cells of all existing tiles; None if there are none."""
        found = bounds_of(self.directory != NO_TILE)
        if found is None:
            return None
        row, col, end_row, end_col = found
        return (
            (self.first_row + row) * TILE,
            (self.first_col + col) * TILE,
            (self.first_row + end_row) * TILE,
            (self.first_col + end_col) * TILE,
        )

    def read(self, row: int, col: int, rows: int, cols: int) -> NDArray[Any]:
        """Copy of the cells [row, row + rows) x [col, col + cols); 0 where no tile is."""
        cells = np.zeros((rows, cols, *self.pool.shape[3:]), dtype=self.pool.dtype)
        for stored, part in self._parts_within(row, col, rows, cols):
            cells[part] = stored
        return cells

    def write(self, row: int, col: int, cells: NDArray[Any]) -> None:
        """Set the cells from (row, col) on to those given, (H, W, ...)."""
        rows, cols = cells.shape[:2]
        tiles = np.mgrid[
            row // TILE : (row + rows - 1) // TILE + 1, col // TILE : (col + cols - 1) // TILE + 1
        ]
        tiles = tiles.reshape(2, -1).T
        self.grow_to(int(tiles[0, 0]), int(tiles[0, 1]), int(tiles[-1, 0]), int(tiles[-1, 1]))
        self.allocate(tiles)
        self.overwrite(row, col, cells)

    def overwrite(self, row: int, col: int, cells: NDArray[Any], field: str | None = None) -> None:
        """Set those of the cells (H, W, ...) from (row, col) on whose tiles exist, or a field."""
        for stored, part in self._parts_within(row, col, *cells.shape[:2]):
            if field is None:
                stored[:] = cells[part]
            else:
                stored[field] = cells[part]

    def read_tiles(self, tiles: Cells) -> NDArray[Any]:
        """Copy of the tiles (N, 2), (row, col) in tile coordinates; 0 where no tile is."""
        cells = np.zeros((len(tiles), *self.pool.shape[1:]), dtype=self.pool.dtype)
        at = tiles - (self.first_row, self.first_col)
        inside = np.flatnonzero(np.all((at >= 0) & (at < self.directory.shape), axis=1))
        slots = self.directory[at[inside, 0], at[inside, 1]]
        exist = slots != NO_TILE
        cells[inside[exist]] = self.pool[slots[exist]]
        return cells

    def write_tiles(self, tiles: Cells, cells: NDArray[Any]) -> None:
        """Set the tiles (N, 2), (row, col) in tile coordinates, to cells (N, TILE, TILE, ...)."""
        low_row, low_col = tiles.min(axis=0).tolist()
        high_row, high_col = tiles.max(axis=0).tolist()
        self.grow_to(low_row, low_col, high_row, high_col)
        self.allocate(tiles)
        at = tiles - (self.first_row, self.first_col)
        self.pool[self.directory[at[:, 0], at[:, 1]]] = cells

    def _parts_within(
        self, row: int, col: int, rows: int, cols: int
    ) -> Iterator[tuple[NDArray[Any], tuple[slice, slice]]]:
        """Part of each existing tile in a rectangle of cells, a view, and where it lies there."""
        origin = (self.first_row, self.first_col)
        low = np.maximum(np.array([row, col]) // TILE - origin, 0)
        end = np.array([row + rows - 1, col + cols - 1]) // TILE - origin + 1
        part = self.directory[low[0] : max(end[0], 0), low[1] : max(end[1], 0)]
        found = np.argwhere(part != NO_TILE)
        corners = (found + low + origin) * TILE - (row, col)
        for slot, (top, left) in zip(part[tuple(found.T)], corners.tolist(), strict=True):
            here = (slice(max(top, 0), top + TILE), slice(max(left, 0), left + TILE))
            yield self.pool[slot, max(-top, 0) : rows - top, max(-left, 0) : cols - left], here


def _empty_pool(
    tile: tuple[int, ...], dtype: DTypeLike, least: int, max_tiles: int
) -> NDArray[Any]:
    """Zeros (N, *tile) with room for the largest map.

    If the address space of the process is limited, or the system refuses that much: room for
    `least` tiles.
    """
    if resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY:
        with suppress(OSError):
            return _sparse_zeros((max_tiles, *tile), np.dtype(dtype))
    return np.zeros((least, *tile), dtype=dtype)


def _sparse_zeros(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Zeros that need memory only where they are written; raises OSError if the system refuses.

    NumPy asks for pages of 2 MB, of which a surface in one cell of a wall would take a whole one.
    """
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_NORESERVE
    memory = mmap.mmap(-1, math.prod(shape) * dtype.itemsize, flags=flags)
    memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory, dtype).reshape(shape)
