"""Where the known space ends: frontiers, and what may be behind them."""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import Bounds, GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import axis_setup, line_is_clear
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, Cell, Cells, Mask, Place
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.thinning import known_free, true_cells
from thinmap_ros.jit import inlined, kernel

# Of frontiers.
_GAPS = TopologyConfig()
_SPARE_CELLS = 64  # of room on each side: where it is used up, all is rebuilt
_MARGIN_CELLS = 3  # read beyond those that are written, so that the cut is no frontier
_UPDATES_PER_WHOLE_MAP = 100  # corrections of the map reach cells that no scan can change

# Of the unknown behind them.
HIDDEN_REACH_M = 4.0  # to which unknown area counts as in line of sight
DEPTH_REACH_M = 1.0  # deeper frontiers hide something alike often
_RAYS = 120
_DEPTH_RAYS = 64  # of a cluster at most
_DEPTH_QUANTILE = 0.8
_AROUND = 2  # cells on each side of a frontier cell that show where the unknown lies
_SKIPPED = 2  # free cells with which a ray at an angle may begin

_RIM_M = 0.5  # beyond the beams of a scan, in which it may have changed the map

_SLACK_CELLS = 5  # of a search beside a frontier, beyond the first find


class FrontierMap:
    """Frontier cells of the whole map, updated where a scan can have changed it.

    Known free space ends at a frontier although nothing stands there: a frontier cell is a free
    cell with an unknown cell above, below, left or right. A single missing beam makes a frontier,
    too, so only clusters of some length count.
    free (H, W): known free cells, small gaps closed; passable (H, W): all but occupied cells; mask
    (H, W): frontier cells; all on the cells of `frame`, which holds the map and some room for it to
    grow. free_cells: how many are free.
    Source: Yamauchi, "A frontier-based approach for autonomous exploration", 1997.
    """

    def __init__(self) -> None:
        self._updates = 0
        self._begin(GridPatch(GridFrame(0.0, 0.0, 1.0), np.zeros((0, 0), dtype=np.int8)), 0)

    @property
    def known_area_m2(self) -> float:
        """Known free area."""
        return self.free_cells * self.frame.resolution**2

    def update(self, patch: GridPatch, *boxes: Array) -> None:
        """Find the frontier cells of the whole map in some boxes; now and then everywhere.

        boxes (2, 2): lower left and upper right corner, m, of what a scan (`box_of_scan`)
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

    def _begin(self, patch: GridPatch, spare: int) -> None:
        """Forget all cells; the next ones are those of a map, and spare ones on each side."""
        rows, cols = (size + 2 * spare for size in patch.shape)
        self.frame = patch.frame.with_origin_at(-spare, -spare)
        self.free: Mask = np.zeros((rows, cols), dtype=np.bool_)
        self.mask: Mask = np.zeros((rows, cols), dtype=np.bool_)
        self.passable: Mask = np.ones((rows, cols), dtype=np.bool_)
        self._changed: Mask = np.ones((rows, cols), dtype=np.bool_)
        self.free_cells = 0
        self._room = GridPatch(self.frame, self.mask.view(np.int8))

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
        known = known_free(cut, _GAPS)
        # Cells outside of the map are unknown.
        unknown = np.ones((known.shape[0] + 2, known.shape[1] + 2), dtype=np.bool_)
        unknown[1:-1, 1:-1] = cut.unknown & ~known
        beside = unknown[:-2, 1:-1] | unknown[2:, 1:-1] | unknown[1:-1, :-2] | unknown[1:-1, 2:]
        gone = int(np.count_nonzero(self.free[at]))
        self.free_cells += int(np.count_nonzero(known[inner])) - gone
        passable = ~cut.occupied[inner]
        self._changed[at] |= (self.free[at] != known[inner]) | (self.passable[at] != passable)
        self.free[at] = known[inner]
        self.mask[at] = (known & beside)[inner]
        self.passable[at] = passable

    def take_changes(self) -> Mask:
        """Cells (H, W) that are not what they were at the last call: free, occupied or neither."""
        changed = self._changed
        self._changed = np.zeros_like(changed)
        return changed

    def clusters(self, min_length_m: float) -> list[Cells]:
        """Frontier cells (N, 2) of each cluster that is long enough, in the order of first cells.

        Cells of a cluster are joined over edges and corners.
        """
        cells = true_cells(self.mask)
        numbers, sizes = _clusters(cells)
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
def _clusters(cells: Cells) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number of the cluster of each cell (N, 2), (N,), and the size of each cluster.

    cells: row by row, as are the numbers of clusters by their first cells.
    """
    first = np.arange(cells.shape[0])  # an earlier cell of the cluster, or the cell itself
    above = 0
    for i in range(cells.shape[0]):
        row, col = cells[i]
        if i > 0 and cells[i - 1, 0] == row and cells[i - 1, 1] == col - 1:
            _join(first, i - 1, i)
        while cells[above, 0] < row - 1 or (cells[above, 0] < row and cells[above, 1] < col - 1):
            above += 1
        k = above
        while cells[k, 0] < row and cells[k, 1] <= col + 1:
            _join(first, k, i)
            k += 1
    numbers = np.empty(cells.shape[0], dtype=np.int64)
    sizes = np.zeros(cells.shape[0], dtype=np.int64)
    clusters = 0
    for i in range(cells.shape[0]):
        numbers[i] = clusters if first[i] == i else numbers[first[i]]
        clusters += first[i] == i
        sizes[numbers[i]] += 1
    return numbers, sizes[:clusters].copy()


