"""A map of laser points.

For each small cell their mean, and the surface that it makes with its neighbours.

Means keep what an occupancy grid rounds off: a wall's place is known to a fraction of a cell.
Memory is proportional to what was seen: tiles exist only where points fell and hold the numbers of
cells, and only cells with points have one.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.tiles import FARTHEST_TILE, NO_TILE, TILE, TileStore
from thinmap_ros.core.jit import inlined, kernel
from thinmap_ros.core.se2 import FARTHEST_M, Array
from thinmap_ros.core.snapshot import Field

# What a cell holds: points counted, their mean (m, map frame), the unit normal of the surface
# there, towards where it was seen from, how loose the surface is: 0 a wall, up to 1 clutter,
# UNFORMED where there are too few points; points whose beams were dense; and how far the robot had
# come when it last saw the cell, m.
COUNT, MEAN_X, MEAN_Y, CENTRE_X, CENTRE_Y, NORMAL_X, NORMAL_Y, LOOSE, DENSE, SEEN = range(10)
UNFORMED = 2.0
_ROOM = 4096  # cells by which a map begins
_SHIFT, _MASK = 6, TILE - 1
_FEWEST_CELLS = 3
DENSE_M = 0.3  # gap between neighbouring beams up to which points show more than a plane
_MOST_WEIGHT = 4.0  # of a cell's mean, in points: walls are not flat to the millimetre
_REACH, _NEAR = 8, 4  # cells to each side that are asked for a wall, and for clutter
_NOISE_M = 0.01  # of a point, 1 sigma; what lies together closer than this (1 sigma) is one wall
_THIN_M = 0.02  # what is wider than this (1 sigma) and no wall is clutter
_BAND_M = 0.025  # what is farther from a line through a cell is no part of that cell's wall
_DIRECTIONS = 16  # in which walls through a cell are looked for at first
_NORMALS = np.array(
    [(math.cos(a), math.sin(a)) for a in (math.pi * k / _DIRECTIONS for k in range(_DIRECTIONS))]
)
_TILT_RAD = math.radians(2.0)  # doubt of a normal (1 sigma) above which it says nothing
_FIRM = 4.0  # points that clutter has to consist of
_MOST_POINTS = 1e9
_ABOUT_1 = 1.0 + 1e-5  # what rounding may make of 1
FIELDS = {
    'cell_m': Field(np.float64, (), 1e-3, 10.0),
    'cells': Field(np.int64, ('p', 2), -FARTHEST_TILE * TILE, FARTHEST_TILE * TILE),
    # as the columns from COUNT to SEEN; infinite where a cell was taken over from a session
    'points': Field(
        np.float32,
        ('p', 10),
        (0, *(4 * (-FARTHEST_M,)), -_ABOUT_1, -_ABOUT_1, 0, 0, -math.inf),
        (_MOST_POINTS, *(4 * (FARTHEST_M,)), _ABOUT_1, _ABOUT_1, 2, _MOST_POINTS, math.inf),
    ),
}


class PointMap:
    """Points by cell; `cells[tiles.pool[slot, row, col]]` is a cell; number 0 stands for none."""

    def __init__(self, cell_m: float, most: float) -> None:
        """cell_m: edge of a cell; most: points that a cell's mean remembers.

        So the mean follows what moved.
        """
        self.cell_m = cell_m
        self.tiles = TileStore(np.int32)
        self.cells: NDArray[np.float32] = np.zeros((_ROOM, SEEN + 1), dtype=np.float32)
        self._used = 1
        self._most = most
        # How far the robot has come, and where on its way the cells that count were last seen, m.
        self.way_m, self.since_m = 0.0, -math.inf

    @property
    def corner(self) -> NDArray[np.int64]:
        """Cell (row, col) at which the directory of tiles begins, (2,)."""
        return np.array([self.tiles.first_row, self.tiles.first_col], dtype=np.int64) * TILE

    def add(self, points_map: Array, seen_from: Array) -> None:
        """Take in points (N, 2) seen from a place (2,), all in the map frame.

        Cells that do not count begin anew. Raises InputError where points are nowhere on earth or
        the map would get too large; the map is then as it was.
        """
        if len(points_map) == 0:
            return
        if not np.abs(points_map).max() <= FARTHEST_M:
            raise InputError(
                f'points up to {np.abs(points_map).max():g} m away: too far to be mapped'
            )
        cells = np.floor(points_map[:, ::-1] / self.cell_m).astype(np.int64)
        tiles = _once(cells // TILE)
        low, high = tiles.min(axis=0), tiles.max(axis=0)
        self.tiles.reach(int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        self.tiles.ensure(tiles)
        cells -= self.corner
        self._reserve(len(cells))
        dense = gaps(points_map) < DENSE_M
        limits = (self._most, self.way_m, self.since_m)
        chart = (self.cells, self.tiles.pool, self.tiles.directory)
        self._used = _add(*chart, self._used, cells, points_map, dense, seen_from, limits)

    def _reserve(self, count: int) -> None:
        """Have room for so many more cells."""
        if self._used + count > len(self.cells):
            longer = np.zeros(
                (len(self.cells) + max(len(self.cells) // 2, count), SEEN + 1), dtype=np.float32
            )
            longer[: self._used] = self.cells[: self._used]
            self.cells = longer

    def state(self) -> dict[str, NDArray[Any]]:
        """All that the map holds as arrays by name.

        Its cells (N, 2) as (row, col), and what they hold (N, 10).
        """
        numbers = self.tiles.pool[: self.tiles.used]
        at = np.argwhere(numbers > 0)
        cells = self.tiles.places()[at[:, 0]] * TILE + at[:, 1:]
        order = np.lexsort(cells.T[::-1])
        points = self.cells[numbers[at[:, 0], at[:, 1], at[:, 2]]]
        return {'cell_m': np.array(self.cell_m), 'cells': cells[order], 'points': points[order]}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take up the `state` of another map, into an empty one.

        However far the robot comes, its cells count.

        state: checked by FIELDS. Raises InputError where its cells are of another size, or lie too
        far apart for one map.
        """
        cell_m = float(state['cell_m'])
        cells = state['cells']
        points = state['points'].copy()
        expected = f'{self.cell_m} m'
        snapshot.require(cell_m == self.cell_m, f'map of points: cells of {cell_m} m', expected)
        if not len(cells):
            return
        tiles = _once(cells // TILE)
        low, high = tiles.min(axis=0), tiles.max(axis=0)
        self.tiles.reach(int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        self.tiles.ensure(tiles)
        rows, cols = (cells - self.corner).T
        once = np.unique(rows * self.tiles.directory.shape[1] * TILE + cols)
        snapshot.require(len(once) == len(cells), 'map of points: cells', 'each once')
        slots = self.tiles.directory[rows // TILE, cols // TILE]
        points[:, SEEN] = np.inf
        self._reserve(len(points))
        numbers = self._used + np.arange(len(points), dtype=np.int32)
        self.tiles.pool[slots, rows % TILE, cols % TILE] = numbers
        self.cells[numbers] = points
        self._used += len(points)


def gaps(points: Array) -> Array:
    """Distance (N,) of each point, in the order of the beams, from the nearer of its neighbours.

    Inf for one alone.
    """
    steps = np.hypot(*np.diff(points, axis=0).T)
    return np.asarray(np.minimum(np.append(steps, np.inf), np.append(np.inf, steps)))


def _once(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """The different ones of cells (N, 2)."""
    row, col = cells.min(axis=0)
    width = int(cells[:, 1].max() - col) + 1
    numbers = np.unique((cells[:, 0] - row) * width + cells[:, 1] - col)
    return np.stack([numbers // width + row, numbers % width + col], axis=1)


@inlined
def slot_of(directory: NDArray[np.int32], row: int, col: int) -> int:
    """Slot of the tile of a cell, counted from the directory's first cell, or NO_TILE."""
    tile_row, tile_col = row >> _SHIFT, col >> _SHIFT
    if (
        tile_row < 0
        or tile_col < 0
        or tile_row >= directory.shape[0]
        or tile_col >= directory.shape[1]
    ):
        return NO_TILE
    return int(directory[tile_row, tile_col])


@kernel
def _add(
    cells: NDArray[np.float32],
    tiles: NDArray[np.int32],
    directory: NDArray[np.int32],
    used: int,
    places: NDArray[np.int64],
    points: Array,
    dense: NDArray[np.bool_],
    seen_from: Array,
    limits: tuple[float, float, float],
) -> int:
    """Count the points into the cells at their places, then form the surface of each touched.

    used: the first number that no cell has yet; returns it as it is then.
    limits: the most points that a cell remembers, where on its way the robot is, and where cells
    that count were seen.
    """
    most, way, since = limits
    numbers = np.empty(points.shape[0], dtype=np.int32)
    for i in range(points.shape[0]):
        row, col = places[i, 0], places[i, 1]
        slot = directory[row >> _SHIFT, col >> _SHIFT]
        if tiles[slot, row & _MASK, col & _MASK] == 0:
            tiles[slot, row & _MASK, col & _MASK] = used
            used += 1
        numbers[i] = tiles[slot, row & _MASK, col & _MASK]
        cell = cells[numbers[i]]
        if cell[SEEN] < since:
            cell[COUNT], cell[DENSE] = 0.0, 0.0
        cell[SEEN] = max(np.float64(cell[SEEN]), way)
        cell[COUNT] = min(cell[COUNT] + 1.0, most)
        cell[DENSE] += dense[i]
        cell[MEAN_X] += (points[i, 0] - cell[MEAN_X]) / cell[COUNT]
        cell[MEAN_Y] += (points[i, 1] - cell[MEAN_Y]) / cell[COUNT]
    near = np.empty(((2 * _REACH + 1) ** 2, 3))
    for i in range(points.shape[0]):
        if i > 0 and numbers[i] == numbers[i - 1]:
            continue
        row, col = places[i, 0], places[i, 1]
        x, y, nx, ny, loose = _surface(cells, tiles, directory, row, col, near, seen_from, since)
        cell = cells[numbers[i]]
        if nx * (seen_from[0] - cell[MEAN_X]) + ny * (seen_from[1] - cell[MEAN_Y]) < 0.0:
            nx, ny = -nx, -ny
        cell[CENTRE_X], cell[CENTRE_Y] = cell[MEAN_X] + x, cell[MEAN_Y] + y
        cell[NORMAL_X], cell[NORMAL_Y], cell[LOOSE] = nx, ny, loose
    return used


@kernel
def _gather(
    cells: NDArray[np.float32],
    tiles: NDArray[np.int32],
    directory: NDArray[np.int32],
    row: int,
    col: int,
    near: Array,
    seen_from: Array,
    since: float,
) -> tuple[int, float]:
    """Write the means around a cell, seen from its own, and their weights into near (N, 3).

    Returns how many, and how firm.

    Walls seen only from their other side are left out: the two faces of a thin wall are two
    surfaces.
    """
    base = cells[tiles[slot_of(directory, row, col), row & _MASK, col & _MASK]]
    number, firm = 0, 0.0
    for r in range(row - _REACH, row + _REACH + 1):
        slot, last_tile = NO_TILE, -1
        for c in range(col - _REACH, col + _REACH + 1):
            if c >> _SHIFT != last_tile:
                slot, last_tile = slot_of(directory, r, c), c >> _SHIFT
            if slot == NO_TILE:
                continue
            at = tiles[slot, r & _MASK, c & _MASK]
            if at == 0:
                continue
            cell = cells[at]
            if cell[SEEN] < since:
                continue
            to_x, to_y = seen_from[0] - cell[MEAN_X], seen_from[1] - cell[MEAN_Y]
            away = cell[NORMAL_X] * to_x + cell[NORMAL_Y] * to_y
            if (r == row and c == col) or cell[LOOSE] > 0.0 or away >= 0.0:
                near[number, 0] = cell[MEAN_X] - base[MEAN_X]
                near[number, 1] = cell[MEAN_Y] - base[MEAN_Y]
                near[number, 2] = min(cell[COUNT], _MOST_WEIGHT)
                number += 1
                if abs(r - row) <= _NEAR and abs(c - col) <= _NEAR:
                    firm += min(cell[DENSE], _MOST_WEIGHT)
    return number, firm


@kernel
def _line(
    near: Array, nx: float, ny: float
) -> tuple[float, float, float, float, float, float, int]:
    """Centre, normal, variance across and weighted variance along of the means in a band.

    near (N, 3): means and weights; the band has the normal (nx, ny) and goes through their origin,
    and (0, 0) stands for no band. Last: how many.
    """
    cells, count, sx, sy, sxx, sxy, syy = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(near.shape[0]):
        dx, dy, weight = near[k, 0], near[k, 1], near[k, 2]
        if abs(nx * dx + ny * dy) > _BAND_M:
            continue
        cells += 1
        count += weight
        sx += weight * dx
        sy += weight * dy
        sxx += weight * dx * dx
        sxy += weight * dx * dy
        syy += weight * dy * dy
    xx, xy, yy = sxx - sx * sx / count, sxy - sx * sy / count, syy - sy * sy / count
    spread = math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    across, along = max(0.5 * (xx + yy) - spread, 0.0) / count, 0.5 * (xx + yy) + spread
    angle = 0.5 * math.atan2(-2.0 * xy, yy - xx)
    return sx / count, sy / count, math.cos(angle), math.sin(angle), across, along, cells


@kernel
def _direction(near: Array) -> tuple[float, float]:
    """Normal of the band through the origin in which most of the means (N, 3) lie."""
    best, best_x, best_y = -1.0, 1.0, 0.0
    for k in range(_DIRECTIONS):
        nx, ny = _NORMALS[k, 0], _NORMALS[k, 1]
        total = 0.0
        for i in range(near.shape[0]):
            if abs(nx * near[i, 0] + ny * near[i, 1]) <= _BAND_M:
                total += near[i, 2]
        if total > best:
            best, best_x, best_y = total, nx, ny
    return best_x, best_y


@kernel
def _surface(
    cells: NDArray[np.float32],
    tiles: NDArray[np.int32],
    directory: NDArray[np.int32],
    row: int,
    col: int,
    near: Array,
    seen_from: Array,
    since: float,
) -> tuple[float, float, float, float, float]:
    """Centre, normal, looseness of what the means around a cell make; near (M, 3): room for them.

    Where they do not make one wall, as beside a door or in a corner, the wall through the cell is
    looked for: a surface fitted to both sides of a corner would pull all points that come near it
    aside. What belongs to no wall is a point, loose in all directions.
    """
    number, firm = _gather(cells, tiles, directory, row, col, near, seen_from, since)
    if number < _FEWEST_CELLS:
        return 0.0, 0.0, 1.0, 0.0, UNFORMED
    near = near[:number]
    x, y, nx, ny, across, along, count = _line(near, 0.0, 0.0)
    width = across
    if across > _NOISE_M**2:
        nx, ny = _direction(near)
        for _ in range(2):
            x, y, nx, ny, across, along, count = _line(near, nx, ny)
    if count >= _FEWEST_CELLS and max(across, _NOISE_M**2) <= along * _TILT_RAD**2:
        return x, y, nx, ny, 0.0
    if width <= _THIN_M**2 or firm < _FIRM:
        return x, y, nx, ny, UNFORMED
    return 0.0, 0.0, nx, ny, 1.0
