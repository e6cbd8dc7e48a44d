"""Free space of a map, and its skeleton by Zhang-Suen thinning, both at once."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.config import MAX_ROBOT_RADIUS_M
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.grid.fields import label, looked_up, nearest_true, reachable
from thinmap_ros.core.grid.patch import FREE_AT_MOST, OCCUPIED_AT_LEAST, GridPatch
from thinmap_ros.core.se2 import Array, Cells, Mask
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.jit import inlined, kernel

FAR = 1 << 14  # rows; "nothing in this column"

# States of cells.
UNKNOWN = 0
FREE = 1
OCCUPIED = 2

VIEW_M = 3.0  # beyond, whatever ends a view is no part of the place
_DEPTH_M = 0.25  # less of the unknown is specks between beams, and the fringe before walls
_BESIDE_M = 0.15  # of a wall: a hole between beams of 2 degrees at 8 m is twice as wide
# What ends a view.
UNKNOWN_END = 1
_WALL = 2
_ISLAND_M2 = 2.0
_ISLAND_SHARE = 0.05  # of the largest part


def select_free_space(
    patch: GridPatch, seed_xy: tuple[float, float] | Array | None, config: TopologyConfig
) -> Mask:
    """Cells on which the robot can stand and that it can reach from the seed, (H, W) bool.

    The rules: a cell counts when its centre is at least the robot's radius from the centre of every
    cell that is not known to be free, so the robot never stands with its body in a wall or in the
    unknown, and the free space ends one radius before the rim of what is known. First, runs of
    unknown cells up to gap_m long between two free cells of a row or column are taken for free:
    specks between beams. Occupied cells count however few they are: a lone one is a pillar until
    the grid takes it back. Cells are joined over edges and corners. seed_xy: x, y in m in the map
    frame, or several such places (N, 2); where one is not on such a cell, the nearest one within
    seed_search_radius_m; none: empty selection. Without seed: every part that is larger than the
    robot itself.
    Source: exploration paper section 2.1, "selection of free space"; rules beyond the papers are
    stated above. Raises InputError where the seed is not finite.
    """
    radius = config.robot_radius_m / patch.frame.resolution
    standing = standing_room(known_free(patch, config), radius)
    if seed_xy is None:
        return _without_small(*label(standing), math.pi * radius**2)
    places = np.atleast_2d(seed_xy)
    if not np.isfinite(places).all():
        raise InputError(f'seed {seed_xy}: expected finite coordinates')
    reach = math.ceil(config.seed_search_radius_m / patch.frame.resolution)
    cells = patch.frame.cells_of(places).tolist()
    nearest = [nearest_true(standing, (row, col), reach) for row, col in cells]
    seeds = [seed for seed in nearest if seed is not None]
    return reachable(standing, np.array(seeds, dtype=np.int64).reshape(-1, 2))


def beyond_radius(config: TopologyConfig, resolution: float) -> TopologyConfig:
    """Configuration of a robot that stays farther from obstacles than its radius, as Nav2 demands.

    Nav2's inflation layer calls a cell inscribed, and refuses it, whose centre is up to the radius,
    included, from that of an obstacle. Squared distances between centres, in cells, are whole
    numbers: the next one above the radius is the radius to be at least away, up to the largest
    radius of a robot.
    """
    squared = math.floor((config.robot_radius_m / resolution) ** 2 + 1e-6) + 1
    radius_m = min(resolution * math.sqrt(squared), MAX_ROBOT_RADIUS_M)
    return replace(config, robot_radius_m=radius_m)


def known_free(patch: GridPatch, config: TopologyConfig) -> Mask:
    """Free cells (H, W), with unknown gaps up to max_unknown_gap_m between them closed."""
    return close_gaps(states_of(patch.cells), gap_cells(config, patch.frame.resolution))


def states_of(percent: NDArray[np.int8]) -> NDArray[np.uint8]:
    """State of each cell (H, W) of a map."""
    is_free = (percent >= 0) & (percent <= FREE_AT_MOST)
    return np.uint8(FREE) * is_free + np.uint8(OCCUPIED) * (percent >= OCCUPIED_AT_LEAST)


def gap_cells(config: TopologyConfig, resolution: float) -> int:
    """Longest unknown gap between free cells that counts as free, in cells."""
    return int(config.max_unknown_gap_m / resolution + 1e-6)


def standing_room(free: Mask, radius_cells: float) -> Mask:
    """Cells (H, W) whose centre is at least radius_cells from that of each that is not free.

    Cells outside are not free.
    """
    return room_of_columns(column_distance(free), radius_cells)


def room_of_columns(distance: NDArray[np.int16], radius_cells: float) -> Mask:
    """As `standing_room`, from the `column_distance` (H, W) of the free cells."""
    reach = math.ceil(radius_cells - 1e-9) - 1
    offsets = np.arange(-reach, reach + 1)
    # In a column dx away, anything nearer than this many rows is too near.
    rows = np.sqrt(np.maximum(radius_cells**2 - offsets**2, 0.0))
    need = np.ceil(rows - 1e-9).astype(np.int16)
    return _standing_room(distance, need)


def _without_small(labels: NDArray[np.int32], sizes: Cells, smallest: float) -> Mask:
    """Cells without the parts (joined over edges and corners) of fewer than `smallest` cells."""
    keep = sizes >= smallest
    keep[0] = False
    return looked_up(keep, labels)


def without_islands(standing: Mask, resolution: float) -> Mask:
    """Traversable cells (H, W) without small parts: insides of furniture, slivers beyond walls.

    Small is below 2 m2 and below 5 % of the largest part; resolution: edge of a cell, m.
    """
    labels, sizes = label(standing)
    largest = float(sizes[1:].max(initial=0))
    smallest = min(_ISLAND_M2 / resolution**2, _ISLAND_SHARE * largest)
    return _without_small(labels, sizes, smallest)


def view_ends(patch: GridPatch) -> NDArray[np.uint8]:
    """What ends a view in each cell (H, W): a wall, the unknown, or, 0, nothing.

    Walls that a cheap laser draws have holes: unknown cells beside a wall count as wall, others
    only where they are deep.
    """
    depth = _DEPTH_M / 2.0 / patch.frame.resolution
    core = standing_room(patch.unknown, depth)
    deep = patch.unknown & ~standing_room(~core, depth)
    beside = _BESIDE_M / patch.frame.resolution
    margin = math.ceil(beside)  # cells outside are no walls
    no_wall = np.pad(~patch.occupied, margin, constant_values=True)
    apart = standing_room(no_wall, beside)[margin:-margin, margin:-margin]
    walls = patch.occupied | (patch.unknown & ~apart)
    return np.where(walls, np.uint8(_WALL), UNKNOWN_END * deep.astype(np.uint8))


@kernel
def view_from(
    ends: NDArray[np.uint8], row: int, col: int, reach: float, directions: int
) -> tuple[int, int]:
    """Directions in which a view from a cell ends at a wall, and in the unknown, within a reach.

    ends (H, W): from `view_ends`; reach in cells. The end of the map is neither: it may be cut out
    of a larger one.
    """
    walls = 0
    unknown = 0
    for k in range(directions):
        end = end_of_view(ends, row, col, reach, 2.0 * math.pi * k / directions)
        walls += end == _WALL
        unknown += end == UNKNOWN_END
    return walls, unknown


@inlined
def end_of_view(ends: NDArray[np.uint8], row: int, col: int, reach: float, angle: float) -> int:
    """What ends a view from a cell in a direction, rad, within a reach; see `view_from`."""
    sine = math.sin(angle)
    cosine = math.cos(angle)
    away = 0.0
    while away < reach:
        r = int(math.floor(row + 0.5 + away * sine))
        c = int(math.floor(col + 0.5 + away * cosine))
        if not (0 <= r < ends.shape[0] and 0 <= c < ends.shape[1]):
            break
        if ends[r, c] != 0:
            return int(ends[r, c])
        away += 0.5
    return 0


@kernel
def close_gaps(states: NDArray[np.uint8], gap: int) -> Mask:
    """Free cells (H, W), and runs of unknown cells up to `gap` long that lie between free ones."""
    rows, cols = states.shape
    free: Mask = states == FREE
    last_free = np.full(cols, -1, dtype=np.int64)
    for row in range(rows):
        left = -1
        for col in range(cols):
            state = states[row, col]
            if state == FREE:
                if left >= 0 and 1 < col - left <= gap + 1:
                    free[row, left + 1 : col] = True
                if last_free[col] >= 0 and 1 < row - last_free[col] <= gap + 1:
                    free[last_free[col] + 1 : row, col] = True
                left = col
                last_free[col] = row
            elif state == OCCUPIED:
                left = -1
                last_free[col] = -1
    return free


@kernel
def column_distance(free: Mask) -> NDArray[np.int16]:
    """Rows from each cell to the nearest one in its column that is not free (0 there).

    Cells outside are not free.
    """
    rows, cols = free.shape
    distance = np.zeros((rows, cols), dtype=np.int16)
    for row in range(rows):
        for col in range(cols):
            above = distance[row - 1, col] if row > 0 else np.int16(0)
            distance[row, col] = min(above + 1, FAR) if free[row, col] else 0
    for row in range(rows - 1, -1, -1):
        for col in range(cols):
            below = distance[row + 1, col] if row < rows - 1 else np.int16(0)
            distance[row, col] = min(distance[row, col], below + 1)
    return distance


@kernel
def _standing_room(distance: NDArray[np.int16], need: NDArray[np.int16]) -> Mask:
    rows, cols = distance.shape
    reach = need.size // 2
    room = np.zeros((rows, cols), dtype=np.bool_)
    for row in range(rows):
        # Counted from 0, so that the compiler sees that no index is negative.
        for col in range(cols - 2 * reach):
            room[row, col + reach] = distance[row, col + reach] > 0
        for k in range(need.size):
            for col in range(cols - 2 * reach):
                room[row, col + reach] &= distance[row, col + k] >= need[k]
    return room


@kernel
def true_cells(mask: Mask) -> Cells:
    """The true cells (N, 2) of a mask (H, W), row after row."""
    # Room for all; the system provides only what is written to.
    cells = np.empty((mask.size, 2), dtype=np.int64)
    count = 0
    for row in range(mask.shape[0]):
        for col in range(mask.shape[1]):
            if mask[row, col]:
                cells[count, 0] = row
                cells[count, 1] = col
                count += 1
    return cells[:count].copy()


KEPT = 32767  # deletion time of the cells of the skeleton

Words = NDArray[np.uint64]

Times = NDArray[np.int16]

Index = np.uintp  # unsigned: compiled code then asks no question about indices below zero

_WORD = 64
_LANES = 4  # words that processors work on at once
_BAND = 8  # rows that are looked at together
# Where in a band: in its first row, in any, in its last
_TOP = 0
_ANY = 1
_BOTTOM = 2


def thin(free: Mask) -> Mask:
    """Skeleton of the free cells: the cells that Zhang and Suen's two sub-iterations leave.

    free (H, W) bool; returns (H, W) bool, the input is not touched. Cells outside the array count
    as not free. All deletions of a sub-iteration happen at once; the two alternate until neither
    deletes a cell.
    Source: topological map paper section 2.1, steps 1 and 2 (S(p1) counted cyclically, p2 p3 ... p9
    p2). Raises InputError where it is no array (H, W) of truth values or whole numbers.
    """
    free = np.asarray(free)
    if free.ndim != 2 or free.dtype.kind not in 'biu':
        raise InputError(f'free = {quoted(free)}: expected an array (H, W) of bool')
    words, stride = _pack(np.ascontiguousarray(free, dtype=np.bool_))
    _thin_words(words, stride, np.empty((0, 0), dtype=np.int16))
    return _unpack(words, stride, free.shape)


def deletion_times(free: Mask) -> Times:
    """Sub-iteration that deletes each cell (H, W), from 1 on; KEPT in the skeleton, else 0.

    free (H, W) bool, see `thin`.
    """
    words, stride = _pack(np.ascontiguousarray(free, dtype=np.bool_))
    times = np.where(free, np.int16(KEPT), np.int16(0))
    _thin_words(words, stride, times)
    return times


def _pack(free: Mask) -> tuple[Words, int]:
    """Rows as words inside a margin of empty ones, one after the other; and the words of a row.

    Bit i of word w is column 64 w + i. Some more empty words follow, so that whole lanes may be
    read at the end.
    """
    rows, cols = free.shape
    count = -(-cols // _WORD)
    padded = np.zeros((rows, count * _WORD), dtype=np.bool_)
    padded[:, :cols] = free
    words = np.zeros((rows + 2) * (count + 2) + _LANES, dtype=np.uint64)
    inner = words[:-_LANES].reshape(rows + 2, count + 2)[1:-1, 1:-1]
    inner[:] = np.packbits(padded, axis=1, bitorder='little').view('<u8')
    return words, count + 2


def _unpack(words: Words, stride: int, shape: tuple[int, ...]) -> Mask:
    inner = words[:-_LANES].reshape(-1, stride)[1:-1, 1:-1]
    in_bytes = np.ascontiguousarray(inner).astype('<u8').view(np.uint8)
    return np.unpackbits(in_bytes, axis=1, count=shape[1], bitorder='little').view(np.bool_)


@inlined
def _find(
    words: Words, first: Index, count: Index, stride: Index, north: bool, deleted: Words
) -> None:
    """Bits that a sub-iteration deletes in some words of a row.

    Conditions (a) to (d) for 64 cells at once.

    north: the first sub-iteration, which keeps what (c) and (d) say of p2 p4 p6 and p4 p6 p8; else
    the second.
    """
    one = np.uint64(1)
    top = np.uint64(63)
    step = Index(1)
    for k in range(count):
        at = first + k
        p2 = words[at - stride]
        p1 = words[at]
        p6 = words[at + stride]
        p3 = (p2 >> one) | (words[at - stride + step] << top)
        p4 = (p1 >> one) | (words[at + step] << top)
        p5 = (p6 >> one) | (words[at + stride + step] << top)
        p9 = (p2 << one) | (words[at - stride - step] >> top)
        p8 = (p1 << one) | (words[at - step] >> top)
        p7 = (p6 << one) | (words[at + stride - step] >> top)
        # S = 1 by counting the rises 0 -> 1 up to two: `some` has one or more, `many` two or more.
        some = ~p2 & p3
        many = np.uint64(0)
        for rise in (~p3 & p4, ~p4 & p5, ~p5 & p6, ~p6 & p7, ~p7 & p8, ~p8 & p9, ~p9 & p2):
            many |= some & rise
            some |= rise
        # Where S = 1 the neighbours are one run of ones and one of zeros. 2 <= N <= 6 says that
        # both are longer than 1, which is to say that in each there is a neighbour over an edge and
        # one over a corner.
        pair = (p2 | p4 | p6 | p8) & (p3 | p5 | p7 | p9)
        gap = ~((p2 & p4 & p6 & p8) | (p3 & p5 & p7 & p9))
        kept = p4 & p6 & (p2 | p8) if north else p2 & p8 & (p4 | p6)
        deleted[at] = p1 & some & ~many & pair & gap & ~kept


@kernel
def _thin_words(words: Words, stride: int, times: Times) -> None:
    """Delete in place, `stride` words a row, until nothing changes.

    times (H, W): the sub-iteration of each deletion is written into it, unless it is empty.

    A cell is looked at only when one beside it, or itself, changed in one of the last two
    sub-iterations: before that, the same sub-iteration has already seen these very cells and left
    them. Rows are looked at in bands, from the first to the last column of words with such a cell,
    so that the compiler can treat several words at a time.
    """
    rows = (words.size - _LANES) // stride - 2
    bands = -(-rows // _BAND)
    deleted = np.zeros(words.size, dtype=np.uint64)
    # Of the last two sub-iterations: bands (from 1 on) that changed;
    # first column of the changes there, and their end.
    active = np.empty((2, bands), dtype=np.int64)
    counts = np.zeros(2, dtype=np.int64)
    first = np.full((2, bands + 2, 3), stride, dtype=np.int64)
    end = np.zeros((2, bands + 2, 3), dtype=np.int64)
    first[:, 1:-1] = 1
    end[:, 1:-1] = stride - 1
    active[:] = np.arange(1, bands + 1)
    counts[:] = bands
    stamps = np.full(bands + 2, -1, dtype=np.int64)
    due = np.empty((bands, 3), dtype=np.int64)
    turn = 0
    while counts[0] + counts[1] > 0:
        total = 0
        for which in range(2):
            for middle in active[which, : counts[which]]:
                for band in range(max(middle - 1, 1), min(middle + 2, bands + 1)):
                    if stamps[band] < turn:
                        stamps[band] = turn
                        due[total, 0] = band
                        due[total, 1], due[total, 2] = _columns(first, end, band, stride)
                        total += due[total, 1] < due[total, 2]
        for i in range(total):
            band = due[i, 0]
            low = due[i, 1]
            high = due[i, 2]
            count = Index((high - low + _LANES - 1) // _LANES * _LANES)
            for row in range((band - 1) * _BAND + 1, min(band * _BAND, rows) + 1):
                if turn % 2 == 0:
                    _find(words, Index(row * stride + low), count, Index(stride), True, deleted)
                else:
                    _find(words, Index(row * stride + low), count, Index(stride), False, deleted)
        which = turn % 2
        for band in active[which, : counts[which]]:
            first[which, band] = stride
            end[which, band] = 0
        counts[which] = 0
        for i in range(total):
            band = due[i, 0]
            low = due[i, 1]
            high = due[i, 2]
            rim = (band - 1) * _BAND + 1, min(band * _BAND, rows)
            if times.size > 0:
                _record(deleted, stride, rim, (low, high), times, min(turn + 1, KEPT - 1))
            _delete_band(
                words, deleted, stride, rim, (low, high), first[which, band], end[which, band]
            )
            active[which, counts[which]] = band
            counts[which] += end[which, band, _ANY] > 0
        turn += 1


@inlined
def _columns(first: Cells, end: Cells, band: int, stride: int) -> tuple[int, int]:
    """First column of words, and their end, that changes touch in a band or the rows next to it."""
    low = stride
    high = 0
    for which in range(2):
        low = min(
            low,
            first[which, band - 1, _BOTTOM],
            first[which, band, _ANY],
            first[which, band + 1, _TOP],
        )
        high = max(
            high, end[which, band - 1, _BOTTOM], end[which, band, _ANY], end[which, band + 1, _TOP]
        )
    return max(low - 1, 1), min(high + 1, stride - 1)


@inlined
def _record(
    deleted: Words,
    stride: int,
    rim: tuple[int, int],
    columns: tuple[int, int],
    times: Times,
    time: int,
) -> None:
    """Write the time of the bits that are deleted in some columns of a band."""
    for row in range(rim[0], rim[1] + 1):
        for word in range(columns[0], columns[1]):
            bits = deleted[row * stride + word]
            if bits == 0:
                continue
            for bit in range(_WORD):
                if (bits >> np.uint64(bit)) & np.uint64(1):
                    times[row - 1, (word - 1) * _WORD + bit] = time


@inlined
def _delete_band(
    words: Words,
    deleted: Words,
    stride: int,
    rim: tuple[int, int],
    columns: tuple[int, int],
    first: Cells,
    end: Cells,
) -> None:
    """Delete bits in some columns of a band, rows rim[0] to rim[1].

    Notes which columns change in `first` and `end`.
    """
    for row in range(rim[0], rim[1] + 1):
        changed = _delete(words, deleted, row * stride, columns[0], columns[1])
        _widen(first, end, _ANY, changed)
        if row == rim[0]:
            _widen(first, end, _TOP, changed)
        if row == rim[1]:
            _widen(first, end, _BOTTOM, changed)


@inlined
def _delete(words: Words, deleted: Words, row_start: int, low: int, high: int) -> tuple[int, int]:
    """Delete bits in some columns of a row.

    Returns the first column that changes, and the end of those.
    """
    while low < high and deleted[row_start + low] == 0:
        low += 1
    while low < high and deleted[row_start + high - 1] == 0:
        high -= 1
    for at in range(Index(row_start + low), Index(row_start + high)):
        words[at] &= ~deleted[at]
    return low, high


@inlined
def _widen(first: Cells, end: Cells, place: int, columns: tuple[int, int]) -> None:
    if columns[0] < columns[1]:
        first[place] = min(first[place], columns[0])
        end[place] = max(end[place], columns[1])
