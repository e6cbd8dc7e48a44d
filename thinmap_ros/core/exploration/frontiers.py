"""Frontiers of the whole map: where known free space ends although nothing stands there.

A frontier cell is a free cell with an unknown cell above, below, left or right. Cells are found
again only where a scan can have changed the map. A single missing beam makes a frontier, too, so
only clusters of some length count.
Source: Yamauchi, "A frontier-based approach for autonomous exploration", 1997.
"""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import FREE_AT_MOST, OCCUPIED_AT_LEAST, GridPatch
from thinmap_ros.core.planning.traversability import Part
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.config import TopologyConfig
from thinmap_ros.core.topology.free_space import known_free, true_cells
from thinmap_ros.jit import kernel

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
Place = tuple[float, float]
NOTHING: Part = (0, 0, 0, 0)
_GAPS = TopologyConfig()
_SPARE_CELLS = 64  # of room when the map grows: users of these arrays start again when they do
_MARGIN_CELLS = 3  # read beyond those that are written, so that the cut is no frontier
_UPDATES_PER_WHOLE_MAP = 100  # corrections of the map reach cells that no scan can change
_MAX_CELLS = 1 << 28


class FrontierMap:
    """Frontier cells of the whole map, updated where a scan can have changed it.

    free (H, W): known free cells, small gaps closed; passable (H, W): all but occupied cells; mask
    (H, W): frontier cells; all on the cells of `frame`, which holds the map and some room for it to
    grow. free_cells: how many are free.
    """

    def __init__(self) -> None:
        self._updates = 0
        self._changed: Part | None = None
        self._zeros = np.zeros(0, dtype=np.int32)
        self._clear(GridFrame(0.0, 0.0, 1.0))

    @property
    def known_area_m2(self) -> float:
        """Known free area."""
        return self.free_cells * self.frame.resolution**2

    def update(self, patch: GridPatch, *boxes: Array) -> None:
        """Find the frontier cells of the whole map in some boxes; now and then everywhere.

        boxes (2, 2): lower left and upper right corner, m, of what a scan (visibility.box_of_scan)
        or another robot has changed.
        """
        whole = patch.is_replaced or self._updates % _UPDATES_PER_WHOLE_MAP == 0
        self._updates += 1
        row, col = self._fit(patch)
        if patch.is_replaced:
            self._clear_outside(row, col, patch.shape)
        everything = (slice(0, patch.shape[0]), slice(0, patch.shape[1]))
        parts = [everything] if whole else [_part(patch, box) for box in boxes]
        for part in parts:
            self._update_part(patch, part, (row, col))

    def _update_part(
        self, patch: GridPatch, part: tuple[slice, slice], place: tuple[int, int]
    ) -> None:
        """Find the frontier cells in rows and columns of a map, whose first cell is at a place."""
        rows, cols = part
        row, col = place
        wide = (
            slice(max(rows.start - _MARGIN_CELLS, 0), rows.stop + _MARGIN_CELLS),
            slice(max(cols.start - _MARGIN_CELLS, 0), cols.stop + _MARGIN_CELLS),
        )
        cut = GridPatch(patch.frame, np.ascontiguousarray(patch.cells[wide]))
        inner = (
            rows.start - wide[0].start,
            rows.stop - wide[0].start,
            cols.start - wide[1].start,
            cols.stop - wide[1].start,
        )
        self._mark_changed((rows.start + row, cols.start + col, rows.stop + row, cols.stop + col))
        self.free_cells += _update(
            cut.cells,
            known_free(cut, _GAPS),
            inner,
            (wide[0].start + row, wide[1].start + col),
            self.free,
            self.passable,
            self.mask,
        )

    def take_changes(self) -> Part | None:
        """Part in which cells may have changed since the last call; None: everywhere."""
        changed = self._changed
        self._changed = NOTHING
        return changed

    def clusters(self, min_length_m: float) -> list[Cells]:
        """Frontier cells (N, 2) of each cluster that is long enough, in the order of first cells.

        Cells of a cluster are joined over edges and corners.
        """
        cells = true_cells(self.mask)
        numbers, sizes = _clusters(self.mask.shape, cells, self._indices())
        cells = cells[np.argsort(numbers, kind='stable')]
        ends = np.cumsum(sizes).tolist()
        return [
            cells[end - size : end]
            for end, size in zip(ends, sizes.tolist(), strict=True)
            if self.is_long(size, min_length_m)
        ]

    def is_long(self, cell_count: int, min_length_m: float) -> bool:
        """Whether a number of cells is at least so long; a cell counts as its edge."""
        return cell_count > 0 and cell_count * self.frame.resolution >= min_length_m - 1e-6

    def remaining(self, cells: Cells) -> int:
        """How many of some cells (N, 2) are still frontier cells."""
        return int(np.count_nonzero(self.mask[cells[:, 0], cells[:, 1]]))

    def middle_of(self, cells: Cells) -> Place:
        """Centre, m, of the cell of a cluster (N, 2) nearest to its centroid."""
        row, col = _middle(cells)
        frame = self.frame
        return (
            frame.origin_x + (col + 0.5) * frame.resolution,
            frame.origin_y + (row + 0.5) * frame.resolution,
        )

    def _indices(self) -> NDArray[np.int32]:
        """Zeros for each cell and a margin of one cell, kept: a map has few frontier cells."""
        size = (self.mask.shape[0] + 2) * (self.mask.shape[1] + 2)
        if self._zeros.size != size:
            self._zeros = np.zeros(size, dtype=np.int32)
        return self._zeros

    def _mark_changed(self, part: Part) -> None:
        if self._changed == NOTHING:
            self._changed = part
        elif self._changed is not None:
            a = self._changed
            self._changed = (
                min(a[0], part[0]),
                min(a[1], part[1]),
                max(a[2], part[2]),
                max(a[3], part[3]),
            )

    def _clear(self, frame: GridFrame) -> None:
        """Forget all cells; the next ones lie on a frame."""
        self.frame = frame
        self.free_cells = 0
        self.free: Mask = np.zeros((0, 0), dtype=np.bool_)
        self.mask: Mask = np.zeros((0, 0), dtype=np.bool_)
        self.passable: Mask = np.ones((0, 0), dtype=np.bool_)
        self._changed = None

    def _clear_outside(self, row: int, col: int, shape: tuple[int, int]) -> None:
        """Make all cells unknown that lie outside a map: it may have become smaller."""
        outside = np.ones(self.free.shape, dtype=np.bool_)
        outside[row : row + shape[0], col : col + shape[1]] = False
        gone = int(np.count_nonzero(self.free & outside))
        if gone == 0 and not (self.mask & outside).any() and self.passable[outside].all():
            return
        self.free[outside] = False
        self.mask[outside] = False
        self.passable[outside] = True
        self.free_cells -= gone
        self._changed = None

    def _fit(self, patch: GridPatch) -> tuple[int, int]:
        """Make room for a patch; returns its first cell (row, col) in these arrays."""
        if self.mask.size == 0 or not self._has_room_for(patch):
            self._clear(patch.frame)
        resolution = self.frame.resolution
        row = round((patch.frame.origin_y - self.frame.origin_y) / resolution)
        col = round((patch.frame.origin_x - self.frame.origin_x) / resolution)
        (top, bottom), (left, right) = (
            (max(-first, 0), max(first + size - have, 0))
            for first, size, have in zip((row, col), patch.shape, self.mask.shape, strict=True)
        )
        if not (top or bottom or left or right):
            return row, col
        spare = _SPARE_CELLS if self.mask.size else 0
        more = tuple(
            (low and low + spare, high and high + spare)
            for low, high in ((top, bottom), (left, right))
        )
        self.free = np.pad(self.free, more)
        self.passable = np.pad(self.passable, more, constant_values=True)
        self.mask = np.pad(self.mask, more)
        self.frame = self.frame.with_origin_at(-more[0][0], -more[1][0])
        self._changed = None
        return row + more[0][0], col + more[1][0]

    def _has_room_for(self, patch: GridPatch) -> bool:
        """Whether a map has cells of this size, and near these."""
        frame = self.frame
        if patch.frame.resolution != frame.resolution:
            return False
        x = (patch.frame.origin_x - frame.origin_x) / frame.resolution
        y = (patch.frame.origin_y - frame.origin_y) / frame.resolution
        rows, cols = (
            max(first + size, have) - min(first, 0.0) + 2 * _SPARE_CELLS
            for first, size, have in zip((y, x), patch.shape, self.mask.shape, strict=True)
        )
        return bool(rows * cols <= _MAX_CELLS)


