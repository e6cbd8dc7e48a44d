"""Occupancy grid: log odds of each cell, updated by Bayes' rule from laser scans."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.grid.raytrace import axis_setup
from thinmap_ros.core.grid.tiles import TILE, TileStore
from thinmap_ros.core.jit import inlined, kernel
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

# Log odds are kept as whole thousandths in int16: small, exact to add, and the same on every machine.
_SCALE = 1000.0
_LIMIT = 6000
_FREE, _HIT, _SURFACE = 1, 2, 4
# Three neighbouring beams show one surface if the middle range is this near to what the others foretell, m.
_FLAT_M = 0.06
_LONGEST_SURFACE_M = 3.0


@dataclass(frozen=True)
class OccupancyConfig(Config):
    """Parameters of the grid and of the laser's inverse sensor model."""

    resolution_m: float = parameter(0.10, 'edge of a cell, m', low=0.01, high=1.0)
    p_free: float = parameter(0.35, 'probability of occupied after a beam passed through', low=0.01, high=0.49)
    p_occupied: float = parameter(0.80, 'probability of occupied after a beam ended there', low=0.51, high=0.99)
    p_lowest: float = parameter(0.05, 'clamp: no cell gets surer of being free', low=0.003, high=0.4)
    p_highest: float = parameter(0.97, 'clamp: no cell gets surer of being occupied', low=0.6, high=0.997)
    usable_range_m: float = parameter(30.0, 'farther hits only free the way up to here, m', low=0.5, high=200.0)
    no_return_range_m: float = parameter(
        8.0, 'a beam without return frees up to here (0: nothing), m', low=0.0, high=200.0
    )
    surface_depth_m: float = parameter(
        0.03, 'what a beam met fills the cell this far behind the measured surface, m', low=0.0, high=0.5
    )


def log_odds(probability: float) -> float:
    """Log odds ln(p / (1 - p))."""
    return math.log(probability / (1.0 - probability))


