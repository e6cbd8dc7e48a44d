"""Regions of a grid: flooded, described by kind, area, outline and doors; with ids that stay."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinmap_ros.core import snapshot
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.fields import (
    counts_of,
    distance_cells,
    label,
    looked_up,
    root_of,
    squared_distance,
    strips,
)
from thinmap_ros.core.grid.mapper import WholeMap
from thinmap_ros.core.grid.moved import MapMotion
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import Array, Cells, Mask
from thinmap_ros.core.snapshot import MAX_COUNT, MAX_ID, Field
from thinmap_ros.core.topology import regions as region_names
from thinmap_ros.core.topology.regions import Door, Region, RegionKind, RegionMap, RegionNames
from thinmap_ros.core.topology.thinning import (
    UNKNOWN_END,
    VIEW_M,
    end_of_view,
    standing_room,
    view_ends,
)
from thinmap_ros.jit import inlined, kernel

Labels = NDArray[np.int32]
Squares = NDArray[np.int32]  # squared distances, in cells

# Of passages.
_NECK_RATIO = 0.75  # a passage separates two places if it is narrower than this share of both
_MIN_DOOR_WIDTH_M = 0.5  # narrower passages are gaps along walls, and no doors
# On both sides of a door it gets wider within this distance; else it is the mouth of a narrow
# corridor.
_MAX_DOOR_DEPTH_M = 2.0
_JAMB_M = 0.6  # on each side of a passage, over which a straight wall is no jamb
# The cells around one, row after row.
_ROWS_ROUND = np.array([-1, -1, -1, 0, 0, 1, 1, 1])
_COLS_ROUND = np.array([-1, 0, 1, -1, 1, -1, 0, 1])
_SQUARE = np.ones((3, 3), dtype=np.bool_)  # a cell and its eight neighbours
_FACE_M = 0.15  # up to which a straight wall is rough

# Of furniture: compact obstacles apart from walls up to this length.
_MAX_FURNITURE_M = 2.5
# Least area in relation to its squared length: a square has a half, a wall 0.15 m thick and 1 m
# long 0.13. What it encloses counts: a laser sees the rim of a table.
_COMPACT = 0.15
_LEG = 0.2  # length up to which any shape is furniture, as a share of the largest

# Of space behind glass: what a laser sees through it ends in the unknown, without walls around.
_VIEW_STRIDE_M = 0.25  # between the places that are looked from
_VIEWS = 24  # directions
_OPEN = 0.6  # share of directions; it is a half at the edge of an explored hall

# Area of a basin above its saddle, as a share of the least area of a region: more and small rooms
# join the corridor, less and noise divides regions.
_SEED = 1 / 3
_MIN_AREA_M2 = 3.0  # a smaller part is a niche of the one behind its widest passage
# Free cells this near to a region lie within its outline: regions end before the walls, m.
WALL_MARGIN_M = 0.5

_CORRIDOR_RATIO = 5.0  # a corridor is at least so many times as long as wide

# Of ids that stay.
_UPDATES = 5  # after which a cell forgets its earlier id
_STRIDE_M = 0.2  # between the cells that remember an id

_OWN_FIELDS = {
    'region_frame': Field(np.float64, (3,), -snapshot.MAX_COORDINATE_M, snapshot.MAX_COORDINATE_M),
    'region_labels': Field(np.int32, ('r', 'c'), 0, MAX_ID),
    'next_region_id': Field(np.int64, (), 1, MAX_COUNT),
}
FIELDS = {**_OWN_FIELDS, **region_names.FIELDS}


@dataclass(frozen=True)
class RegionConfig(Config):
    """What separates two regions, and which kind a region is.

    robot_radius_m: free space that the robot does not fit into belongs to no region.
    """

    robot_radius_m: float = 0.25
    max_door_width_m: float = parameter(
        2.6,
        'Widest passage that separates two regions (m). Raise it for gates, lower it if rooms are '
        'divided where cupboards stand.',
        low=0.5,
        high=10.0,
    )
    max_corridor_width_m: float = parameter(
        3.2,
        'Largest width of a corridor (m); a region that is wider in most of its area is a room or '
        'a hall. Raise it for hospitals and malls, lower it if long rooms count as corridors.',
        low=0.5,
        high=20.0,
    )
    min_hall_width_m: float = parameter(
        9.0,
        'Width from which a room is a hall (m). Raise it for a warehouse, lower it for a flat.',
        low=1.0,
        high=1000.0,
    )


@dataclass(frozen=True, eq=False)
class Clearance:
    """Distance of each cell of a space to the nearest cell outside; the rim of the map is outside.

    squared (H, W): in cells, which needs half the memory of a distance in m; 0 outside.
    """

    squared: Squares
    resolution_m: float

    @staticmethod
    def of(space: Mask, resolution_m: float) -> 'Clearance':
        """Clearance in a space (H, W)."""
        return Clearance(squared_distance(~space, is_rim_marked=True), resolution_m)

    def within(self, part: slice | tuple[slice, ...]) -> Array:
        """Distances in a part of the map, m."""
        return np.asarray(np.sqrt(self.squared[part]) * self.resolution_m)


def flood(
    clearance: Clearance, ratio: float, widest_m: float, least_cells: int
) -> tuple[Labels, Cells]:
    """Basins of a clearance (H, W): a watershed by merge tree.

    Cells are flooded from the roomiest one down. A cell beside one basin joins it; a cell beside
    two is their saddle, the widest place of the narrowest path between them: they become one basin,
    unless the saddle is a neck. So a path round a table, where basins meet again lower down, is no
    door. At a neck the clearance is at most widest_m, and a ratio of that of the smaller peak, and
    both basins have least_cells.
    Returns the basin of each cell, from 1, 0 outside, (H, W); and the saddles between basins,
    widest first (N, 3): flat index of the cell, lower and higher basin.
    Source: watershed after F. Meyer, "Topographic distance and watershed lines", 1994; compared for
    maps by R. Bormann et al., "Room segmentation: survey, implementation, and analysis", ICRA 2016.
    """
    shape = clearance.squared.shape
    flat = clearance.squared.ravel()
    limits = (ratio, widest_m, least_cells)
    basin, parent, saddles = _flood(
        flat, _roomiest_first(flat), shape[1], clearance.resolution_m, *limits
    )
    number = np.zeros(len(parent) + 1, dtype=np.int32)  # the last: of cells outside
    number[:-1] = 1 + np.unique(parent, return_inverse=True)[1]
    pairs = np.sort(number[saddles[:, 1:]], axis=1)
    apart = pairs[:, 0] != pairs[:, 1]
    labels = looked_up(number, basin.reshape(shape))
    return labels, np.column_stack([saddles[apart, 0], pairs[apart]])


@kernel
def _roomiest_first(flat: Squares) -> NDArray[np.int32]:
    """Indices of the squared clearances (N,) above 0, the largest first, else by index."""
    first = np.zeros(flat.max() + 2, dtype=np.int64)
    for value in flat:
        first[value] += 1
    first[0] = 0
    # From the counts to where the cells of each value begin.
    total = 0
    for value in range(first.size - 1, 0, -1):
        count = first[value]
        first[value] = total
        total += count
    order = np.empty(total, dtype=np.int32)
    for at in range(flat.size):
        if flat[at] > 0:
            order[first[flat[at]]] = at
            first[flat[at]] += 1
    return order


@kernel
def _flood(
    flat: Squares,
    order: NDArray[np.int32],
    cols: int,
    resolution_m: float,
    ratio: float,
    widest: float,
    least_cells: int,
) -> tuple[Labels, Cells, Cells]:
    """Basin of each cell (-1 outside), basin that each one was merged into, saddles (N, 3)."""
    basin = np.full(flat.size, -1, dtype=np.int32)
    parent = np.empty(order.size, dtype=np.int64)
    peak = np.empty(order.size)
    cells = np.empty(order.size, dtype=np.int64)  # not zeros: few of these pages are used
    saddles = np.empty((3 * order.size, 3), dtype=np.int64)
    steps = _ROWS_ROUND * cols + _COLS_ROUND
    count = 0
    basins = 0
    for at in order:
        best = -1  # basin beside this cell, of several merged ones their union
        uphill = -1  # basin of the neighbour with the largest clearance
        highest = 0
        last = -1  # basin of the neighbour before
        col = at % cols
        is_inner = 0 < col < cols - 1 and cols <= at < flat.size - cols
        for k in range(8):
            other_cell = at + steps[k]
            if not is_inner:
                is_beside = 0 <= col + _COLS_ROUND[k] < cols
                if not is_beside or not 0 <= other_cell < flat.size:
                    continue
            if basin[other_cell] < 0:
                continue
            if flat[other_cell] > highest:
                highest = flat[other_cell]
                uphill = basin[other_cell]
            if basin[other_cell] == last:
                continue
            last = basin[other_cell]
            other = root_of(parent, last)
            if best < 0 or best == other:
                best = other
                continue
            low = min(peak[best], peak[other])
            room = math.sqrt(flat[at]) * resolution_m
            is_narrow = room < ratio * low and room <= widest
            if is_narrow and min(cells[best], cells[other]) >= least_cells:
                saddles[count, 0] = at
                saddles[count, 1] = best
                saddles[count, 2] = other
                count += 1
                continue
            parent[other] = best
            peak[best] = max(peak[best], peak[other])
            cells[best] += cells[other]
        if best < 0:
            uphill = basins
            parent[uphill] = uphill
            cells[uphill] = 0
            peak[uphill] = math.sqrt(flat[at]) * resolution_m
            basins += 1
        # Up the steepest path, so that a boundary runs through its saddle.
        own = root_of(parent, uphill)
        basin[at] = own
        cells[own] += 1
    for k in range(basins):
        parent[k] = root_of(parent, k)
    return basin, parent[:basins].copy(), saddles[:count].copy()


@dataclass(frozen=True)
class Passage:
    """A passage between the basins a and b; cell: flat index of its widest saddle."""

    cell: int
    a: int
    b: int
    width_m: float


def passages_at(
    saddles: NDArray[np.int64], clearance: Clearance, min_width_m: float
) -> list[Passage]:
    """One passage for each stretch of saddles (N, 3) between the same two basins, widest first."""
    height, width = clearance.squared.shape
    rows, cols = np.divmod(saddles[:, 0], width)
    near = np.zeros((height + 2, width + 2), dtype=np.bool_)
    for row, col in np.ndindex(3, 3):
        near[rows + row, cols + col] = True
    stretches = label(near)[0][rows + 1, cols + 1].tolist()
    widths_m = 2.0 * (np.sqrt(clearance.squared[rows, cols]) * clearance.resolution_m)
    found: dict[tuple[int, int, int], Passage] = {}
    rows_of = zip(saddles.tolist(), widths_m.tolist(), stretches, strict=True)
    for (cell, a, b), width_m, stretch in rows_of:
        if width_m >= min_width_m:
            found.setdefault((stretch, a, b), Passage(cell, a, b, width_m))
    return list(found.values())


def mean_widths_m(basins: Labels, clearance: Clearance) -> Array:
    """Mean width of each basin as of a strip, by number from 0 (unused) on, m.

    Across a strip the mean clearance is a quarter of the width. At a crossing it is more in a few
    cells only, so that the largest one would call corridors that meet wide.
    """
    count = 1 + int(basins.max(initial=0))
    sums = np.zeros(count)
    cells = np.zeros(count, dtype=np.int64)
    for strip in strips(len(basins)):
        numbers = basins[strip].ravel()
        np.add.at(sums, numbers, clearance.within(strip).ravel())
        cells += np.bincount(numbers, minlength=count)
    return 4.0 * sums / np.maximum(cells, 1)


def gets_wider(passage: Passage, basins: Labels, clearance: Clearance) -> bool:
    """Whether both basins are wider than a passage near by: else it is no neck of theirs."""
    row, col = divmod(passage.cell, basins.shape[1])
    reach = math.ceil(_MAX_DOOR_DEPTH_M / clearance.resolution_m)
    box = (slice(max(row - reach, 0), row + reach + 1), slice(max(col - reach, 0), col + reach + 1))
    clearance_m = clearance.within(box)
    return all(
        _NECK_RATIO * float(clearance_m[basins[box] == basin].max(initial=0.0))
        > 0.5 * passage.width_m
        for basin in (passage.a, passage.b)
    )


def has_flat_jamb(passage: Passage, clearance: Clearance) -> bool:
    """Whether the wall at one end of a passage goes straight on to both sides of it.

    So it does opposite an open door's leaf or a cupboard in a corridor; a door has a wall that ends
    at both of its jambs.
    """
    resolution_m = clearance.resolution_m
    at = np.array(divmod(passage.cell, clearance.squared.shape[1]))
    half = 0.5 * passage.width_m / resolution_m
    reach = math.ceil(half + _JAMB_M / resolution_m) + 1
    low = (at - reach).clip(0)
    high = at + reach + 1
    near = clearance.squared[low[0] : high[0], low[1] : high[1]]
    walls = np.argwhere(near == 0) + low - at
    if not len(walls):
        return False
    away = np.hypot(*walls.T)
    across = walls[away.argmin()] / away.min()
    beside = walls @ across
    along = walls @ np.array([-across[1], across[0]])
    deepest = half + _FACE_M / resolution_m
    for side in (1.0, -1.0):
        is_face = (side * beside > 0.5 * half) & (side * beside <= deepest)
        if _covers(along[is_face], _JAMB_M / resolution_m):
            return True
    return False


def _covers(marks: Array, reach: float) -> bool:
    """Whether marks leave no gap of two cells between -reach and reach."""
    inside = np.sort(marks[np.abs(marks) <= reach])
    return bool((np.diff(np.concatenate(([-reach], inside, [reach]))) <= 2.0).all())


def joined(
    basins: Labels,
    passages: list[Passage],
    is_door: list[bool],
    free: Mask,
    least_cells: int,
) -> tuple[Labels, list[Passage]]:
    """Basins joined where a passage between them is no door: regions (H, W) from 1, and doors.

    A region of fewer than least_cells free cells joins a neighbour, through its widest door; where
    it has none, its cells are in no region.
    """
    number = np.arange(1 + int(basins.max(initial=0)))
    cells = counts_of(basins, free, len(number))

    def join(passage: Passage) -> None:
        low = number[passage.a]
        high = number[passage.b]
        if low != high:
            cells[high] += cells[low]
            number[number == low] = high

    for passage, separates in zip(passages, is_door, strict=True):
        if not separates:
            join(passage)
    for passage in passages:
        if min(cells[number[passage.a]], cells[number[passage.b]]) < least_cells:
            join(passage)
    region = np.unique(number, return_inverse=True)[1].astype(np.int32)
    doors = [
        Passage(passage.cell, int(region[passage.a]), int(region[passage.b]), passage.width_m)
        for passage in passages
        if region[passage.a] != region[passage.b]
    ]
    region[cells[number] < least_cells] = 0
    return looked_up(region, basins), doors


def room_space(patch: GridPatch, config: RegionConfig) -> Mask:
    """Cells (H, W) that the robot's disc covers where it fits, with furniture taken for free.

    Pillars and tables would make rings of narrow passages, and no two rooms. A free slit in which
    the robot does not fit, as between the two faces of a wall, would join what the wall separates.
    """
    radius = config.robot_radius_m / patch.frame.resolution
    free = patch.free | _furniture(patch, _MAX_FURNITURE_M / patch.frame.resolution)
    free &= ~behind_glass(patch)
    # Squared distances are whole numbers: this is the next one above the radius.
    standing = standing_room(free, math.sqrt(math.floor(radius**2) + 1))
    margin = math.ceil(radius)  # nobody stands in the cells outside
    apart = np.pad(~standing, margin, constant_values=True)
    return ~standing_room(apart, radius)[margin:-margin, margin:-margin]


def wide_cells(clearance: Array, width_m: float, resolution_m: float) -> Mask:
    """Cells (H, W) of a space that a disc of a diameter covers where it fits, by clearances, m.

    Niches leave them as they are, where they lower the mean clearance of a room.
    """
    fits = clearance > 0.5 * width_m
    if not fits.any():
        return fits
    return np.asarray(distance_cells(fits) * resolution_m < 0.5 * width_m) & (clearance > 0.0)


def _furniture(patch: GridPatch, longest: float) -> Mask:
    """Obstacles and unknown specks (H, W) apart from walls, no longer than so many cells.

    A thin piece is one of a wall between two doors, unless it is no longer than a table's leg.
    """
    numbers, sizes = label(~patch.free)
    small = np.zeros(len(sizes), dtype=np.bool_)
    for number, box in enumerate(ndimage.find_objects(numbers), 1):
        extent = math.hypot(*(side.stop - side.start for side in box))
        is_at_rim = any(s.start == 0 or s.stop == n for s, n in zip(box, patch.shape, strict=True))
        if extent > longest or is_at_rim:
            continue
        filled = ndimage.binary_fill_holes(numbers[box] == number)
        small[number] = filled.sum() >= _COMPACT * extent**2 or extent <= _LEG * longest
    return looked_up(small, numbers)


def behind_glass(patch: GridPatch) -> Mask:
    """Cells (H, W) that see the unknown in most directions: a laser saw them through glass."""
    resolution = patch.frame.resolution
    stride = max(1, round(_VIEW_STRIDE_M / resolution))
    reach = VIEW_M / resolution
    ends = view_ends(replace(patch))  # whose masks go with it: the map may be large
    side = int(reach) + 2
    near = ndimage.binary_dilation(any_in_squares(ends == UNKNOWN_END, side), _SQUARE)
    return _sees_unknown(patch.free, ends, near, stride, reach)


def any_in_squares(cells: Mask, side: int) -> Mask:
    """Which squares of so many cells hold a true one of a mask (H, W)."""
    rows, cols = (np.arange(0, size, side) for size in cells.shape)
    return np.logical_or.reduceat(np.logical_or.reduceat(cells, rows, axis=0), cols, axis=1)


@kernel
def _sees_unknown(
    free: Mask, ends: NDArray[np.uint8], near: Mask, stride: int, reach: float
) -> Mask:
    """Squares of a stride (H, W) whose middle is free and sees the unknown in most directions.

    near: squares of `int(reach) + 2` cells from which the unknown may be seen.
    """
    rows, cols = free.shape
    found = np.zeros(free.shape, dtype=np.bool_)
    side = int(reach) + 2
    most = _VIEWS - int(_OPEN * _VIEWS) - 1  # other directions
    for row in range(stride // 2, rows, stride):
        for col in range(stride // 2, cols, stride):
            if not free[row, col] or not near[row // side, col // side]:
                continue
            others = 0
            for k in range(_VIEWS):
                others += (
                    end_of_view(ends, row, col, reach, 2.0 * math.pi * k / _VIEWS) != UNKNOWN_END
                )
                if others > most:
                    break
            top = row - stride // 2
            left = col - stride // 2
            found[top : top + stride, left : left + stride] = others <= most
    return found


def outline_of(cells: Mask, frame: GridFrame) -> Array:
    """Outer boundary (K, 2) of the largest edge-connected part of cells (H, W), m, map frame.

    Counterclockwise and not closed, with a point at each corner; (0, 2) of no cells.
    """
    parts, count = ndimage.label(cells)
    if not count:
        return np.empty((0, 2))
    largest = 1 + int(np.bincount(parts.ravel())[1:].argmax())
    corners = _boundary(np.pad(parts == largest, 1)) - 1.0  # (column, row) of lower left corners
    return corners * frame.resolution + (frame.origin_x, frame.origin_y)


@kernel
def _boundary(cells: Mask) -> Array:
    """Corners (K, 2), as (column, row), of the outer boundary of a connected part with a clear rim.

    The cells lie on the left. Where two cells meet at a corner only, it stays with its own.
    """
    cols = cells.shape[1]
    first = 0
    while not cells[first // cols, first % cols]:
        first += 1
    row = first // cols
    col = first % cols
    corners = np.empty((4 * cells.size, 2))
    count = 0
    heading = 0  # east, north, west, south
    previous = 0
    while count == 0 or row != first // cols or col != first % cols:
        if not cells[_ahead(row, col, heading)]:
            heading = (heading + 1) % 4
        elif cells[_ahead(row, col, (heading + 3) % 4)]:
            heading = (heading + 3) % 4
        if count == 0 or heading != previous:
            corners[count] = (col, row)
            count += 1
        previous = heading
        row += (heading == 1) - (heading == 3)
        col += (heading == 0) - (heading == 2)
    return corners[:count].copy()


@inlined
def _ahead(row: int, col: int, heading: int) -> tuple[int, int]:
    """The cell ahead of a corner on the left of a heading; that on the right is the next one's."""
    return row - (heading >= 2), col - (heading in (1, 2))


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Cells of a grid by region, not yet described.

    labels (H, W): region of each cell from 1, 0 for none.
    """

    patch: GridPatch
    labels: Labels
    clearance: Clearance
    passages: list[Passage]


def find_regions(patch: GridPatch, config: RegionConfig | None = None) -> RegionMap:
    """Rooms, corridors and halls of a grid, with ids from 1."""
    config = config or RegionConfig()
    segmentation = segment(patch, config)
    return describe(segmentation, np.arange(1 + int(segmentation.labels.max(initial=0))), config)


def segment(patch: GridPatch, config: RegionConfig) -> Segmentation:
    """Divide the free space of a grid at its necks."""
    resolution = patch.frame.resolution
    clearance = Clearance.of(room_space(patch, config), resolution)
    least_cells = int(_MIN_AREA_M2 / resolution**2)
    seed_cells = max(1, int(_SEED * least_cells))
    basins, saddles = flood(clearance, _NECK_RATIO, 0.5 * config.max_door_width_m, seed_cells)
    passages = passages_at(saddles, clearance, _MIN_DOOR_WIDTH_M)
    widths_m = mean_widths_m(basins, clearance)
    is_door = [
        max(widths_m[p.a], widths_m[p.b]) > config.max_corridor_width_m
        or (gets_wider(p, basins, clearance) and not has_flat_jamb(p, clearance))
        for p in passages
    ]
    labels, doors = joined(basins, passages, is_door, patch.free, least_cells)
    return Segmentation(patch, labels, clearance, doors)


def describe(segmentation: Segmentation, ids: NDArray[np.int64], config: RegionConfig) -> RegionMap:
    """Kinds, areas, outlines and doors of regions; ids (R + 1,): id by number, ids[0] unused."""
    found = segmentation
    cell_m2 = found.patch.frame.resolution**2
    areas = counts_of(found.labels, found.patch.free, len(ids)) * cell_m2
    to_walls = Clearance.of(
        ~found.patch.occupied | (found.clearance.squared > 0), found.patch.frame.resolution
    )
    regions = {}
    for number, box in enumerate(ndimage.find_objects(found.labels), 1):
        if box is None:
            continue
        own = found.labels[box] == number
        clearance = np.where(own, found.clearance.within(box), 0.0)
        if _is_corridor(np.where(own, to_walls.within(box), 0.0), to_walls.resolution_m, config):
            kind = RegionKind.CORRIDOR
        else:
            is_hall = 2.0 * float(clearance.max()) >= config.min_hall_width_m
            kind = RegionKind.HALL if is_hall else RegionKind.ROOM
        low = (box[0].start, box[1].start)
        x, y = _centre(clearance * found.patch.free[box], low, found.patch)
        regions[int(ids[number])] = Region(
            int(ids[number]), kind, x, y, float(areas[number]), _outline(found, number, box)
        )
    # The smallest type: a map keeps them for each cell.
    labels = looked_up(ids.astype(np.min_scalar_type(int(ids.max()))), found.labels)
    return RegionMap(found.patch.frame, labels, regions, _doors(found, ids))


def _outline(found: Segmentation, number: int, box: tuple[slice, ...]) -> Array:
    """Outline (K, 2) of a region and of the free cells between it and its walls, m, map frame."""
    margin = round(WALL_MARGIN_M / found.patch.frame.resolution)
    low = (max(box[0].start - margin, 0), max(box[1].start - margin, 0))
    wider = (slice(low[0], box[0].stop + margin), slice(low[1], box[1].stop + margin))
    labels = found.labels[wider]
    own = labels == number
    if margin:
        beside = own | (found.patch.free[wider] & (labels == 0))
        own = ndimage.binary_dilation(own, _SQUARE, iterations=margin, mask=beside)
    return outline_of(own, found.patch.frame.with_origin_at(*low))


def _is_corridor(to_walls: Array, resolution_m: float, config: RegionConfig) -> bool:
    """Whether a region is one, by the distances (H, W) of its cells from walls, m, 0 outside.

    Discs of the width that a strip of its area and _CORRIDOR_RATIO has cover a room, and leave most
    of a corridor: niches, bends and furniture along walls do not change which.
    """
    inside = to_walls > 0.0
    strip_m = math.sqrt(float(inside.sum()) * resolution_m**2 / _CORRIDOR_RATIO)
    wide = wide_cells(to_walls, min(strip_m, config.max_corridor_width_m), resolution_m)
    return bool(wide[inside].mean() <= 0.5)


def _centre(clearance: Array, low: tuple[int, int], patch: GridPatch) -> tuple[float, float]:
    """Centre of the cell with the largest clearance in a part of a grid that begins at low."""
    cell = np.unravel_index(int(clearance.argmax()), clearance.shape)
    x, y = patch.frame.centres_of(np.array([cell], dtype=np.int64) + low)[0]
    return float(x), float(y)


def _doors(found: Segmentation, ids: NDArray[np.int64]) -> tuple[Door, ...]:
    """The passages that are left between regions, as doors."""
    doors = []
    for passage in found.passages:
        place = np.array([divmod(passage.cell, found.labels.shape[1])], dtype=np.int64)
        x, y = found.patch.frame.centres_of(place)[0]
        ends = (int(ids[passage.a]), int(ids[passage.b]))
        doors.append(Door(*ends, float(x), float(y), passage.width_m))
    return tuple(doors)


class _Memory:
    """Ids of the cells (H, W) of a coarse lattice: remembered, and at the last update.

    Its cells lie on multiples of their edge, so that one map after the other has the same ones.
    changed: since how many updates the ids differ.
    """

    def __init__(
        self,
        frame: GridFrame,
        labels: Labels,
        last: Labels | None = None,
        changed: NDArray[np.int16] | None = None,
    ) -> None:
        self.frame = frame
        self.labels = labels
        self.last = labels if last is None else last
        self._changed = np.zeros(labels.shape, dtype=np.int16) if changed is None else changed

    @staticmethod
    def of(patch: GridPatch) -> '_Memory':
        """Memory of the cells of a map, without any id."""
        edge_m = max(1, round(_STRIDE_M / patch.frame.resolution)) * patch.frame.resolution
        origin = patch.frame.as_array()[:2]
        low = np.floor(origin / edge_m) * edge_m
        end = origin + patch.frame.resolution * np.array(patch.shape[::-1])
        cols, rows = np.ceil((end - low) / edge_m).astype(np.int64).tolist()
        return _Memory(
            GridFrame(float(low[0]), float(low[1]), edge_m), np.zeros((rows, cols), dtype=np.int32)
        )

    def filled(self, other: '_Memory') -> '_Memory':
        """The memory of other cells, on the cells of this one."""
        arrays = (other.labels, other.last, other._changed)
        return _Memory(self.frame, *(self.sampled(array, other.frame) for array in arrays))

    def sampled(self, array: NDArray[Any], frame: GridFrame) -> NDArray[Any]:
        """Values (H, W) at the centres of the cells, of an array on the cells of another frame."""
        ratio = self.frame.resolution / frame.resolution
        low_row = (self.frame.origin_y - frame.origin_y) / frame.resolution
        low_col = (self.frame.origin_x - frame.origin_x) / frame.resolution
        rows = np.floor(low_row + (np.arange(self.labels.shape[0]) + 0.5) * ratio).astype(np.int64)
        cols = np.floor(low_col + (np.arange(self.labels.shape[1]) + 0.5) * ratio).astype(np.int64)
        # A row and a column of zeros stand for all that is outside.
        here = np.ix_(
            np.where((rows >= 0) & (rows < array.shape[0]), rows, -1),
            np.where((cols >= 0) & (cols < array.shape[1]), cols, -1),
        )
        return np.asarray(np.pad(array, ((0, 1), (0, 1)))[here])

    def updated(self, labels: Labels) -> '_Memory':
        """The memory after an update with the ids (H, W); cells in no region keep theirs."""
        changed = np.where((labels == self.labels) | (labels == 0), 0, self._changed + 1)
        is_new = (labels > 0) & ((self.labels == 0) | (changed >= _UPDATES))
        kept = np.where(is_new, labels, self.labels)
        return _Memory(self.frame, kept, labels, np.where(is_new, 0, changed).astype(np.int16))


class RegionTracker:
    """Finds the regions of the present grid; a region keeps the id of the one that it continues.

    An earlier region is continued by the one that overlaps it most; of several that claim the same
    region, the one with the largest overlap. So the larger part keeps the id at a split, and the
    larger region at a merge. No other region ever gets the id.
    Each cell remembers its id until it has had another one for some updates. So a region that is
    merged with another one for a moment, as a door closes, has its id again afterwards.

    names: that people have given, which the regions here do not have yet.
    """

    def __init__(self, config: RegionConfig | None = None) -> None:
        self.config = config or RegionConfig()
        self.regions: RegionMap | None = None
        self.names = RegionNames()
        self._memory: _Memory | None = None
        self._next_id = 1
        self._corrected_ns = -1  # of the map that the names follow; unknown at first

    def update(self, patch: GridPatch) -> RegionMap:
        """Regions of a grid, which need not have the frame or size of the last one."""
        found = segment(patch, self.config)
        memory = _Memory.of(patch)
        memory = memory if self._memory is None else memory.filled(self._memory)
        labels = memory.sampled(found.labels, patch.frame)
        ids = self._ids(labels, int(found.labels.max(initial=0)), memory)
        self.regions = describe(found, ids, self.config)
        self._memory = memory.updated(ids[labels].astype(np.int32))
        return self.regions

    def follow(self, whole: WholeMap) -> None:
        """Move the names as a correction has moved the map."""
        is_next = self._corrected_ns == whole.previous_ns
        if is_next and whole.corrected_ns > self._corrected_ns and len(whole.moved.before):
            self.names.move(MapMotion(*whole.moved))
        self._corrected_ns = whole.corrected_ns

    def skip_ids(self, count: int) -> None:
        """Never assign the next so many ids: they may be in use elsewhere."""
        self._next_id += count

    def state(self) -> dict[str, NDArray[Any]]:
        """Arrays by name, empty before the first update; `from_state` continues from them."""
        memory = self._memory  # another thread may replace it by one of other cells
        if memory is None:
            return {}
        return {
            'region_frame': memory.frame.as_array(),
            'region_labels': np.where(memory.last > 0, memory.last, memory.labels),
            'next_region_id': np.array(self._next_id),
            **self.names.state(),
        }

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: RegionConfig | None = None
    ) -> 'RegionTracker':
        """Tracker that continues from the `state` of another one.

        Its regions are known with the next grid. Raises InputError where it is no such state.
        """
        tracker = RegionTracker(config)
        if not state:
            return tracker
        own = {name: array for name, array in state.items() if name not in region_names.FIELDS}
        checked = snapshot.validate(own, _OWN_FIELDS, 'regions')
        if len(own) < len(state):  # none where they were saved by an earlier version
            named = {name: state[name] for name in state.keys() - own.keys()}
            tracker.names = RegionNames.from_state(named)
        labels = checked['region_labels']
        tracker._next_id = int(checked['next_region_id'])
        if labels.max(initial=0) >= tracker._next_id:
            raise InputError(
                f'saved regions: id {labels.max()}: expected ids below {tracker._next_id}'
            )
        tracker._memory = _Memory(GridFrame(*checked['region_frame'].tolist()), labels)
        return tracker

    def _ids(self, labels: Labels, count: int, memory: _Memory) -> NDArray[np.int64]:
        """Ids (R + 1,) of the regions (H, W) of a memory's cells, by number; count: of regions."""
        ids = np.zeros(1 + count, dtype=np.int64)
        used = {0}
        # What has been new since the last few updates is not remembered yet.
        for number, earlier in [*_claims(labels, memory.labels), *_claims(labels, memory.last)]:
            if ids[number] == 0 and earlier not in used:
                ids[number] = earlier
                used.add(earlier)
        for number in np.flatnonzero(ids == 0)[1:].tolist():
            ids[number] = self._next_id
            self._next_id += 1
        return ids


def _claims(labels: Labels, before: Labels) -> Iterator[tuple[int, int]]:
    """The region (H, W) that overlaps each earlier one (H, W) most, largest overlap first."""
    both = (labels > 0) & (before > 0)
    # A number of 64 bits for each pair: sorted in a tenth of the time.
    pairs = (labels[both].astype(np.int64) << 32) + before[both]
    values, cells = np.unique(pairs, return_counts=True)
    claimed: set[int] = set()
    for pair in values[np.argsort(-cells, kind='stable')].tolist():
        number = pair >> 32
        earlier = pair - (number << 32)
        if earlier not in claimed:
            claimed.add(earlier)
            yield number, earlier
