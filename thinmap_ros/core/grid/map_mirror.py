"""Local copy of the grid of another node, assembled from published patches."""

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch
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
