"""The robot's working memory: the last windows of the grid, on one lattice, in a rectangle that moves along."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.topology.atlas import Box
from thinmap_ros.core.topology.config import TopologyConfig

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
_OFF_LATTICE = 1e-3  # of a cell: windows that lie worse than this do not belong to the same grid


class Surroundings:
    """What the windows of the last places showed, within memory_m round the newest one: bounded, whatever the map.

    Thinning near the rim of a window differs from thinning the whole map. With what lies round the window at hand,
    the skeleton goes on over its rim as it was drawn before.
    """

    def __init__(self, first: GridPatch, config: TopologyConfig) -> None:
        self.lattice = first.frame
        self.margin = round(config.memory_m / first.frame.resolution)
        self._depth = round(config.margin_m / first.frame.resolution)
        self.row, self.col = 0, 0
        self._cells: NDArray[np.int8] = np.full((1, 1), UNKNOWN, dtype=np.int8)
        self._seen: Mask = np.zeros((1, 1), dtype=np.bool_)

    def take(self, window: GridPatch) -> None:
        """Move to a new window and take its cells over.

        Raises InputError where its cells do not lie on those of the first window.
        """
        row, col = self._place_of(window.frame)
        row, col = row - self.margin, col - self.margin
        rows, cols = (size + 2 * self.margin for size in window.shape)
        cells, seen = np.full((rows, cols), UNKNOWN, dtype=np.int8), np.zeros((rows, cols), dtype=np.bool_)
        target, source = _overlap((row, col, rows, cols), (self.row, self.col, *self._cells.shape))
        cells[target], seen[target] = self._cells[source], self._seen[source]
        inner = (slice(self.margin, rows - self.margin), slice(self.margin, cols - self.margin))
        cells[inner], seen[inner] = window.cells, True
        self.row, self.col, self._cells, self._seen = row, col, cells, seen

    @property
    def box(self) -> Box:
        """The cells that are remembered, on the lattice of the first window."""
        return Box(self.row, self.col, *self._cells.shape)

    def redrawn(self, painted: Mask) -> Mask:
        """Where the new skeleton takes the old one's place: the window, away from places known but not remembered.

        painted (H, W): from `patch`. There the new skeleton rests on the outline of the old one only.
        """
        result = np.zeros_like(painted)
        result[self.inner] = True
        if painted.any():
            result &= ~_dilated(_dilated(painted, self._depth).T, self._depth).T
        return result

    @property
    def inner(self) -> tuple[slice, slice]:
        """Where the newest window lies in the box."""
        rows, cols = self._cells.shape
        return (slice(self.margin, rows - self.margin), slice(self.margin, cols - self.margin))

    def patch(self, skeleton: Cells, squared: Cells) -> tuple[GridPatch, Mask]:
        """The remembered cells; where nothing is, what the known skeleton says; and a mask (H, W) of the latter.

        skeleton (N, 2): lattice cells in the box; squared (N,): their squared clearances. All within a cell's
        clearance is free, so the map itself keeps the outline of the places whose cells have been forgotten. Every
        other cell is enough for that.
        """
        cells = self._cells.copy()
        painted = _paint(cells, self._seen, (skeleton - (self.row, self.col))[::2], squared[::2])
        return GridPatch(self.lattice.shifted(self.row, self.col), cells), painted

    def _place_of(self, frame: GridFrame) -> tuple[int, int]:
        if frame.resolution != self.lattice.resolution:
            raise InputError(f'window with {frame.resolution} m a cell: expected {self.lattice.resolution} m')
        row = (frame.origin_y - self.lattice.origin_y) / frame.resolution
        col = (frame.origin_x - self.lattice.origin_x) / frame.resolution
        if abs(row - round(row)) > _OFF_LATTICE or abs(col - round(col)) > _OFF_LATTICE:
            origin = (frame.origin_x, frame.origin_y)
            raise InputError(f'window at {origin}: expected whole cells from the first window of the map')
        return round(row), round(col)


def _overlap(
    new: tuple[int, int, int, int], old: tuple[int, int, int, int]
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of the cells that two rectangles (row, col, rows, cols) share, in the new one and in the old one."""
    target, source = [], []
    for axis in (0, 1):
        low = max(new[axis], old[axis])
        high = max(low, min(new[axis] + new[axis + 2], old[axis] + old[axis + 2]))
        target.append(slice(low - new[axis], high - new[axis]))
        source.append(slice(low - old[axis], high - old[axis]))
    if target[0].start >= target[0].stop or target[1].start >= target[1].stop:
        nothing = (slice(0, 0), slice(0, 0))
        return nothing, nothing
    return (target[0], target[1]), (source[0], source[1])


@kernel
def _paint(cells: NDArray[np.int8], seen: Mask, centres: Cells, squared: Cells) -> Mask:
    """Mark as free all cells never seen that lie nearer to one of the centres (N, 2) than its clearance; say which."""
    rows, cols = cells.shape
    painted = np.zeros((rows, cols), dtype=np.bool_)
    for i in range(centres.shape[0]):
        row, col = centres[i, 0], centres[i, 1]
        reach = int(np.sqrt(squared[i]))
        for r in range(max(row - reach, 0), min(row + reach + 1, rows)):
            for c in range(max(col - reach, 0), min(col + reach + 1, cols)):
                if not seen[r, c] and (r - row) ** 2 + (c - col) ** 2 < squared[i]:
                    cells[r, c] = 0
                    painted[r, c] = True
    return painted


def _dilated(mask: Mask, depth: int) -> Mask:
    """Cells with a true one within `depth` rows above or below."""
    rows = mask.shape[0]
    sums = np.zeros((rows + 2 * depth + 1, mask.shape[1]), dtype=np.int32)
    np.cumsum(mask, axis=0, out=sums[depth + 1 : depth + 1 + rows])
    sums[depth + 1 + rows :] = sums[depth + rows]
    near: Mask = sums[2 * depth + 1 :] > sums[:rows]
    return near
