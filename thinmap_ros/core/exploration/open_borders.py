"""Where known free space ends although nothing stands there: what is left to see, kept up to date scan by scan.

A border cell is a free cell beside (over an edge) one that is unknown. A single missing beam makes one too, so only
borders of some length count. A border is *exhausted* when it has been looked at closely and stayed: no laser sees more
of it. Border cells belong to the nearest end node in sight of them; those that no end node sees are left over.
"""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.config import TopologyConfig
from thinmap_ros.core.topology.free_space import known_free, label

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
_LOOKS = 3
_SLACK = 5
_PART_M = 1.0


class OpenBorders:
    """The border cells of the whole map; only what a scan can have changed is looked at again.

    free (H, W): known free cells, small gaps closed; mask (H, W): open border cells; both on the cells of `frame`.
    """

    def __init__(self, shortest_m: float) -> None:
        self._shortest_m = shortest_m
        self.frame = GridFrame(0.0, 0.0, 1.0)
        self.free: Mask = np.zeros((0, 0), dtype=np.bool_)
        self.mask: Mask = np.zeros((0, 0), dtype=np.bool_)
        self._looks: NDArray[np.uint8] = np.zeros((0, 0), dtype=np.uint8)

    def update(self, patch: GridPatch, xy: tuple[float, float], reach_m: float) -> None:
        """Find the borders of a map anew within reach_m of a point, m; the first time everywhere."""
        if self.mask.size == 0:
            self._fit(patch)
            rows, cols = slice(0, patch.shape[0]), slice(0, patch.shape[1])
        else:
            self._fit(patch)
            rows, cols = _around(patch, xy, reach_m)
        # Two cells more are read than written, so that the cut is no border.
        wide = (slice(max(rows.start - 3, 0), rows.stop + 3), slice(max(cols.start - 3, 0), cols.stop + 3))
        part = GridPatch(patch.frame, np.ascontiguousarray(patch.cells[wide]))
        free = known_free(part, TopologyConfig())
        border = _borders(free, part.unknown & ~free)
        top, left = rows.start - wide[0].start, cols.start - wide[1].start
        inner = (slice(top, top + rows.stop - rows.start), slice(left, left + cols.stop - cols.start))
        self.free[rows, cols] = free[inner]
        self.mask[rows, cols] = border[inner] & (self._looks[rows, cols] < _LOOKS)

    def examine(self, xy: tuple[float, float], reach_m: float, faces: NDArray[np.float64]) -> None:
        """Count a close look from a point, m: border cells whose unknown neighbour lies in plain sight, yet unknown.

        faces (2,): first and last direction of view in the map frame, rad. After some such looks a cell is exhausted.
        """
        row, col = self.frame.cells_of(np.array([xy]))[0]
        reach = reach_m / self.frame.resolution
        _examine(self.mask, self.free, self._looks, int(row), int(col), reach, faces)
        self.mask &= self._looks < _LOOKS

    def exhaust(self, cells: Cells, xy: tuple[float, float]) -> None:
        """Give up border cells (N, 2) for good: those about as near to a point, m, as the nearest of them.

        A long border is seen from one place in part only.
        """
        away_m = np.hypot(*(self.frame.centres_of(cells) - xy).T)
        gone = cells[away_m <= away_m.min(initial=np.inf) + _PART_M]
        self._looks[gone[:, 0], gone[:, 1]] = _LOOKS
        self.mask[gone[:, 0], gone[:, 1]] = False

    def stretches(self) -> tuple[Cells, NDArray[np.int32], int]:
        """Border cells (N, 2) in stretches long enough, the number of their stretch (N,), and how many there are."""
        labels, sizes = label(self.mask)
        long_enough = sizes * self.frame.resolution >= self._shortest_m - 1e-6
        long_enough[0] = False
        cells = np.argwhere(self.mask)
        of_cells = labels[cells[:, 0], cells[:, 1]]
        keep = long_enough[of_cells]
        return cells[keep], of_cells[keep], int(long_enough.sum())

    def owners(self, cells: Cells, nodes: Cells, reach_m: float) -> Cells:
        """For each border cell (N, 2), the index of the nearest node cell (M, 2) in sight within reach_m, or -1."""
        return np.asarray(_owners(self.free, cells, nodes, reach_m / self.frame.resolution))

    def place_to_look(self, cells: Cells, allowed: Mask, reach_m: float, xy: tuple[float, float]) -> Array | None:
        """Centre (2,), m, of the allowed cell from which to look at a border (N, 2): near to it, and to a point xy.

        Of all allowed cells whose way to the border over free cells is within reach_m, and nearly the shortest, the one
        nearest to the point: round a pillar all sides are equally near.
        """
        row, col = self.frame.cells_of(np.array([xy]))[0]
        steps = int(reach_m / self.frame.resolution)
        place = _place_to_look(self.free, cells, allowed, steps, int(row), int(col))
        return None if place[0] < 0 else self.frame.centres_of(np.array([place]))[0]

    def _fit(self, patch: GridPatch) -> None:
        """Bring the arrays to the patch's extent; what is outside of it is forgotten."""
        if self.frame == patch.frame and self.mask.shape == patch.shape:
            return
        free, mask = np.zeros(patch.shape, dtype=np.bool_), np.zeros(patch.shape, dtype=np.bool_)
        looks = np.zeros(patch.shape, dtype=np.uint8)
        if self.mask.size:
            row = round((self.frame.origin_y - patch.frame.origin_y) / patch.frame.resolution)
            col = round((self.frame.origin_x - patch.frame.origin_x) / patch.frame.resolution)
            rows, from_rows = _overlap(row, self.mask.shape[0], patch.shape[0])
            cols, from_cols = _overlap(col, self.mask.shape[1], patch.shape[1])
            free[rows, cols] = self.free[from_rows, from_cols]
            mask[rows, cols] = self.mask[from_rows, from_cols]
            looks[rows, cols] = self._looks[from_rows, from_cols]
        self.frame, self.free, self.mask, self._looks = patch.frame, free, mask, looks


