"""Where known free space ends although nothing stands there.

It is what is left to see, kept up to date scan by scan.

A border cell is a free cell beside (over an edge) one that is unknown. A single missing beam makes
one too, so only borders of some length count. A border is *exhausted* when it has been looked at
closely and stayed: no laser sees more of it. Border cells belong to the nearest end node in sight
of them; those that no end node sees are left over.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.exploration.viewpoints import place_at, place_for, shows_enough
from thinmap_ros.core.grid.frame import MAX_RESOLUTION_M, MIN_RESOLUTION_M, GridFrame
from thinmap_ros.core.grid.patch import FREE_AT_MOST, OCCUPIED_AT_LEAST, GridPatch
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.planning.traversability import Part
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, Field
from thinmap_ros.core.topology.config import TopologyConfig
from thinmap_ros.core.topology.free_space import known_free, true_cells

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
_TOPOLOGY = TopologyConfig()
_LOOKS = 3
_SPARE = 64
_WHOLE_EVERY = 100
_PART_M = 1.0
_MARGIN = 3
NOTHING = (0, 0, 0, 0)
_MOST_CELLS = 1 << 28  # of a map with the room to grow
FIELDS = {
    'frame': Field(
        np.float64,
        (3,),
        (-MAX_COORDINATE_M, -MAX_COORDINATE_M, MIN_RESOLUTION_M),
        (MAX_COORDINATE_M, MAX_COORDINATE_M, MAX_RESOLUTION_M),
    ),
    'looks': Field(np.uint8, ('rows', 'cols'), 0, _LOOKS),
}


class OpenBorders:
    """The border cells of the whole map; only what a scan can have changed is looked at again.

    free (H, W): known free cells, small gaps closed; passable (H, W): all but occupied ones;
    mask (H, W): open border cells; all on the cells of `frame`, which holds the map and some room
    for it to grow. revision: rises whenever they change; known_cells: how many are free; changed:
    the part in which free and passable may have changed since somebody set it to NOTHING, None
    where that is everywhere.
    """

    def __init__(self, shortest_m: float) -> None:
        self._shortest_m = shortest_m
        self.frame = GridFrame(0.0, 0.0, 1.0)
        self.revision = self.known_cells = self._updates = 0
        self.free: Mask = np.zeros((0, 0), dtype=np.bool_)
        self.mask: Mask = np.zeros((0, 0), dtype=np.bool_)
        self.passable: Mask = np.ones((0, 0), dtype=np.bool_)
        self.changed: Part | None = None
        self._looks: NDArray[np.uint8] = np.zeros((0, 0), dtype=np.uint8)

    def state(self) -> dict[str, NDArray[Any]]:
        """What a map does not tell, as arrays by name.

        It is how often each border cell was looked at closely.
        """
        return {'frame': self.frame.as_array(), 'looks': self._looks}

    @staticmethod
    def from_state(state: Mapping[str, NDArray[Any]], shortest_m: float) -> 'OpenBorders':
        """Borders that go on from the `state` of others, on a map of their lattice.

        state: checked by FIELDS.
        """
        borders = OpenBorders(shortest_m)
        origin_x, origin_y, resolution = state['frame'].tolist()
        looks = state['looks']
        rows, cols = looks.shape
        borders.frame = GridFrame(origin_x, origin_y, resolution)
        borders._looks = looks
        borders.free, borders.mask = (np.zeros((rows, cols), dtype=np.bool_) for _ in range(2))
        borders.passable = np.ones((rows, cols), dtype=np.bool_)
        return borders

    def update(self, patch: GridPatch, box: Array) -> None:
        """Find the borders of a map anew in a box, the first time and now and then everywhere.

        box (2, 2): its lower left and upper right corner, m (see field_of_view.box_of_scan).
        Other cells change only where the map was corrected, or is replaced by another one.
        """
        whole = patch.is_replaced or self._updates % _WHOLE_EVERY == 0
        self._updates += 1
        row, col = self._fit(patch)
        if patch.is_replaced:
            self._clear_outside(row, col, patch.shape)
        rows, cols = (slice(0, size) for size in patch.shape) if whole else _part(patch, box)
        # A few cells more are read than written, so that the cut is no border.
        wide = (
            slice(max(rows.start - _MARGIN, 0), rows.stop + _MARGIN),
            slice(max(cols.start - _MARGIN, 0), cols.stop + _MARGIN),
        )
        part = GridPatch(patch.frame, np.ascontiguousarray(patch.cells[wide]))
        inner = (
            rows.start - wide[0].start,
            rows.stop - wide[0].start,
            cols.start - wide[1].start,
            cols.stop - wide[1].start,
        )
        offset = (wide[0].start + row, wide[1].start + col)
        if self.changed is not None:
            written = (rows.start + row, cols.start + col, rows.stop + row, cols.stop + col)
            self.changed = written if self.changed == NOTHING else _both(self.changed, written)
        free = known_free(part, _TOPOLOGY)
        changed, more = _renew(
            part.cells, free, inner, offset, self.free, self.passable, self.mask, self._looks
        )
        self.revision = self.revision + changed
        self.known_cells = self.known_cells + more

    def examine(self, xy: tuple[float, float], reach_m: float, faces: NDArray[np.float64]) -> None:
        """Count a close look from a point, m.

        It counts for border cells whose unknown neighbour lies in plain sight, yet unknown.
        faces (2,): first and last direction of view in the map frame, rad. After some such looks a
        cell is exhausted.
        """
        row, col = self._cell_of(xy)
        reach = reach_m / self.frame.resolution
        self.revision += _examine(self.mask, self.free, self._looks, row, col, reach, faces)

    def exhaust(self, cells: Cells, xy: tuple[float, float]) -> None:
        """Give up border cells (N, 2) for good.

        Only those about as near to a point, m, as the nearest of them are given up.
        A long border is seen from one place in part only.
        """
        away_m = np.hypot(*(self.frame.centres_of(cells) - xy).T)
        gone = cells[away_m <= away_m.min(initial=np.inf) + _PART_M]
        self._looks[gone[:, 0], gone[:, 1]] = _LOOKS
        self.mask[gone[:, 0], gone[:, 1]] = False
        self.revision += 1

    def stretches(self) -> tuple[Cells, Cells, int]:
        """Border cells (N, 2) in stretches long enough, their numbers (N,), and how many there are.

        Stretches are joined over edges and corners, and numbered in the order of their first cells.
        """
        cells = true_cells(self.mask)
        numbers, sizes = _parts(self.mask.shape, cells)
        long_enough = sizes * self.frame.resolution >= self._shortest_m - 1e-6
        keep = long_enough[numbers]
        return cells[keep], numbers[keep], int(long_enough.sum())

    def owners(self, cells: Cells, nodes: Cells, reach_m: float) -> Cells:
        """Index of the node (M, 2) in sight within reach_m nearest to each cell (N, 2), or -1."""
        return np.asarray(_owners(self.free, cells, nodes, reach_m / self.frame.resolution))

    def place_to_look(
        self, cells: Cells, allowed: Mask, reach_m: float, xy: tuple[float, float]
    ) -> Array | None:
        """Centre (2,), m, of the allowed cell (H, W) right at a border (N, 2).

        See viewpoints.place_at.
        """
        return self._centre_of(
            place_at(
                self.free, cells, allowed, int(reach_m / self.frame.resolution), self._cell_of(xy)
            )
        )

    def place_to_view(
        self, cells: Cells, allowed: Mask, ways: Array, reach_m: float, depth_m: float
    ) -> Array | None:
        """Centre (2,), m, of the allowed cell (H, W) from which to see behind a border (N, 2).

        See viewpoints.place_for.
        ways (h, w): length of the way to each square of allowed cells; depth_m: how far behind the
        border is looked.
        """
        resolution = self.frame.resolution
        depth = round(depth_m / resolution)
        reach = reach_m / resolution
        return self._centre_of(
            place_for(self.free, self.passable, cells, allowed, ways, depth, reach)
        )

    def shows_enough(self, cells: Cells, place: Array, reach_m: float, depth_m: float) -> bool:
        """Whether a place (2,), m, is one from which to see behind a border (N, 2).

        See viewpoints.shows_enough.
        """
        resolution = self.frame.resolution
        depth = round(depth_m / resolution)
        reach = reach_m / resolution
        cell = self._cell_of((float(place[0]), float(place[1])))
        return shows_enough(self.free, self.passable, cells, cell, depth, reach)

    def _has_room_for(self, patch: GridPatch) -> bool:
        """Whether a map has cells of this size, and near these: saved ones may be of elsewhere."""
        frame = self.frame
        x = (patch.frame.origin_x - frame.origin_x) / frame.resolution
        y = (patch.frame.origin_y - frame.origin_y) / frame.resolution
        if patch.frame.resolution != frame.resolution:
            return False
        rows, cols = (
            max(first + size, have) - min(first, 0.0) + 2 * _SPARE
            for first, size, have in zip((y, x), patch.shape, self.mask.shape, strict=True)
        )
        return bool(rows * cols <= _MOST_CELLS)

    def _clear(self, frame: GridFrame) -> None:
        """Begin with nothing, on the cells of a frame."""
        self.frame = frame
        self.changed = None
        self.known_cells = 0
        self.free = np.zeros((0, 0), dtype=np.bool_)
        self.mask = np.zeros((0, 0), dtype=np.bool_)
        self.passable = np.ones((0, 0), dtype=np.bool_)
        self._looks = np.zeros((0, 0), dtype=np.uint8)

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
        self.known_cells -= gone
        self.revision += 1
        self.changed = None

    def _cell_of(self, xy: tuple[float, float]) -> tuple[int, int]:
        """Cell (row, col) that holds a point, m."""
        frame = self.frame
        row = (xy[1] - frame.origin_y) / frame.resolution
        col = (xy[0] - frame.origin_x) / frame.resolution
        return math.floor(row), math.floor(col)

    def _centre_of(self, cell: tuple[int, int] | None) -> Array | None:
        """Point (2,), m, in the middle of a cell (row, col)."""
        if cell is None:
            return None
        x = self.frame.origin_x
        y = self.frame.origin_y
        resolution = self.frame.resolution
        return np.array([(cell[1] + 0.5) * resolution + x, (cell[0] + 0.5) * resolution + y])

    def _fit(self, patch: GridPatch) -> tuple[int, int]:
        """Make room for a patch where there is none; returns where its first cell lies, (row, col).

        Once there is a map, more room is made than is needed: what looks at these arrays does so
        anew when they grow.
        """
        if self.mask.size == 0 or not self._has_room_for(patch):
            self._clear(patch.frame)
        resolution = self.frame.resolution
        row = round((patch.frame.origin_y - self.frame.origin_y) / resolution)
        col = round((patch.frame.origin_x - self.frame.origin_x) / resolution)
        (top, bottom), (left, right) = (
            (max(-first, 0), max(first + size - have, 0))
            for first, size, have in zip((row, col), patch.shape, self.mask.shape, strict=True)
        )
        if top or bottom or left or right:
            spare = _SPARE if self.mask.size else 0
            more = tuple(
                (low and low + spare, high and high + spare)
                for low, high in ((top, bottom), (left, right))
            )
            self.free = np.pad(self.free, more)
            self.passable = np.pad(self.passable, more, constant_values=True)
            self.mask = np.pad(self.mask, more)
            self._looks = np.pad(self._looks, more)
            self.frame = self.frame.with_origin_at(-more[0][0], -more[1][0])
            self.changed = None
            row = row + more[0][0]
            col = col + more[1][0]
        return row, col


def _both(a: Part, b: Part) -> Part:
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def _part(patch: GridPatch, box: Array) -> tuple[slice, slice]:
    """Rows and columns of a map that lie in a box."""
    frame = patch.frame
    (rows, cols) = patch.shape
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
def _renew(
    cells: NDArray[np.int8],
    known: Mask,
    inner: tuple[int, int, int, int],
    offset: tuple[int, int],
    free: Mask,
    passable: Mask,
    mask: Mask,
    looks: NDArray[np.uint8],
) -> tuple[bool, int]:
    """Take over a part of a map (H, W) and find its borders.

    Returns whether what is free or border has changed, and how many more cells are free.
    known (H, W): which cells are free; inner: first row, row after the last, and the same of
    columns, of what is written to free, passable, mask and looks, in which the part begins at row
    and column `offset`. A border is a free cell with an unknown one above, below, left or right;
    what lies outside of the part is unknown.
    """
    rows, cols = cells.shape
    changed = False
    more = 0
    for row in range(inner[0], inner[1]):
        for col in range(inner[2], inner[3]):
            r = row + offset[0]
            c = col + offset[1]
            border = False
            if known[row, col] and looks[r, c] < _LOOKS:
                for side in range(4):
                    y = row + (side == 0) - (side == 1)
                    x = col + (side == 2) - (side == 3)
                    if not (0 <= y < rows and 0 <= x < cols):
                        border = True
                    elif not known[y, x]:
                        border |= cells[y, x] < 0 or FREE_AT_MOST < cells[y, x] < OCCUPIED_AT_LEAST
            changed |= known[row, col] != free[r, c] or border != mask[r, c]
            more += int(known[row, col]) - int(free[r, c])
            free[r, c] = known[row, col]
            mask[r, c] = border
            passable[r, c] = cells[row, col] < OCCUPIED_AT_LEAST
    return changed, more


@kernel
def _parts(shape: tuple[int, int], cells: Cells) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number of the part (joined over edges and corners) of each cell (N, 2) of an array, (N,).

    Also how many cells are in each part.
    """
    cols = shape[1] + 2
    # Index + 1 of the cell that lies there; the empty border saves all questions about the rim.
    at = np.zeros((shape[0] + 2) * cols, dtype=np.int32)
    places = (cells[:, 0] + 1) * cols + cells[:, 1] + 1
    for i in range(places.size):
        at[places[i]] = i + 1
    numbers = np.full(places.size, -1, dtype=np.int64)
    sizes = np.zeros(places.size, dtype=np.int64)
    stack = np.empty(places.size, dtype=np.int64)
    parts = 0
    for first in range(places.size):
        if numbers[first] >= 0:
            continue
        numbers[first] = parts
        stack[0] = first
        count = 1
        while count > 0:
            count -= 1
            here = places[stack[count]]
            sizes[parts] += 1
            for to in (-cols - 1, -cols, -cols + 1, -1, 1, cols - 1, cols, cols + 1):
                i = at[here + to] - 1
                if i >= 0 and numbers[i] < 0:
                    numbers[i] = parts
                    stack[count] = i
                    count += 1
        parts += 1
    return numbers, sizes[:parts].copy()


