"""Zhang-Suen thinning of a map that changes: for each cell, the sub-iteration that deletes it.

A cell c is deleted at sub-iteration t = 1, 2, ... if it was not deleted before and the rule of t
(odd: step 1, even: step 2) holds for those of its neighbours that exist at t: the ones with a
deletion time of t or later. So the deletion times T solve, cell by cell,

    T(c) = min { t >= 1 : rule(t, {n : T(n) >= t}) },

KEPT where there is no such t, 0 if the cell is not free.

Whether c is deleted at t depends only on which neighbours were deleted *before* t. Hence the
solution is unique, it is exactly that of thinning the whole map at once, and after a change it is
repaired in causal order: of all cells at which T and the right-hand side differ, take the one at
which they first differ in time. All earlier times are final, so this cell gets its value, and only
its neighbours can be inconsistent now, at later times. The order is that of LPA* (Koenig, Likhachev
and Furcy, 2004) and of Ramalingam and Reps, 1996; causality takes the place of monotony. The
skeleton is the cells with T = KEPT.
Source: topological map paper section 2.1, steps 1 and 2.
"""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.fields import strips
from thinmap_ros.core.grid.tiles import TILE
from thinmap_ros.core.se2 import Cells
from thinmap_ros.core.topology.layers.lattice import (
    Lattice,
    cell_of,
    cells_at,
    find_neighbours,
    moved,
    rows_and_cols,
    tiles_around,
)
from thinmap_ros.core.topology.thinning import KEPT, deletion_times
from thinmap_ros.jit import inlined, kernel

_NEVER = 1 << 20
_BUCKETS = 1 << 12  # times up to here are processed in order; later ones only take longer
# Many flipped cells are thinned with those around them at once, where these are at most so many
# cells for each; the repair of one costs as much.
_AROUND = 64  # cells
_WORTH = 256


def _delays() -> NDArray[np.int64]:
    """[t & 1, neighbours as bits]: sub-iterations from t until the rule holds; _NEVER."""
    deletes = np.zeros((2, 256), dtype=np.bool_)
    for code in range(256):
        p = [code >> k & 1 for k in range(8)]  # p2 ... p9
        rises = sum(p[k] < p[(k + 1) % 8] for k in range(8))
        if 2 <= sum(p) <= 6 and rises == 1:
            deletes[1, code] = p[0] * p[2] * p[4] == 0 and p[2] * p[4] * p[6] == 0
            deletes[0, code] = p[0] * p[2] * p[6] == 0 and p[0] * p[4] * p[6] == 0
    return np.where(deletes, 0, np.where(deletes[::-1], 1, _NEVER)).astype(np.int64)


_DELAYS = _delays()


def update_skeleton(lattice: Lattice, flipped: Cells) -> Cells:
    """Repair the deletion times after cells (N,) became traversable, or ceased to be.

    Returns the cells that enter or leave the skeleton, each once. They are not changed yet, so that
    what was traced along the old skeleton can be removed.
    """
    begun, due = _thin_around(lattice, flipped)
    touched = np.concatenate((begun, _repair(lattice, due)))
    return _skeleton_changes(lattice, tiles_around(lattice, touched, 2))


def _thin_around(lattice: Lattice, flipped: Cells) -> tuple[Cells, Cells]:
    """Thin the rectangle of many flipped cells (N,) at once, as far as it knows.

    Returns the cells whose time changed, and those that are to be repaired: all of whose times the
    rectangle does not know, or the flipped ones where these are few.
    """
    if not flipped.size:
        return flipped, flipped
    places = rows_and_cols(lattice, flipped)
    row, col = (places.min(axis=0) - _AROUND).tolist()
    rows, cols = (np.ptp(places, axis=0) + 1 + 2 * _AROUND).tolist()
    if flipped.size * _WORTH < rows * cols:
        return flipped[:0], flipped
    at = cells_at(lattice, np.argwhere(np.ones((rows, cols), dtype=np.bool_)) + (row, col))
    times = deletion_times(lattice.cells['free'][at].astype(np.bool_).reshape(rows, cols))
    return _take_times(lattice, times, at.reshape(rows, cols))