class OccupancyGrid:
    """A map of any extent, in tiles that exist only where something was seen.

    The inverse sensor model: cells along a beam are free, its end is occupied, nothing is said of what lies
    beyond. The end is taken surface_depth_m behind the measured surface, where the solid is: with a wall on the border
    of two cells, noise would otherwise fill the free one in front of it half the time. Each cell is counted once a
    scan, and a cell in which any beam of the scan ends counts as occupied. Beams that graze a wall pass through the
    cells in which it stands, long before they end: a cell on the line between the ends of neighbouring beams that lie
    on one surface is therefore never counted as free.
    Source: topological map paper section 2.1 (binary local map), exploration paper section 2.1 (Bayes update).
    """

    def __init__(self, config: OccupancyConfig | None = None, frame: GridFrame | None = None) -> None:
        self.config = config or OccupancyConfig()
        self.frame = frame or GridFrame(0.0, 0.0, self.config.resolution_m)
        if self.frame.resolution != self.config.resolution_m:
            raise InputError(
                f'map with {self.frame.resolution} m a cell: expected {self.config.resolution_m} m (resolution_m)'
            )
        self._tiles = TileStore()
        self._percent = _percent_table()
        self._marks: NDArray[np.uint8] = np.zeros((1, 1), dtype=np.uint8)
        steps = [self.config.p_free, self.config.p_occupied, self.config.p_lowest, self.config.p_highest]
        self._steps = np.array([round(_SCALE * log_odds(p)) for p in steps], dtype=np.int64)

    @staticmethod
    def from_patch(patch: GridPatch, config: OccupancyConfig | None = None) -> 'OccupancyGrid':
        """Grid that goes on from a finished map; its cells keep their places.

        Raises InputError where the map's resolution is not that of the configuration.
        """
        grid = OccupancyGrid(config, patch.frame)
        clamped = np.clip(patch.cells / 100.0, grid.config.p_lowest, grid.config.p_highest)
        odds = np.round(_SCALE * np.log(clamped / (1.0 - clamped))).astype(np.int16)
        grid._tiles.write(0, 0, np.where(patch.cells == UNKNOWN, 0, odds).astype(np.int16))
        return grid

    def state(self) -> dict[str, NDArray[Any]]:
        """All that the grid knows, exactly, as arrays by name; `from_state` makes the same grid of it."""
        return {
            'frame': self.frame.as_array(),
            'tiles': self._tiles.places(),
            'log_odds': self._tiles.pool[: self._tiles.used].copy(),
        }

    @staticmethod
    def from_state(state: Mapping[str, NDArray[Any]], config: OccupancyConfig | None = None) -> 'OccupancyGrid':
        """Grid that goes on from the `state` of another. Raises InputError where it is no such state."""
        try:
            frame, tiles, odds = (state[key] for key in ('frame', 'tiles', 'log_odds'))
            origin_x, origin_y, resolution = frame.astype(np.float64).tolist()
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f'saved grid: {error}: expected frame, tiles and log_odds') from error
        if tiles.shape != (len(odds), 2) or odds.shape[1:] != (TILE, TILE) or odds.dtype != np.int16:
            raise InputError(f'saved grid: {tiles.shape} tiles, {odds.shape} log odds: expected one array a tile')
        if np.abs(odds.astype(np.int64)).max(initial=0) > _LIMIT:
            raise InputError(f'saved grid: log odds up to {np.abs(odds).max()}: expected at most {_LIMIT}')
        grid = OccupancyGrid(config, GridFrame(origin_x, origin_y, resolution))
        for (row, col), cells in zip(tiles.tolist(), odds, strict=True):
            grid._tiles.write(row * TILE, col * TILE, cells)
        return grid

    def update(self, scan: Scan, T_map_base: Array) -> None:
        """Take in a scan made at a robot pose T_map_base (3,)."""
        T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
        reach, ends_in_hit = self._beams(scan)
        if not reach.any() or not se2.is_finite(T_map_laser):
            return
        x = (T_map_laser[0] - self.frame.origin_x) / self.frame.resolution
        y = (T_map_laser[1] - self.frame.origin_y) / self.frame.resolution
        radius = int(reach.max()) + 2
        row, col = math.floor(y) - radius, math.floor(x) - radius
        shift = (2 * radius).bit_length()
        marks = self._cleared_marks(1 << shift)
        angles, surface = scan.angles_rad + T_map_laser[2], _surfaces(scan, ends_in_hit)
        touched = _mark(marks, shift, x - col, y - row, angles, reach, ends_in_hit, surface)
        self._make_tiles(row, col, shift, touched)
        tiles = self._tiles
        corner = (row - tiles.first_row * TILE, col - tiles.first_col * TILE)
        _apply(tiles.pool, tiles.directory, *corner, marks, shift, touched, self._steps)

    def window(self, x: float, y: float, size_m: float) -> GridPatch:
        """Square of size_m around a point, aligned with the cells, copied out of the tiles it touches."""
        count = max(1, round(size_m / self.frame.resolution))
        row, col = self.frame.cells_of(np.array([[x, y]]))[0] - count // 2
        return self._cut(int(row), int(col), count, count)

    def patch(self) -> GridPatch:
        """The smallest rectangle that holds all that is known; one unknown cell where nothing is."""
        bounds = self._tiles.bounds()
        if bounds is None:
            return self._cut(0, 0, 1, 1)
        row, col, end_row, end_col = bounds
        known = self._tiles.read(row, col, end_row - row, end_col - col) != 0
        rows, cols = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
        if rows.size == 0:
            return self._cut(0, 0, 1, 1)
        height, width = rows[-1] - rows[0] + 1, cols[-1] - cols[0] + 1
        return self._cut(row + int(rows[0]), col + int(cols[0]), int(height), int(width))

    def _cut(self, row: int, col: int, rows: int, cols: int) -> GridPatch:
        odds = self._tiles.read(row, col, rows, cols)
        return GridPatch(self.frame.shifted(row, col), self._percent[odds.astype(np.int64) + _LIMIT])

    def _beams(self, scan: Scan) -> tuple[Array, NDArray[np.bool_]]:
        """How far each beam reaches, in cells (0: says nothing), and whether it ends in something."""
        usable = self.config.usable_range_m
        hits = scan.hit & (scan.ranges_m < usable)
        reach = np.where(scan.hit, np.minimum(scan.ranges_m + self.config.surface_depth_m * hits, usable), 0.0)
        without_return = min(self.config.no_return_range_m, scan.range_max_m, usable)
        return np.where(scan.no_return, without_return, reach) / self.frame.resolution, hits

    def _cleared_marks(self, size: int) -> NDArray[np.uint8]:
        """Scratch of at least the asked size; it is kept between scans, and `_apply` leaves it cleared."""
        if self._marks.shape[0] != size:
            self._marks = np.zeros((size, size), dtype=np.uint8)
        return self._marks

    def _make_tiles(self, row: int, col: int, shift: int, touched: NDArray[np.int64]) -> None:
        first, last = (row // TILE, col // TILE), ((row + (1 << shift)) // TILE, (col + (1 << shift)) // TILE)
        self._tiles.reach(*first, *last)
        needed = np.zeros((last[0] - first[0] + 1, last[1] - first[1] + 1), dtype=np.bool_)
        _flag_tiles(needed, touched, shift, row - first[0] * TILE, col - first[1] * TILE)
        self._tiles.ensure(np.argwhere(needed) + first)


def _surfaces(scan: Scan, ends_in_hit: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether one surface goes from the end of each beam to that of the next, (N,); never after the last."""
    surface = np.zeros(scan.ranges_m.size, dtype=np.bool_)
    if surface.size < 3:
        return surface
    # On a straight line 1 / range is a sine of the bearing: the two outer ranges foretell the one between, also where
    # the wall is grazed and its points lie almost behind each other.
    ranges = np.where(ends_in_hit, scan.ranges_m, 1.0)
    before, between, after = ranges[:-2], ranges[1:-1], ranges[2:]
    foretold = 2.0 * math.cos(scan.angle_increment_rad) * before * after / (before + after)
    hits = ends_in_hit[:-2] & ends_in_hit[1:-1] & ends_in_hit[2:]
    flat = hits & (np.abs(between - foretold) < _FLAT_M) & (np.abs(after - before) < _LONGEST_SURFACE_M)
    surface[:-2] |= flat
    surface[1:-1] |= flat
    return surface


def _percent_table() -> NDArray[np.int8]:
    """Occupancy in percent for each log odds from -_LIMIT to _LIMIT; exactly 0 is a cell never seen."""
    odds = np.arange(-_LIMIT, _LIMIT + 1) / _SCALE
    table = np.round(100.0 / (1.0 + np.exp(-odds))).astype(np.int8)
    table[_LIMIT] = UNKNOWN
    return table


@inlined
def _stroke(
    cells: NDArray[np.uint8],
    shift: int,
    start: tuple[float, float],
    end: tuple[float, float],
    mark: int,
    touched: NDArray[np.int64],
    count: int,
) -> int:
    """Mark the cells from one point (x, y) to another, without the last; returns the length of the list `touched`."""
    d_x, d_y = end[0] - start[0], end[1] - start[1]
    length = max(math.sqrt(d_x * d_x + d_y * d_y), 1e-9)
    col, step_x, next_x, delta_x = axis_setup(start[0], d_x / length)
    row, step_y, next_y, delta_y = axis_setup(start[1], d_y / length)
    index = (row << shift) + col
    step_y *= 1 << shift
    # As many border crossings as rows and columns lie between, so no test for the end; the choice of the next border
    # is written without a branch, because the processor could only guess it.
    for _ in range(abs(int(math.floor(end[1])) - row) + abs(int(math.floor(end[0])) - col)):
        touched[count] = index
        count += cells[index] == 0
        cells[index] |= mark
        across = next_x < next_y
        index += step_x if across else step_y
        next_x += delta_x if across else 0.0
        next_y += 0.0 if across else delta_y
    return count


@kernel
def _mark(
    marks: NDArray[np.uint8],
    shift: int,
    x: float,
    y: float,
    angles: Array,
    reach: Array,
    ends_in_hit: NDArray[np.bool_],
    surface: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Mark each cell that a scan speaks of as passed, hit, or on a surface, and list the marked cells once each.

    marks (S, S): zeros, S = 2**shift, large enough for every beam; x, y, reach: in cells of `marks`; surface (N,):
    whether one surface goes from the end of a beam to that of the next. Returns flat indices, which a power of two as
    row length makes cheap to take apart.
    """
    cells = marks.ravel()
    touched = np.empty(cells.size + 1, dtype=np.int64)
    count = 0
    last = (x, y)
    for i in range(angles.size):
        if reach[i] <= 0.0:
            continue
        end = (x + reach[i] * math.cos(angles[i]), y + reach[i] * math.sin(angles[i]))
        count = _stroke(cells, shift, (x, y), end, _FREE, touched, count)
        index = (int(math.floor(end[1])) << shift) + int(math.floor(end[0]))
        touched[count] = index
        count += cells[index] == 0
        cells[index] |= _HIT if ends_in_hit[i] else _FREE
        if i > 0 and surface[i - 1]:
            count = _stroke(cells, shift, last, end, _SURFACE, touched, count)
        last = end
    return touched[:count]


@kernel
def _flag_tiles(
    needed: NDArray[np.bool_], touched: NDArray[np.int64], shift: int, row: int, col: int
) -> None:
    """Flag the tiles in which the listed cells lie; (row, col): cell (0, 0) of the marks from the first tile on."""
    mask = (1 << shift) - 1
    for index in touched:
        needed[(row + (index >> shift)) // TILE, (col + (index & mask)) // TILE] = True


@kernel
def _apply(
    pool: NDArray[np.int16],
    directory: NDArray[np.int32],
    row: int,
    col: int,
    marks: NDArray[np.uint8],
    shift: int,
    touched: NDArray[np.int64],
    steps: NDArray[np.int64],
) -> None:
    """Add the log odds of each marked cell, clamped, and clear its mark.

    (row, col): cell (0, 0) of the marks, counted from the directory's first cell on; never negative within it.
    """
    cells = marks.ravel()
    mask = (1 << shift) - 1
    for index in touched:
        cell_row, cell_col = row + (index >> shift), col + (index & mask)
        slot = directory[cell_row // TILE, cell_col // TILE]
        hit, surface = cells[index] & _HIT, cells[index] & _SURFACE
        cells[index] = 0
        if surface and not hit:
            continue
        odds = pool[slot, cell_row % TILE, cell_col % TILE] + (steps[1] if hit else steps[0])
        # 0 is kept for cells never seen: a cell that comes back to even odds stays a thousandth off.
        odds = 1 if odds == 0 else odds
        pool[slot, cell_row % TILE, cell_col % TILE] = min(max(odds, steps[2]), steps[3])