@inlined
def _join(first: NDArray[np.int64], a: int, b: int) -> None:
    """Make two cells those of one cluster."""
    while first[a] != a:
        a = first[a]
    while first[b] != b:
        b = first[b]
    first[max(a, b)] = min(a, b)


def hidden_area_m2(frontiers: FrontierMap, place: Place, reach_m: float = HIDDEN_REACH_M) -> float:
    """Unknown area in line of sight of a place, m: through the unknown, up to an obstacle.

    As `depth_behind_m`, it is evidence of what a frontier hides: behind one that runs along a wall,
    inside of which no cell is known, the unknown is two or three cells deep.
    """
    row, col = frontiers.frame.cells_of(np.array([place]))[0]
    resolution = frontiers.frame.resolution
    reach = reach_m / resolution
    return float(_hidden_cells(frontiers.free, frontiers.passable, row, col, reach)) * resolution**2


def depth_behind_m(frontiers: FrontierMap, cells: Cells) -> float:
    """Depth of the unknown straight behind a cluster (N, 2), up to the next known cell.

    80 % of its cells have at most this depth: where a doorway belongs to a cluster that runs along
    a wall, the doorway counts. At most DEPTH_REACH_M.
    """
    resolution = frontiers.frame.resolution
    reach = round(DEPTH_REACH_M / resolution)
    return float(_depth_behind(frontiers.free, frontiers.passable, cells, reach)) * resolution


@kernel
def _hidden_cells(free: Mask, passable: Mask, row: int, col: int, reach: float) -> int:
    """Cells neither free nor occupied on rays from a cell, each counted once."""
    rows, cols = free.shape
    whole = int(reach) + 2
    seen = np.zeros((2 * whole + 1, 2 * whole + 1), dtype=np.bool_)
    count = 0
    for k in range(_RAYS):
        angle = 2.0 * math.pi * k / _RAYS
        c, step_x, next_x, delta_x = axis_setup(col + 0.5, math.cos(angle))
        r, step_y, next_y, delta_y = axis_setup(row + 0.5, math.sin(angle))
        travelled = 0.0
        while travelled <= reach:
            inside = 0 <= r < rows and 0 <= c < cols
            if inside and not passable[r, c] and not free[r, c]:
                break
            if not (inside and free[r, c]) and not seen[r - row + whole, c - col + whole]:
                seen[r - row + whole, c - col + whole] = True
                count += 1
            if next_x < next_y:
                travelled = next_x
                next_x += delta_x
                c += step_x
            else:
                travelled = next_y
                next_y += delta_y
                r += step_y
    return count


@kernel
def _depth_behind(free: Mask, passable: Mask, cells: Cells, reach: int) -> float:
    """Unknown cells in a row, at most `reach`, behind most of some of a cluster's cells (N, 2)."""
    count = min(cells.shape[0], _DEPTH_RAYS)
    depths = np.empty(count)
    for i in range(count):
        k = (2 * i + 1) * cells.shape[0] // (2 * count)
        depths[i] = _depth(free, passable, cells[k, 0], cells[k, 1], reach)
    return float(np.quantile(depths, _DEPTH_QUANTILE))


@inlined
def _depth(free: Mask, passable: Mask, row: int, col: int, reach: int) -> float:
    """Unknown cells behind a cell, straight on, up to a known cell; outside all is unknown."""
    rows, cols = free.shape
    down = 0.0
    right = 0.0
    for r in range(row - _AROUND, row + _AROUND + 1):
        for c in range(col - _AROUND, col + _AROUND + 1):
            inside = 0 <= r < rows and 0 <= c < cols
            if not inside or (not free[r, c] and passable[r, c]):
                down += r - row
                right += c - col
    length = math.hypot(down, right)
    if length < 0.5:  # unknown on both sides: a cell or two
        return 1.0
    depth = 0.0
    for step in range(1, reach + _SKIPPED + 1):
        r = int(round(row + step * down / length))
        c = int(round(col + step * right / length))
        inside = 0 <= r < rows and 0 <= c < cols
        if inside and free[r, c] and depth == 0.0 and step <= _SKIPPED:
            continue
        if depth >= reach or (inside and (free[r, c] or not passable[r, c])):
            break
        depth += 1.0
    return depth


