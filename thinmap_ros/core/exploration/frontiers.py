"""Frontiers of the whole map: where known free space ends although nothing stands there.

A frontier cell is a free cell with an unknown cell above, below, left or right. Cells are found
again only where a scan can have changed the map. A single missing beam makes a frontier, too, so
only clusters of some length count.
Source: Yamauchi, "A frontier-based approach for autonomous exploration", 1997.
"""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import Bounds, GridFrame, GridPatch, union
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.thinning import known_free, true_cells
from thinmap_ros.jit import kernel

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
Place = tuple[float, float]
NOTHING: Bounds = (0, 0, 0, 0)
_GAPS = TopologyConfig()
_SPARE_CELLS = 64  # of room on each side: where it is used up, all is rebuilt
_MARGIN_CELLS = 3  # read beyond those that are written, so that the cut is no frontier
_UPDATES_PER_WHOLE_MAP = 100  # corrections of the map reach cells that no scan can change


class FrontierMap:
    """Frontier cells of the whole map, updated where a scan can have changed it.

    free (H, W): known free cells, small gaps closed; passable (H, W): all but occupied cells; mask
    (H, W): frontier cells; all on the cells of `frame`, which holds the map and some room for it to
    grow. free_cells: how many are free.
    """

    def __init__(self) -> None:
        self._updates = 0
        self._changed: Bounds | None = None
        self._begin(GridPatch(GridFrame(0.0, 0.0, 1.0), np.zeros((0, 0), dtype=np.int8)), 0)

    @property
    def known_area_m2(self) -> float:
        """Known free area."""
        return self.free_cells * self.frame.resolution**2

    def update(self, patch: GridPatch, *boxes: Array) -> None:
        """Find the frontier cells of the whole map in some boxes; now and then everywhere.

        boxes (2, 2): lower left and upper right corner, m, of what a scan (visibility.box_of_scan)
        or another robot has changed. It begins anew where the map has outgrown its room, lies on
        another lattice, or is replaced.
        """
        is_whole = self._updates % _UPDATES_PER_WHOLE_MAP == 0
        self._updates += 1
        if patch.is_replaced or not self._holds(patch):
            has_grown = self.mask.size > 0 and not patch.is_replaced
            self._begin(patch, _SPARE_CELLS if has_grown else 0)
            is_whole = True
        for part in [(0, 0, *patch.shape)] if is_whole else [_part(patch, box) for box in boxes]:
            self._update_part(patch, part)

    def take_changes(self) -> Bounds | None:
        """Part in which cells may have changed since the last call; None: everywhere."""
        changed = self._changed
        self._changed = NOTHING
        return changed

    def _begin(self, patch: GridPatch, spare: int) -> None:
        """Forget all cells; the next ones are those of a map, and spare ones on each side."""
        rows, cols = (size + 2 * spare for size in patch.shape)
        self.frame = patch.frame.with_origin_at(-spare, -spare)
        self.free: Mask = np.zeros((rows, cols), dtype=np.bool_)
        self.mask: Mask = np.zeros((rows, cols), dtype=np.bool_)
        self.passable: Mask = np.ones((rows, cols), dtype=np.bool_)
        self.free_cells = 0
        self._room = GridPatch(self.frame, self.mask.view(np.int8))
        self._changed = None
        # For each cell and a margin of one cell, kept: a map has few frontier cells.
        self._zeros = np.zeros((rows + 2) * (cols + 2), dtype=np.int32)

    def _holds(self, patch: GridPatch) -> bool:
        """Whether all cells of a map are cells of these arrays."""
        return self._room.is_aligned_with(patch) and not any(self._room.overhang_of(patch))

    def _update_part(self, patch: GridPatch, part: Bounds) -> None:
        """Find the frontier cells in a part of a map."""
        top, left, bottom, right = part
        row = max(top - _MARGIN_CELLS, 0)
        col = max(left - _MARGIN_CELLS, 0)
        cut = patch.part((row, col, bottom + _MARGIN_CELLS, right + _MARGIN_CELLS))
        inner = np.s_[top - row : bottom - row, left - col : right - col]
        first_row, first_col = self._room.offset_of(patch)
        to = (top + first_row, left + first_col, bottom + first_row, right + first_col)
        at = np.s_[to[0] : to[2], to[1] : to[3]]
        self._mark_changed(to)
        known = known_free(cut, _GAPS)
        # Cells outside of the map are unknown.
        unknown = np.ones((known.shape[0] + 2, known.shape[1] + 2), dtype=np.bool_)
        unknown[1:-1, 1:-1] = cut.unknown & ~known
        beside = unknown[:-2, 1:-1] | unknown[2:, 1:-1] | unknown[1:-1, :-2] | unknown[1:-1, 2:]
        gone = int(np.count_nonzero(self.free[at]))
        self.free_cells += int(np.count_nonzero(known[inner])) - gone
        self.free[at] = known[inner]
        self.mask[at] = (known & beside)[inner]
        self.passable[at] = ~cut.occupied[inner]

    def _mark_changed(self, part: Bounds) -> None:
        if self._changed == NOTHING:
            self._changed = part
        elif self._changed is not None:
            self._changed = union(self._changed, part)

    def clusters(self, min_length_m: float) -> list[Cells]:
        """Frontier cells (N, 2) of each cluster that is long enough, in the order of first cells.

        Cells of a cluster are joined over edges and corners.
        """
        cells = true_cells(self.mask)
        numbers, sizes = _clusters(self.mask.shape, cells, self._zeros)
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


def _part(patch: GridPatch, box: Array) -> Bounds:
    """Rows and columns of a map that lie in a box (2, 2), m."""
    cells = patch.frame.cells_of(box) + [[0], [1]]
    (top, left), (bottom, right) = np.clip(cells, 0, patch.shape).tolist()
    return top, left, bottom, right


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
