"""Local copy of the map of another node, assembled from what it publishes."""

from collections import deque
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.tiles import MAX_CELLS

# Updates that may be received before the whole map that they follow: those of some seconds.
_MAX_KEPT_UPDATES = 50


class _Update(NamedTuple):
    """Cells from a row and a column of the map on."""

    stamp_ns: int
    row: int
    col: int
    cells: NDArray[np.int8]


class MapReceiver:
    """The newest whole map, with newer updates and windows in it.

    The lattice of all patches must be the same. Whole maps and updates have a topic each, and those
    of one topic may overtake the others: an update is made where it is newer than the whole map, by
    its stamp, also once that comes. Stamps of 0 are unknown: what comes last is the newest.
    """

    def __init__(self) -> None:
        self.patch: GridPatch | None = None
        self._stamp_ns = 0
        self._updates: deque[_Update] = deque(maxlen=_MAX_KEPT_UPDATES)

    def replace(self, whole: GridPatch, stamp_ns: int = 0) -> None:
        """Replace the copy by a whole map."""
        # A stamp from before: time was set back, and updates from then do not follow this map.
        has_begun_anew = stamp_ns < self._stamp_ns
        kept = () if has_begun_anew else tuple(self._updates)
        self._updates.clear()
        self._stamp_ns = stamp_ns
        self.patch = whole
        for update in kept:
            if update.stamp_ns > stamp_ns:
                with suppress(InputError):
                    self.update(*update)

    def update(self, stamp_ns: int, row: int, col: int, cells: NDArray[np.int8]) -> bool:
        """Replace cells (H, W) of the map; returns whether they are newer than the map.

        Raises InputError where they do not lie inside the map: the next whole map has them.
        """
        self._updates.append(_Update(stamp_ns, row, col, cells))
        is_known = 0 < stamp_ns <= self._stamp_ns
        if self.patch is None or is_known:
            return False
        self.patch = self.patch.with_part(row, col, cells)
        return True

    def paste(self, window: GridPatch) -> GridPatch:
        """Paste a window into the copy, enlarging it if necessary; returns the result.

        Raises InputError if the window is not aligned with the cells of the map, or far from it.
        """
        if self.patch is None:
            self.patch = window
            return window
        margins = self.patch.overhang_of(window)
        rows, cols = window.shape
        if max(margins[0], margins[2]) > 2 * rows or max(margins[1], margins[3]) > 2 * cols:
            raise InputError(
                f'map window at {window.frame}: expected it on or beside the map '
                f'at {self.patch.frame}'
            )
        rows_in_all = self.patch.shape[0] + margins[0] + margins[2]
        cols_in_all = self.patch.shape[1] + margins[1] + margins[3]
        if rows_in_all * cols_in_all > MAX_CELLS:
            raise InputError(
                f'map window at {window.frame}: a map of {rows_in_all} x {cols_in_all} cells: '
                f'expected {MAX_CELLS} at most'
            )
        whole = self.patch.padded(margins) if any(margins) else self.patch
        self.patch = whole.with_part(*whole.offset_of(window), window.cells)
        return self.patch