def directions_of_view(scan: Scan, T_map_base: Array) -> Array:
    """First and last direction of view of a scan at a pose (3,), rad, map frame, the first the smaller, (2,)."""
    last = scan.angle_min_rad + scan.angle_increment_rad * (scan.ranges_m.size - 1)
    heading = float(T_map_base[2] + scan.T_base_laser[2])
    return np.array([heading + min(scan.angle_min_rad, last), heading + max(scan.angle_min_rad, last)])


def _overlap(offset: int, old: int, new: int) -> tuple[slice, slice]:
    first, last = max(offset, 0), min(offset + old, new)
    return slice(first, max(last, first)), slice(first - offset, max(last, first) - offset)


def _around(patch: GridPatch, xy: tuple[float, float], reach_m: float) -> tuple[slice, slice]:
    row, col = (int(v) for v in patch.frame.cells_of(np.array([xy]))[0])
    reach = math.ceil(reach_m / patch.frame.resolution)
    rows, cols = patch.shape
    top, left = min(max(row - reach, 0), rows), min(max(col - reach, 0), cols)
    return slice(top, max(min(row + reach + 1, rows), top)), slice(left, max(min(col + reach + 1, cols), left))


def _borders(free: Mask, unknown: Mask) -> Mask:
    """Free cells with an unknown one above, below, left or right; what lies outside the array is unknown."""
    beyond = np.pad(unknown, 1, constant_values=True)
    beside = beyond[:-2, 1:-1] | beyond[2:, 1:-1] | beyond[1:-1, :-2] | beyond[1:-1, 2:]
    return np.asarray(free & beside)


@kernel
def _examine(
    mask: Mask, free: Mask, looks: NDArray[np.uint8], row: int, col: int, reach: float, faces: NDArray[np.float64]
) -> None:
    rows, cols = mask.shape
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
                ur, uc = r + (side == 0) - (side == 1), c + (side == 2) - (side == 3)
                inside = 0 <= ur < rows and 0 <= uc < cols
                if not inside or free[ur, uc] or math.hypot(ur - row, uc - col) < away:
                    continue
                # In plain sight: all cells up to it are free, and it would be seen if it counted as free itself.
                if _sees_up_to(free, row, col, ur, uc):
                    looks[r, c] = min(looks[r, c] + 1, _LOOKS)
                    break


@kernel
def _sees_up_to(free: Mask, row: int, col: int, to_row: int, to_col: int) -> bool:
    """Whether the straight line between two cells runs over free cells, the last one not counted."""
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
            if away < best and line_is_clear(free, nodes[j, 0], nodes[j, 1], cells[i, 0], cells[i, 1]):
                best, owners[i] = away, j
    return owners


@kernel
def _place_to_look(
    free: Mask, cells: Cells, allowed: Mask, most_steps: int, to_row: int, to_col: int
) -> tuple[int, int]:
    """Breadth first over free cells, from all border cells at once, and _SLACK steps on after the first find."""
    rows, cols = free.shape
    seen = np.zeros((rows, cols), dtype=np.bool_)
    queue = np.empty((rows * cols, 3), dtype=np.int64)
    tail = 0
    for i in range(cells.shape[0]):
        queue[tail, 0], queue[tail, 1], queue[tail, 2] = cells[i, 0], cells[i, 1], 0
        seen[cells[i, 0], cells[i, 1]] = True
        tail += 1
    head, best, best_row, best_col = 0, np.inf, -1, -1
    while head < tail and queue[head, 2] <= most_steps:
        row, col, steps = queue[head, 0], queue[head, 1], queue[head, 2]
        head += 1
        away = math.hypot(row - to_row, col - to_col)
        if allowed[row, col] and away < best:
            if best_row < 0:
                most_steps = min(most_steps, steps + _SLACK)
            best, best_row, best_col = away, row, col
        for side in range(4):
            r, c = row + (side == 0) - (side == 1), col + (side == 2) - (side == 3)
            if 0 <= r < rows and 0 <= c < cols and free[r, c] and not seen[r, c]:
                seen[r, c] = True
                queue[tail, 0], queue[tail, 1], queue[tail, 2] = r, c, steps + 1
                tail += 1
    return best_row, best_col
