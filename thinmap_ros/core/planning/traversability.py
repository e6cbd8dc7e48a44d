"""Traversable and reachable cells."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.fields import reachable
from thinmap_ros.core.grid.patch import OCCUPIED_AT_LEAST, Bounds, GridFrame, GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.thinning import column_distance, standing_room
from thinmap_ros.jit import kernel

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]


def traversable_cells(free: Mask, radius_m: float, resolution: float) -> Mask:
    """Cells (H, W) in which the centre of a robot of a radius may be.

    All cells that are not free count as obstacles.
    """
    return standing_room(column_distance(free), radius_m / resolution)


def update_traversable_cells(
    standing: Mask, free: Mask, part: Bounds, radius_m: float, resolution: float
) -> None:
    """Update traversable cells (H, W), in place, where free cells have changed within a part."""
    reach = math.ceil(radius_m / resolution) + 1
    top = max(part[0] - reach, 0)
    left = max(part[1] - reach, 0)
    bottom = part[2] + reach
    right = part[3] + reach
    # A margin is read as well, so that the edge of the part does not act as a wall.
    wide = free[max(top - reach, 0) : bottom + reach, max(left - reach, 0) : right + reach]
    found = traversable_cells(np.ascontiguousarray(wide), radius_m, resolution)
    row = top - max(top - reach, 0)
    col = left - max(left - reach, 0)
    renewed = standing[top:bottom, left:right]
    renewed[:] = found[row : row + renewed.shape[0], col : col + renewed.shape[1]]


def escape_cells(
    standing: Mask,
    free: Mask,
    frame: GridFrame,
    xy: tuple[float, float],
    escape_distance_m: float,
    trail: Cells | None = None,
) -> Mask:
    """Traversable cells (H, W) for a robot at a point (m), including an escape from a collision.

    A robot closer to obstacles than its radius may cross free cells up to escape_distance_m away.
    trail: cells (N, 2) of its recent path; it may return over those that are free.
    """
    allowed = standing.copy()
    if trail is not None:
        allowed[trail[:, 0], trail[:, 1]] |= free[trail[:, 0], trail[:, 1]]
    row, col = (int(v) for v in frame.cells_of(np.array([xy]))[0])
    if not (0 <= row < free.shape[0] and 0 <= col < free.shape[1]) or standing[row, col]:
        return allowed
    part, within = disc(allowed, (row, col), escape_distance_m / frame.resolution)
    allowed[part] |= within & free[part]
    allowed[row, col] = True
    return allowed


def reachable_cells(allowed: Mask, start: tuple[int, int]) -> Mask:
    """Allowed cells (H, W) that are reachable from a start (row, col), with 8-connectivity.

    No cells if the start is outside the mask.
    """
    if not (0 <= start[0] < allowed.shape[0] and 0 <= start[1] < allowed.shape[1]):
        return np.zeros_like(allowed)
    return reachable(allowed, np.array([start]))


def nearest_true(allowed: Mask, cell: tuple[int, int], reach: float) -> tuple[int, int] | None:
    """The true cell nearest to a cell, or None if there is none within `reach` cells."""
    whole = math.floor(reach)
    top = max(cell[0] - whole, 0)
    left = max(cell[1] - whole, 0)
    part = allowed[top : max(cell[0] + whole + 1, 0), left : max(cell[1] + whole + 1, 0)]
    near = np.argwhere(part) + (top, left)
    squared = np.square(near - cell).sum(axis=1)
    if near.size == 0 or squared.min() > reach * reach:
        return None
    best = near[squared.argmin()]
    return int(best[0]), int(best[1])


def path_collides(patch: GridPatch, path: Array, radius_m: float) -> bool:
    """Whether an occupied cell is closer to a path (K, 2), m, map frame, than a radius."""
    frame = patch.frame
    at = (frame.origin_x, frame.origin_y, frame.resolution)
    return bool(_collides(patch.cells, at, path, radius_m / frame.resolution - 1e-6))


def disc(
    of: NDArray[Any], centre: tuple[int, int], reach: float
) -> tuple[tuple[slice, slice], Mask]:
    """The part of an array (H, W) around a cell, and the mask of its cells within reach."""
    whole = math.ceil(reach)
    rows = slice(max(centre[0] - whole, 0), min(centre[0] + whole + 1, of.shape[0]))
    cols = slice(max(centre[1] - whole, 0), min(centre[1] + whole + 1, of.shape[1]))
    row, col = np.ogrid[rows, cols]
    return (rows, cols), np.asarray(np.hypot(row - centre[0], col - centre[1]) <= reach)


@kernel
def _collides(
    cells: NDArray[np.int8], frame: tuple[float, float, float], path: Array, radius: float
) -> bool:
    """Whether an occupied cell of a map (H, W) is within a radius, cells, of a path (K, 2), m.

    frame: origin x, origin y and resolution of the map, m.
    """
    reach = int(math.ceil(radius))
    last_row = -1
    last_col = -1
    for k in range(path.shape[0]):
        row = int(math.floor((path[k, 1] - frame[1]) / frame[2]))
        col = int(math.floor((path[k, 0] - frame[0]) / frame[2]))
        if row == last_row and col == last_col:
            continue
        last_row = row
        last_col = col
        for r in range(max(row - reach, 0), min(row + reach + 1, cells.shape[0])):
            for c in range(max(col - reach, 0), min(col + reach + 1, cells.shape[1])):
                if (
                    cells[r, c] >= OCCUPIED_AT_LEAST
                    and (r - row) ** 2 + (c - col) ** 2 < radius * radius
                ):
                    return True
    return False