@kernel
def _examine(
    mask: Mask,
    free: Mask,
    looks: NDArray[np.uint8],
    row: int,
    col: int,
    reach: float,
    faces: NDArray[np.float64],
) -> bool:
    """Count a look at each border cell in plain sight.

    Returns whether one of them is exhausted now.
    """
    rows, cols = mask.shape
    exhausted = False
    whole = int(math.ceil(reach))
    for r in range(max(row - whole, 0), min(row + whole + 1, rows)):
        for c in range(max(col - whole, 0), min(col + whole + 1, cols)):
            away = math.hypot(r - row, c - col)
            if not mask[r, c] or away > reach:
                continue
            turn = (math.atan2(r - row, c - col) - faces[0]) % (2.0 * math.pi)
            if turn > faces[1] - faces[0]:
                continue
            for side in range(4):
                ur = r + (side == 0) - (side == 1)
                uc = c + (side == 2) - (side == 3)
                inside = 0 <= ur < rows and 0 <= uc < cols
                if not inside or free[ur, uc] or math.hypot(ur - row, uc - col) < away:
                    continue
                # In plain sight: all cells up to it are free, and it would be seen if it counted as
                # free itself.
                if _sees_up_to(free, row, col, ur, uc):
                    looks[r, c] = min(looks[r, c] + 1, _LOOKS)
                    if looks[r, c] == _LOOKS:
                        mask[r, c] = False
                        exhausted = True
                    break
    return exhausted


@kernel
def _sees_up_to(free: Mask, row: int, col: int, to_row: int, to_col: int) -> bool:
    """Whether the straight line between two cells runs over free cells, the last not counted."""
    steps = 2 * max(abs(to_row - row), abs(to_col - col))
    for i in range(steps):
        r = int(math.floor(row + 0.5 + (to_row - row) * i / steps))
        c = int(math.floor(col + 0.5 + (to_col - col) * i / steps))
        if not (r == to_row and c == to_col) and not free[r, c]:
            return False
    return True


@kernel
def _owners(free: Mask, cells: Cells, nodes: Cells, reach: float) -> Cells:
    owners = np.full(cells.shape[0], -1, dtype=np.int64)
    for i in range(cells.shape[0]):
        best = reach
        for j in range(nodes.shape[0]):
            away = math.hypot(cells[i, 0] - nodes[j, 0], cells[i, 1] - nodes[j, 1])
            if away < best and line_is_clear(
                free, nodes[j, 0], nodes[j, 1], cells[i, 0], cells[i, 1]
            ):
                best = away
                owners[i] = j
    return owners
