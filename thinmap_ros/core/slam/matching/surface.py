"""Surface points of a scan, and of the walls of an occupancy map, for scan matching.

Normals and spacing of those of a scan are estimated from neighbouring beams.
Only neighbouring beams on the same surface determine a normal: the last beam of one wall and the
first of the next are neighbours in the scan, but not in space. A point without a neighbour on its
surface is left out, because the position of a single hit changes with the robot's.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.occupancy import OccupancyConfig
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import inlined, kernel

COLUMNS = 5  # of surface points: x, y, double angle of the normal (cosine, sine), spacing
WINDOW_M = 0.15  # nearer neighbours are on the same surface and determine its normal
_RANGE_NOISE_M = 0.02  # 1 sigma: points with no more scatter lie on a plane
_ALIGNED = 0.8  # smallest squared cosine between two steps along one surface
_ALIKE = 9.0  # largest squared ratio of their lengths


def surface_points(scan: Scan) -> Array:
    """Surface points (N, 5) of a scan, robot frame, in the order of the beams.

    Columns: x, y; cosine and sine of twice the angle of the surface normal, shortened if the
    neighbours scatter by more than the range noise; spacing of the points, m.
    """
    return _surface(scan.points_base(), np.flatnonzero(scan.hit))


@inlined
def _are_aligned(ax: float, ay: float, bx: float, by: float) -> bool:
    """Whether two steps along a scan have similar directions and lengths."""
    a = ax * ax + ay * ay
    b = bx * bx + by * by
    dot = ax * bx + ay * by
    return dot > 0.0 and dot * dot > _ALIGNED * a * b and max(a, b) < _ALIKE * min(a, b)


@kernel
def _links(points: Array, beams: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each point (N + 1,) lies on the same surface as its predecessor."""
    n = len(points)
    linked = np.zeros(n + 1, dtype=np.bool_)
    for k in range(1, n):
        if beams[k] - beams[k - 1] != 1:
            continue
        dx = points[k, 0] - points[k - 1, 0]
        dy = points[k, 1] - points[k - 1, 1]
        linked[k] = dx * dx + dy * dy < WINDOW_M * WINDOW_M
        for m in (k - 1, k + 1):
            if 1 <= m < n and beams[m] - beams[m - 1] == 1:
                ex = points[m, 0] - points[m - 1, 0]
                ey = points[m, 1] - points[m - 1, 1]
                linked[k] |= _are_aligned(dx, dy, ex, ey)
    return linked


@kernel
def _surface(points: Array, beams: NDArray[np.int64]) -> Array:
    """Surface points (M, 5) of the points (N, 2) of beams (N,) that have a neighbour."""
    linked = _links(points, beams)
    found = np.empty((len(points), COLUMNS))
    used = 0
    for i in range(len(points)):
        m = 1
        mx = 0.0
        my = 0.0
        xx = 0.0
        xy = 0.0
        yy = 0.0
        gap = np.inf
        for side in (-1, 1):
            k = i
            while linked[k if side < 0 else k + 1]:
                k += side
                dx = points[k, 0] - points[i, 0]
                dy = points[k, 1] - points[i, 1]
                m = m + 1
                mx = mx + dx
                my = my + dy
                xx = xx + dx * dx
                xy = xy + dx * dy
                yy = yy + dy * dy
                away = math.hypot(dx, dy)
                gap = min(gap, away)
                if away >= WINDOW_M:
                    break
        if m == 1:
            continue
        mx = mx / m
        my = my / m
        xx = xx / m - mx * mx
        xy = xy / m - mx * my
        yy = yy / m - my * my
        spread = math.hypot(0.5 * (xx - yy), xy)
        across = max(0.5 * (xx + yy) - spread - _RANGE_NOISE_M * _RANGE_NOISE_M, 0.0)
        along = 0.5 * (xx + yy) + spread
        length = (along - across) / max((along + across) * spread, 1e-12)
        found[used, 0] = points[i, 0]
        found[used, 1] = points[i, 1]
        found[used, 2] = -length * 0.5 * (xx - yy)
        found[used, 3] = -length * xy
        found[used, 4] = gap
        used += 1
    return found[:used]


# (row, col) from an occupied cell to the free one beside it.
_SIDES = ((0, 1), (0, -1), (1, 0), (-1, 0))


class WallFaces(NamedTuple):
    """Points (N, 2) on walls, m, map frame, in order along each wall, and their normal (2,)."""

    points: Array
    normal: Array


def occupied_surface_points(patch: GridPatch) -> list[WallFaces]:
    """Points on the faces between occupied and free cells, for each of the four directions.

    A beam occupies the cell that is surface_thickness_m behind its end. So the surface is on
    average half a cell, less that depth, behind the face of the cell.
    """
    depth_m = max(0.5 * patch.frame.resolution - OccupancyConfig().surface_thickness_m, 0.0)
    return [_faces(patch, row, col, depth_m) for row, col in _SIDES]


def free_cells(patch: GridPatch, cell_m: float) -> tuple[NDArray[np.bool_], int, int]:
    """Cells of a lattice with cells of cell_m that an occupancy map knows to be free.

    Returns them as (H, W), and row and column of the first one.
    """
    frame = patch.frame
    row, rows = _nearest(frame.origin_y, patch.shape[0], frame.resolution, cell_m)
    col, cols = _nearest(frame.origin_x, patch.shape[1], frame.resolution, cell_m)
    return patch.free[rows][:, cols], row, col


def _nearest(
    origin_m: float, count: int, resolution_m: float, cell_m: float
) -> tuple[int, NDArray[np.int64]]:
    """Cells of a lattice, along an axis, whose centres lie in a map with `count` cells.

    The map begins at an origin. Returns the first one, and the cell (N,) of the map at each.
    """
    first = math.ceil(origin_m / cell_m - 0.5)
    end = math.ceil((origin_m + count * resolution_m) / cell_m - 0.5)
    centres = (np.arange(first, end) + 0.5) * cell_m
    indices = np.floor((centres - origin_m) / resolution_m).astype(np.int64)
    return first, np.clip(indices, 0, count - 1)


def _faces(patch: GridPatch, row: int, col: int, depth_m: float) -> WallFaces:
    """Faces of the occupied cells towards a free neighbour at the offset (row, col)."""
    rows, cols = patch.shape
    free = np.zeros((rows, cols), dtype=np.bool_)
    here = (slice(max(-row, 0), rows - max(row, 0)), slice(max(-col, 0), cols - max(col, 0)))
    there = (slice(max(row, 0), rows - max(-row, 0)), slice(max(col, 0), cols - max(-col, 0)))
    free[here] = patch.free[there]
    cells = _along(np.argwhere(patch.occupied & free), row)
    edge = patch.frame.resolution
    side = np.array([col, row], dtype=np.float64)
    middles = patch.frame.centres_of(cells) + (0.5 * edge - depth_m) * side
    along = 0.25 * edge * np.abs(side[::-1])
    points = np.stack([middles - along, middles + along], axis=1).reshape(-1, 2)
    return WallFaces(points, side)


def _along(cells: NDArray[np.int64], row: int) -> NDArray[np.int64]:
    """Cells (N, 2) in order along the walls: along rows if row is not 0, or else along columns."""
    order = (
        np.lexsort((cells[:, 1], cells[:, 0])) if row else np.lexsort((cells[:, 0], cells[:, 1]))
    )
    return cells[order]