def field_of_view(scan: Scan) -> tuple[float, float]:
    """Field of view of a scan: its first and last direction, rad, laser frame.

    The outer beams, and as much again as between two beams.
    """
    last = scan.angle_min_rad + scan.angle_increment_rad * (scan.ranges_m.size - 1)
    more = abs(scan.angle_increment_rad)
    return min(scan.angle_min_rad, last) - more, max(scan.angle_min_rad, last) + more


def visible_places(
    places: Array, scan: Scan, T_map_laser: Array, free: Mask, frame: GridFrame
) -> Mask:
    """Which places (N, 2), m, a scan made by a laser at a pose (3,) sees, (N,).

    They lie in its range and field of view, with free cells (H, W) of a frame all the way.
    """
    low, high = field_of_view(scan)
    offsets = places - T_map_laser[:2]
    bearings = np.arctan2(offsets[:, 1], offsets[:, 0]) - T_map_laser[2]
    is_ahead = np.abs(se2.wrap(bearings - 0.5 * (low + high))) <= 0.5 * (high - low)
    seen = is_ahead & (np.hypot(*offsets.T) < scan.range_max_m)
    laser = frame.cells_of(T_map_laser[:2])[0]
    cells = frame.cells_of(places)
    seen[seen] = [line_is_clear(free, *laser, *cell) for cell in cells[seen]]
    return np.asarray(seen)


def box_of_scan(scan: Scan, T_map_base: Array) -> Array:
    """Lower left and upper right corner (2, 2), m, of what a scan made at (3,) may have changed."""
    T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
    # Some drivers publish an infinite range_max.
    limits = (scan.range_min_m, min(scan.range_max_m, se2.MAX_COORDINATE_M))
    return np.asarray(
        _box(scan.ranges_m, limits, scan.angle_min_rad, scan.angle_increment_rad, T_map_laser)
    )


@kernel
def _box(
    ranges: Array, limits: tuple[float, float], first: float, step: float, laser: Array
) -> Array:
    """Corners (2, 2) of what beams (N,) from a laser at a pose (3,) reach, and _RIM_M more.

    See box_of_scan.
    """
    left = bottom = right = top = 0.0
    for i in range(ranges.size):
        if (ranges[i] >= limits[0] and ranges[i] > 0.0) or ranges[i] >= limits[1]:
            reach = min(ranges[i], limits[1])
            angle = first + step * i + laser[2]
            x = reach * math.cos(angle)
            y = reach * math.sin(angle)
            left = min(left, x)
            right = max(right, x)
            bottom = min(bottom, y)
            top = max(top, y)
    box = np.empty((2, 2))
    box[0, 0] = laser[0] + left - _RIM_M
    box[0, 1] = laser[1] + bottom - _RIM_M
    box[1, 0] = laser[0] + right + _RIM_M
    box[1, 1] = laser[1] + top + _RIM_M
    return box


def search_beside(
    free: Mask, cells: Cells, allowed: Mask, max_steps: int, towards: Cell
) -> Cell | None:
    """The allowed cell beside a frontier (N, 2) that is nearest to another cell; None: none.

    Of the allowed cells (H, W) whose path to the frontier over free cells (H, W) has at most
    max_steps cells, and is nearly the shortest: around a pillar all sides are equally near.
    """
    row, col, _ = _search_beside(free, cells, allowed, allowed, max_steps, towards)
    return None if row < 0 else (int(row), int(col))


def is_enclosed(free: Mask, cells: Cells, standing: Mask) -> bool:
    """Whether no path over free cells leads from a frontier (N, 2) to where a robot could stand.

    free, standing (H, W).
    """
    return bool(_search_beside(free, cells, standing, standing, -1, (0, 0))[2])


@kernel
def _search_beside(
    free: Mask, cells: Cells, allowed: Mask, standing: Mask, most_steps: int, towards: Cell
) -> tuple[int, int, bool]:
    """Breadth first over free cells, from all frontier cells at once, to a place and at all.

    It goes _SLACK_CELLS steps on after the first find.
    """
    rows, cols = free.shape
    seen = np.zeros((rows, cols), dtype=np.bool_)
    queue = np.empty((rows * cols, 3), dtype=np.int64)
    tail = 0
    for row, col in cells:
        queue[tail] = row, col, 0
        seen[row, col] = True
        tail += 1
    head = 0
    best = np.inf
    place = (-1, -1)
    is_enclosed = True
    while head < tail and (is_enclosed or queue[head, 2] <= most_steps):
        row, col, steps = queue[head]
        head += 1
        is_enclosed &= not standing[row, col]
        away = math.hypot(row - towards[0], col - towards[1])
        if allowed[row, col] and steps <= most_steps and away < best:
            if place[0] < 0:
                most_steps = min(most_steps, steps + _SLACK_CELLS)
            best = away
            place = (row, col)
        for r, c in ((row + 1, col), (row - 1, col), (row, col + 1), (row, col - 1)):
            if 0 <= r < rows and 0 <= c < cols and free[r, c] and not seen[r, c]:
                seen[r, c] = True
                queue[tail] = r, c, steps + 1
                tail += 1
    return place[0], place[1], is_enclosed