def _part(patch: GridPatch, box: Array) -> tuple[slice, slice]:
    """Rows and columns of a map that lie in a box (2, 2), m."""
    frame = patch.frame
    rows, cols = patch.shape
    (left, top), (right, bottom) = (
        (
            math.floor((x - frame.origin_x) / frame.resolution),
            math.floor((y - frame.origin_y) / frame.resolution),
        )
        for x, y in box.tolist()
    )
    top = min(max(top, 0), rows)
    left = min(max(left, 0), cols)
    return slice(top, max(min(bottom + 1, rows), top)), slice(left, max(min(right + 1, cols), left))


@kernel
def _update(
    cells: NDArray[np.int8],
    known: Mask,
    inner: tuple[int, int, int, int],
    offset: tuple[int, int],
    free: Mask,
    passable: Mask,
    mask: Mask,
) -> int:
    """Write a part of a map (H, W) and its frontier cells; returns how many more cells are free.

    known (H, W): its free cells; inner: first row, row after the last, and the same of columns, of
    what is written; offset: row and column at which the part begins in free, passable and mask.
    Cells outside of the part count as unknown.
    """
    rows, cols = cells.shape
    more = 0
    for row in range(inner[0], inner[1]):
        for col in range(inner[2], inner[3]):
            r = row + offset[0]
            c = col + offset[1]
            is_frontier = False
            if known[row, col]:
                for side in range(4):
                    y = row + (side == 0) - (side == 1)
                    x = col + (side == 2) - (side == 3)
                    if not (0 <= y < rows and 0 <= x < cols):
                        is_frontier = True
                    elif not known[y, x]:
                        is_frontier |= (
                            cells[y, x] < 0 or FREE_AT_MOST < cells[y, x] < OCCUPIED_AT_LEAST
                        )
            more += int(known[row, col]) - int(free[r, c])
            free[r, c] = known[row, col]
            mask[r, c] = is_frontier
            passable[r, c] = cells[row, col] < OCCUPIED_AT_LEAST
    return more


