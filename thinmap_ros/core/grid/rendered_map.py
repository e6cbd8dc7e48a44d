"""Occupancy of a whole grid in percent, updated only where the grid has changed."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import UNKNOWN, Bounds, GridFrame, GridPatch, bounds_of, union
from thinmap_ros.core.grid.tiles import TileStore

_BAND_ROWS = 256  # rendered at once: a large map needs little more memory than its cells


class RenderedMap:
    """Cells (H, W) int8 of all tiles, with the outdated part and the bounds of the known cells."""

    def __init__(self, percent: NDArray[np.int8]) -> None:
        """Start empty; percent (2 L + 1,): occupancy in percent for log odds from -L to L."""
        self._percent = percent
        self._cells: NDArray[np.int8] = np.empty((0, 0), dtype=np.int8)
        self._bounds: Bounds = (0, 0, 0, 0)
        self._known: Bounds | None = None
        self._stale: Bounds | None = None
        self._patch: GridPatch | None = None  # the newest copy, until a cell is outdated

    def mark_dirty(self, row: int, col: int, end_row: int, end_col: int) -> None:
        """Mark cells [row, end_row) x [col, end_col) as outdated."""
        self._stale = _union(self._stale, (row, col, end_row, end_col))
        self._patch = None

    def render(self, tiles: TileStore, frame: GridFrame) -> GridPatch:
        """Bounding rectangle of the known cells; one unknown cell if there are none.

        A copy, which is the same object as long as no cell is outdated, and read-only.
        """
        if self._patch is None:
            self._patch = self._copy(tiles, frame)
            self._patch.cells.flags.writeable = False
        return self._patch

    def _copy(self, tiles: TileStore, frame: GridFrame) -> GridPatch:
        self._enlarge(tiles)
        if self._stale is not None:
            row, col, end_row, end_col = _intersection(self._stale, self._bounds)
            for top in range(row, end_row, _BAND_ROWS):
                self._refresh(tiles, top, col, min(top + _BAND_ROWS, end_row), end_col)
            self._stale = None
        if self._known is None:
            return GridPatch(frame, np.full((1, 1), UNKNOWN, dtype=np.int8))
        row, col, end_row, end_col = self._known
        top, left = self._bounds[:2]
        shown = self._cells[row - top : end_row - top, col - left : end_col - left]
        return GridPatch(frame.with_origin_at(row, col), shown.copy())

    def _enlarge(self, tiles: TileStore) -> None:
        """Enlarge the cells if tiles have been added outside of them."""
        bounds = tiles.bounds()
        if bounds is None or bounds == self._bounds:
            return
        cells = np.full((bounds[2] - bounds[0], bounds[3] - bounds[1]), UNKNOWN, dtype=np.int8)
        row = self._bounds[0] - bounds[0]
        col = self._bounds[1] - bounds[1]
        if self._cells.size:
            cells[row : row + self._cells.shape[0], col : col + self._cells.shape[1]] = self._cells
        self._cells = cells
        self._bounds = bounds

    def _refresh(self, tiles: TileStore, row: int, col: int, end_row: int, end_col: int) -> None:
        if end_col <= col:
            return  # beyond all tiles
        odds = tiles.read(row, col, end_row - row, end_col - col)
        top, left = self._bounds[:2]
        shown = self._percent[odds.astype(np.intp) + self._percent.size // 2]
        self._cells[row - top : end_row - top, col - left : end_col - left] = shown
        known = bounds_of(shown != UNKNOWN)
        if known is not None:
            # Known cells stay known: the rectangle only grows.
            found = (row + known[0], col + known[1], row + known[2], col + known[3])
            self._known = _union(self._known, found)


def _union(a: Bounds | None, b: Bounds) -> Bounds:
    return b if a is None else union(a, b)


def _intersection(a: Bounds, b: Bounds) -> Bounds:
    return max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])