@kernel
def _take_times(lattice: Lattice, times: NDArray[np.int16], places: Cells) -> tuple[Cells, Cells]:
    """Set the times of a rectangle (H, W) of cells, 0 where there is none, where they hold.

    A time depends on the cells that are at most so many steps away: it holds where these lie in the
    rectangle. Elsewhere only that it is later than that is known. Returns the cells whose time
    changed, and those whose time is not known.
    """
    cells = lattice.cells
    rows, cols = times.shape
    changed = np.empty(times.size, dtype=np.int64)
    unknown = np.empty(times.size, dtype=np.int64)
    changes = 0
    count = 0
    for i in range(rows):
        for j in range(cols):
            at = places[i, j]
            if at == 0:
                continue
            steps = min(i, j, rows - 1 - i, cols - 1 - j)
            if (times[i, j] <= steps or cells[at]['time'] <= steps) and (
                times[i, j] != cells[at]['time']
            ):
                cells[at]['time'] = times[i, j]
                changed[changes] = at
                changes += 1
            if cells[at]['time'] > steps:
                unknown[count] = at
                count += 1
    return changed[:changes].copy(), unknown[:count].copy()


def skeleton_cells(lattice: Lattice, times: NDArray[np.int16], row: int, col: int) -> Cells:
    """Cells of the skeleton by the deletion times (H, W) of all cells, the first at (row, col)."""
    places = [np.empty((0, 2), dtype=np.int64)]
    for strip in strips(len(times)):
        # With the next row, for squares of 2 x 2 cells that vanish at once.
        part = times[strip.start : strip.stop + 1]
        first = part[:-1, :-1]
        square = (first > 0) & (first < KEPT) & (first == part[1:, 1:])
        square &= (first == part[1:, :-1]) & (first == part[:-1, 1:])
        found = np.concatenate((np.argwhere(times[strip] == KEPT), np.argwhere(square)))
        places.append(found + (row + strip.start, col))
    return _kept_of(lattice, cells_at(lattice, np.concatenate(places)))


@kernel
def _kept_of(lattice: Lattice, cells: Cells) -> Cells:
    """The cells among some (N,) that belong to the skeleton by the deletion times."""
    found = np.empty(cells.size, dtype=np.int64)
    count = 0
    for at in cells:
        if _is_kept(lattice, at):
            found[count] = at
            count += 1
    return found[:count].copy()


@inlined
def _deletion_time(lattice: Lattice, at: int, near: Cells) -> int:
    """Sub-iteration that deletes a cell, by the times of its neighbours; near (8,): scratch."""
    cells = lattice.cells
    if not cells[at]['free']:
        return 0
    find_neighbours(lattice, at, near)
    for k in range(8):
        near[k] = cells[near[k]]['time']
    t = 1
    while True:
        code = 0
        following = KEPT
        for k in range(8):
            if near[k] >= t:
                code |= 1 << k
                following = min(following, int(near[k]))
        due = t + int(_DELAYS[t & 1, code])
        if due <= following:
            return due
        if following == KEPT:
            return KEPT
        t = following + 1