@kernel
def _middle(cells: Cells) -> tuple[int, int]:
    """Cell of a cluster (N, 2) nearest to its centroid."""
    row = cells[:, 0].sum() / cells.shape[0]
    col = cells[:, 1].sum() / cells.shape[0]
    best = 0
    nearest = math.inf
    for i in range(cells.shape[0]):
        away = (cells[i, 0] - row) ** 2 + (cells[i, 1] - col) ** 2
        if away < nearest:
            nearest = away
            best = i
    return cells[best, 0], cells[best, 1]


@kernel
def _clusters(
    shape: tuple[int, int], cells: Cells, at: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number of the cluster of each cell (N, 2) of an array, (N,), and the size of each cluster.

    at: zeros for the array with a margin of one cell; they are zeros again afterwards.
    """
    cols = shape[1] + 2
    # Index + 1 of the cell that lies there; the empty margin makes bounds checks unnecessary.
    places = (cells[:, 0] + 1) * cols + cells[:, 1] + 1
    for i in range(places.size):
        at[places[i]] = i + 1
    numbers = np.full(places.size, -1, dtype=np.int64)
    sizes = np.zeros(places.size, dtype=np.int64)
    stack = np.empty(places.size, dtype=np.int64)
    clusters = 0
    for first in range(places.size):
        if numbers[first] >= 0:
            continue
        numbers[first] = clusters
        stack[0] = first
        count = 1
        while count > 0:
            count -= 1
            here = places[stack[count]]
            sizes[clusters] += 1
            for to in (-cols - 1, -cols, -cols + 1, -1, 1, cols - 1, cols, cols + 1):
                i = at[here + to] - 1
                if i >= 0 and numbers[i] < 0:
                    numbers[i] = clusters
                    stack[count] = i
                    count += 1
        clusters += 1
    for place in places:
        at[place] = 0
    return numbers, sizes[:clusters].copy()
