"""Local copy of the grid of another node, assembled from published patches."""

import numpy as np

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.grid.tiles import MAX_CELLS


class MapMirror:
    """The newest whole map, with newer windows pasted over it.

    The lattice of all patches must be the same.
    """

    def __init__(self) -> None:
        self.patch: GridPatch | None = None

    def replace(self, whole: GridPatch) -> None:
        """Replace the copy by a whole map."""
        self.patch = whole

    def paste(self, window: GridPatch) -> GridPatch:
        """Paste a window into the copy, enlarging it if necessary; returns the result.

        Raises InputError if the window is not aligned with the cells of the map, or far from it.
        """
        if self.patch is None:
            self.patch = window
            return window
        row, col = _offset(self.patch, window)
        rows, cols = window.shape
        if (
            max(-row - rows, row - self.patch.shape[0]) > rows
            or max(-col - cols, col - self.patch.shape[1]) > cols
        ):
            raise InputError(
                f'map window at {window.frame}: expected it on or beside the map '
                f'at {self.patch.frame}'
            )
        rows_in_all = max(row + rows, self.patch.shape[0]) - min(row, 0)
        cols_in_all = max(col + cols, self.patch.shape[1]) - min(col, 0)
        if rows_in_all * cols_in_all > MAX_CELLS:
            raise InputError(
                f'map window at {window.frame}: a map of {rows_in_all} x {cols_in_all} cells: '
                f'expected {MAX_CELLS} at most'
            )
        before = (max(-row, 0), max(-col, 0))
        after = (max(row + rows - self.patch.shape[0], 0), max(col + cols - self.patch.shape[1], 0))
        cells = np.pad(
            self.patch.cells,
            ((before[0], after[0]), (before[1], after[1])),
            constant_values=UNKNOWN,
        )
        row = row + before[0]
        col = col + before[1]
        cells[row : row + rows, col : col + cols] = window.cells
        self.patch = GridPatch(self.patch.frame.with_origin_at(-before[0], -before[1]), cells)
        return self.patch


def _offset(whole: GridPatch, window: GridPatch) -> tuple[int, int]:
    """Row and column of the window's first cell in the whole map."""
    resolution = whole.frame.resolution
    col = (window.frame.origin_x - whole.frame.origin_x) / resolution
    row = (window.frame.origin_y - whole.frame.origin_y) / resolution
    on_lattice = abs(col - round(col)) < 0.01 and abs(row - round(row)) < 0.01
    if abs(window.frame.resolution - resolution) > 1e-6 or not on_lattice:
        raise InputError(
            f'map window at {window.frame}: expected cells on the lattice of {whole.frame}'
        )
    return round(row), round(col)
