"""Which cells a robot can stand on, and how far from them the next obstacle is."""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.fields import label, reachable
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.jit import kernel

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]
FAR = 1 << 14  # rows; "nothing in this column"


def select_free_space(
    patch: GridPatch, seed_xy: tuple[float, float] | None, config: TopologyConfig
) -> Mask:
    """Cells on which the robot can stand and that it can reach from the seed, (H, W) bool.

    The rules: a cell counts when its centre is at least the robot's radius from the centre of every
    cell that is not known to be free, so the robot never stands with its body in a wall or in the
    unknown, and the free space ends one radius before the rim of what is known. First, runs of
    unknown cells up to gap_m long between two free cells of a row or column are taken for free:
    specks between beams. Occupied cells count however few they are: a lone one is a pillar until
    the grid takes it back. Cells are joined over edges and corners. seed_xy: x, y in m in the map
    frame; where it is not on such a cell, the nearest one within seed_search_radius_m; none: empty
    selection. Without seed: every part that is larger than the robot itself.
    Source: exploration paper section 2.1, "selection of free space"; rules beyond the papers are
    stated above.
    """
    radius = config.robot_radius_m / patch.frame.resolution
    standing = standing_room(column_distance(known_free(patch, config)), radius)
    if seed_xy is None:
        return without_specks(standing, math.pi * radius**2)
    seed = nearest_cell(standing, patch, seed_xy, config.seed_search_radius_m)
    return reachable(standing, np.empty((0, 2), dtype=np.int64) if seed is None else seed[None])


def known_free(patch: GridPatch, config: TopologyConfig) -> Mask:
    """Free cells (H, W), with unknown gaps up to gap_m between them closed."""
    states = patch.free.astype(np.uint8) + 2 * patch.unknown.astype(np.uint8)
    gap = int(config.max_unknown_gap_m / patch.frame.resolution + 1e-6)
    return _close_gaps(states, gap)


def standing_room(distance: NDArray[np.int16], radius_cells: float) -> Mask:
    """Cells whose centre is at least radius_cells from the centre of each cell that is not free.

    Cells outside are not free.

    distance (H, W): from `column_distance`.
    """
    reach = math.ceil(radius_cells - 1e-9) - 1
    offsets = np.arange(-reach, reach + 1)
    # In a column dx away, anything nearer than this many rows is too near.
    rows = np.sqrt(np.maximum(radius_cells**2 - offsets**2, 0.0))
    need = np.ceil(rows - 1e-9).astype(np.int16)
    return _standing_room(distance, need)


def nearest_cell(
    cells: Mask, patch: GridPatch, xy: tuple[float, float], reach_m: float
) -> Cells | None:
    """The true cell (row, col) nearest to a point, if one lies within reach_m.

    Raises InputError where the point is not finite.
    """
    if not (math.isfinite(xy[0]) and math.isfinite(xy[1])):
        raise InputError(f'seed {xy}: expected finite coordinates')
    centre = patch.frame.cells_of(np.array([xy]))[0]
    if np.all((centre >= 0) & (centre < cells.shape)) and cells[centre[0], centre[1]]:
        own: Cells = centre
        return own
    reach = math.ceil(reach_m / patch.frame.resolution)
    low = np.maximum(centre - reach, 0)
    high = np.maximum(centre + reach + 1, 0)
    found = np.argwhere(cells[low[0] : high[0], low[1] : high[1]]) + low
    if found.size == 0:
        return None
    squared = ((found - centre) ** 2).sum(axis=1)
    best = int(squared.argmin())
    nearest: Cells = found[best]
    return nearest if squared[best] <= reach**2 else None


def without_specks(cells: Mask, smallest: float) -> Mask:
    """Cells without the parts (joined over edges and corners) of fewer than `smallest` cells."""
    labels, sizes = label(cells)
    keep = sizes >= smallest
    keep[0] = False
    return keep[labels]


@kernel
def _close_gaps(states: NDArray[np.uint8], gap: int) -> Mask:
    """Free cells (1), and runs of unknown cells (2) up to `gap` long that lie between free ones."""
    rows, cols = states.shape
    free: Mask = states == 1
    last_free = np.full(cols, -1, dtype=np.int64)
    for row in range(rows):
        left = -1
        for col in range(cols):
            state = states[row, col]
            if state == 1:
                if left >= 0 and 1 < col - left <= gap + 1:
                    free[row, left + 1 : col] = True
                if last_free[col] >= 0 and 1 < row - last_free[col] <= gap + 1:
                    free[last_free[col] + 1 : row, col] = True
                left = col
                last_free[col] = row
            elif state == 0:
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
def squared_clearance(distance: NDArray[np.int16], cells: Cells) -> Cells:
    """Squared distance, in cells, from each cell (N, 2) to the nearest one that is not free.

    Cells outside are not free.

    distance (H, W): from `column_distance`. Searches columns outwards until they are too far to
    matter.
    """
    cols = distance.shape[1]
    squared = np.empty(cells.shape[0], dtype=np.int64)
    for i in range(cells.shape[0]):
        row = cells[i, 0]
        col = cells[i, 1]
        best = np.int64(distance[row, col]) ** 2
        step = 1
        while step * step < best:
            left = np.int64(distance[row, col - step]) if col - step >= 0 else np.int64(0)
            right = np.int64(distance[row, col + step]) if col + step < cols else np.int64(0)
            near = min(left, right)
            best = min(best, step * step + near * near)
            step += 1
        squared[i] = best
    return squared


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