@kernel
def _repair(lattice: Lattice, flipped: Cells) -> Cells:
    """Make the times consistent again; returns the cells whose time changed, some repeatedly."""
    cells = lattice.cells
    first = np.full(_BUCKETS, -1, dtype=np.int64)
    queue = np.empty((4 * flipped.size + 1024, 2), dtype=np.int64)  # cell, next of its bucket
    touched = np.empty(4 * flipped.size + 1024, dtype=np.int64)
    near = np.empty(8, dtype=np.int64)
    queued = 0
    for at in flipped:
        queued = _enqueue(first, queue, queued, at, 0)
    changes = 0
    now = 0
    last = 0
    while now <= last:
        entry = first[now]
        if entry < 0:
            now += 1
            continue
        first[now] = -1
        done = changes
        while entry >= 0:
            at = queue[entry, 0]
            entry = queue[entry, 1]
            time = _deletion_time(lattice, at, near)
            if time == cells[at]['time']:
                continue
            if queue.shape[0] == queued:
                queue = np.concatenate((queue, np.empty_like(queue)))
            key = _first_difference(time, cells[at]['time'])
            if key > now:  # a neighbour has changed since: they differ only later now
                queued = _enqueue(first, queue, queued, at, key)
                last = max(last, key)
                continue
            if time > cells[at]['time']:
                # Not deleted now; when it will be is not final. Until it is, it counts as kept:
                # with its present estimate two cells could postpone each other again and again.
                cells[at]['time'] = KEPT
                if time < KEPT:
                    queued = _enqueue(first, queue, queued, at, time)
                    last = max(last, time)
            else:
                cells[at]['time'] = time
            if changes == touched.size:
                touched = np.concatenate((touched, np.empty_like(touched)))
            touched[changes] = at
            changes += 1
        beside = _beside(lattice, touched[done:changes], now)
        while queue.shape[0] - queued < beside.size:
            queue = np.concatenate((queue, np.empty_like(queue)))
        for to in beside:
            cells[to]['due'] = False
            time = _deletion_time(lattice, to, near)
            if time != cells[to]['time']:
                key = _first_difference(time, cells[to]['time'])
                queued = _enqueue(first, queue, queued, to, key)
                last = max(last, key)
    return touched[:changes].copy()


@kernel
def _beside(lattice: Lattice, changed: Cells, now: int) -> Cells:
    """Cells beside changed ones that are not deleted by now, each once; they are marked as due."""
    found = np.empty(8 * changed.size, dtype=np.int64)
    near = np.empty(8, dtype=np.int64)
    count = 0
    for at in changed:
        find_neighbours(lattice, at, near)
        for to in near:
            if lattice.cells[to]['time'] > now and not lattice.cells[to]['due']:
                lattice.cells[to]['due'] = True
                found[count] = to
                count += 1
    return found[:count]


@inlined
def _first_difference(time: int, other: int) -> int:
    """First sub-iteration in which it matters which of two times a cell has."""
    return min(int(time), int(other), _BUCKETS - 1)


@inlined
def _enqueue(first: Cells, queue: Cells, queued: int, at: int, key: int) -> int:
    queue[queued, 0] = at
    queue[queued, 1] = first[key]
    first[key] = queued
    return queued + 1


@inlined
def _is_kept(lattice: Lattice, at: int) -> bool:
    """Whether a cell is kept, or is the first of four cells that were all that was left of a part.

    The paper's rules delete a square of 2 x 2 cells at once; nothing else vanishes completely.
    """
    cells = lattice.cells
    time = cells[at]['time']
    if time == KEPT or time == 0:
        return bool(time == KEPT)
    return bool(
        cells[moved(lattice, at, 0, 1)]['time'] == time
        and cells[moved(lattice, at, 1, 0)]['time'] == time
        and _is_last_square(lattice, at)
    )


@kernel
def _is_last_square(lattice: Lattice, at: int) -> bool:
    """Whether four cells from this one on have its time, and the cells around them earlier ones."""
    cells = lattice.cells
    time = cells[at]['time']
    for row in range(-1, 3):
        for col in range(-1, 3):
            other = cells[moved(lattice, at, row, col)]['time']
            is_inside = 0 <= row <= 1 and 0 <= col <= 1
            if is_inside and other != time:
                return False
            if not is_inside and other >= time:
                return False
    return True


@kernel
def _skeleton_changes(lattice: Lattice, tiles: Cells) -> Cells:
    """Cells of tiles that enter or leave the skeleton by the deletion times."""
    cells = lattice.cells
    found = np.empty(tiles.size * TILE * TILE, dtype=np.int64)
    count = 0
    for slot in tiles:
        for row in range(TILE):
            first = cell_of(slot, row)
            for at in range(first, first + TILE):
                if _is_kept(lattice, at) != cells[at]['kept']:
                    found[count] = at
                    count += 1
    return found[:count].copy()
