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
_TILE_BITS = TILE.bit_length() - 1
# Three neighbouring beams show one surface if the middle range is this near to what the others foretell, m.
_FLAT_M = 0.06
_LONGEST_SURFACE_M = 3.0
# What a beam passes through is no wall; but where it passes through this much of one, it grazes a face of the wall.
_GRAZED_M = 0.4
_SURELY_OCCUPIED = 0.9


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


@dataclass(frozen=True)
class WindowConfig(Config):
    """The part of the map around the robot that a scan changes."""

    window_m: float = parameter(
        16.0, 'edge of the local map around the robot, m: best twice what the laser reaches', low=2.0, high=100.0
    )


class OccupancyGrid:
    """A map of any extent, in tiles that exist only where something was seen.

    The inverse sensor model: cells along a beam are free, its end is occupied, nothing is said of what lies
    beyond. The end is taken surface_depth_m behind the measured surface, where the solid is: with a wall on the border
    of two cells, noise would otherwise fill the free one in front of it half the time. Each cell is counted once a
    scan, and a cell in which any beam of the scan ends counts as occupied. Beams that graze a wall pass through the
    cells in which it stands, long before they end, or without ending there at all. A cell on the line between the ends
    of neighbouring beams that lie on one surface is therefore never counted as free; nor is a cell that is surely
    occupied, as are others in line with it along the beam, for 0.4 m: nothing that thick is looked through. What was
    taken away is still unlearned, by the beams that cross it.
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
        self._marks: NDArray[np.uint8] = np.zeros(1, dtype=np.uint8)
        self._touched: NDArray[np.int64] = np.empty(1, dtype=np.int64)
        self._fan: tuple[int, float, float] = (0, 0.0, 0.0)
        self._cosines = self._sines = np.empty(0)
        self._steps = _steps(self.config)

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
        if scan.ranges_m.size == 0 or not se2.is_finite(T_map_laser):
            return
        resolution, usable = self.frame.resolution, self.config.usable_range_m
        x = (float(T_map_laser[0]) - self.frame.origin_x) / resolution
        y = (float(T_map_laser[1]) - self.frame.origin_y) / resolution
        depth = self.config.surface_depth_m
        longest = min(usable, max(scan.range_max_m + depth, self.config.no_return_range_m))
        radius = math.ceil(longest / resolution) + 2
        row, col, shift = math.floor(y) - radius, math.floor(x) - radius, (2 * radius).bit_length()
        marks, touched = self._scratch(shift)
        cosines, sines = self._directions(scan, float(T_map_laser[2]))
        limits = (usable, min(self.config.no_return_range_m, scan.range_max_m, usable), depth, resolution)
        bend = 2.0 * math.cos(scan.angle_increment_rad)
        beams = (scan.ranges_m, scan.hit, scan.no_return)
        count = _mark(marks, shift, touched, x - col, y - row, cosines, sines, *beams, *limits, bend)
        self._add(row, col, shift, touched[:count], (x - col, y - row))

    def _add(
        self, row: int, col: int, shift: int, touched: NDArray[np.int64], laser: tuple[float, float]
    ) -> None:
        """Add what is marked to the tiles, and make those that do not exist.

        (row, col): cell (0, 0) of the marks; laser: its place (x, y) in cells from there.
        """
        tiles, last = self._tiles, 1 << shift
        tiles.reach(row // TILE, col // TILE, (row + last) // TILE, (col + last) // TILE)
        corner = (row - tiles.first_row * TILE, col - tiles.first_col * TILE)
        grazed = max(3, round(_GRAZED_M / self.frame.resolution))
        _spare(tiles.pool, tiles.directory, *corner, self._marks, shift, touched, laser, self._steps, grazed)
        left = _apply(tiles.pool, tiles.directory, *corner, self._marks, shift, touched, self._steps)
        if left:
            needed = np.zeros(tiles.directory.shape, dtype=np.bool_)
            _flag_tiles(needed, touched[:left], shift, *corner)
            tiles.ensure(np.argwhere(needed) + (tiles.first_row, tiles.first_col))
            _apply(tiles.pool, tiles.directory, *corner, self._marks, shift, touched[:left], self._steps)

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

    def _scratch(self, shift: int) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """Marks of at least 2**shift rows and columns, and a list as long: kept between scans, `_apply` clears them."""
        size = 1 << (2 * shift)
        if self._marks.size != size:
            self._marks, self._touched = np.zeros(size, dtype=np.uint8), np.empty(size + 1, dtype=np.int64)
        return self._marks, self._touched

    def _directions(self, scan: Scan, heading: float) -> tuple[Array, Array]:
        """Cosine and sine of each beam's direction in the map, (N,); those in the laser's frame are kept."""
        fan = (scan.ranges_m.size, scan.angle_min_rad, scan.angle_increment_rad)
        if fan != self._fan:
            self._fan, self._cosines, self._sines = fan, np.cos(scan.angles_rad), np.sin(scan.angles_rad)
        c, s = math.cos(heading), math.sin(heading)
        return c * self._cosines - s * self._sines, s * self._cosines + c * self._sines


def _steps(config: OccupancyConfig) -> NDArray[np.int64]:
    """What each of the eight combinations of marks adds to the log odds; lowest, highest and sure log odds, (11,)."""
    free, hit, low, high = (
        round(_SCALE * log_odds(p)) for p in (config.p_free, config.p_occupied, config.p_lowest, config.p_highest)
    )
    added = [hit if marks & _HIT else 0 if marks & _SURFACE else free for marks in range(8)]
    sure = min(round(_SCALE * log_odds(_SURELY_OCCUPIED)), high)
    return np.array([*added, low, high, sure], dtype=np.int64)


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


@inlined
def _is_flat(ranges: Array, hit: NDArray[np.bool_], usable: float, bend: float, i: int) -> bool:
    """Whether a beam and those beside it end on one surface.

    On a straight line 1 / range is a sine of the bearing: the two outer ranges foretell the one between, also where
    the wall is grazed and its points lie almost behind each other. bend: twice the cosine of the angle between beams.
    """
    if i < 1 or i > ranges.size - 2 or not (hit[i - 1] and hit[i] and hit[i + 1]):
        return False
    before, between, after = ranges[i - 1], ranges[i], ranges[i + 1]
    if max(before, between, after) >= usable:
        return False
    flat: bool = abs(between - bend * before * after / (before + after)) < _FLAT_M
    return flat and abs(after - before) < _LONGEST_SURFACE_M


@kernel
def _mark(
    cells: NDArray[np.uint8],
    shift: int,
    touched: NDArray[np.int64],
    x: float,
    y: float,
    cosines: Array,
    sines: Array,
    ranges: Array,
    hit: NDArray[np.bool_],
    no_return: NDArray[np.bool_],
    usable: float,
    without_return: float,
    depth: float,
    resolution: float,
    bend: float,
) -> int:
    """Mark each cell that a scan speaks of as passed, hit, or on a surface, and list the marked cells once each.

    cells (S * S,): zeros, S = 2**shift rows and columns, large enough for every beam; touched: the list, whose length
    is returned; x, y: the laser, in cells; cosines, sines, ranges (m), hit, no_return (N,): the beams; usable,
    without_return (m): how far beams tell something, and those without return; depth (m): how far behind its range a
    beam ends. Flat indices with a power of two as row length are cheap to take apart.
    """
    count = 0
    last = (x, y)
    flat_before = False
    for i in range(ranges.size):
        flat = _is_flat(ranges, hit, usable, bend, i)
        ends_in_hit = hit[i] and ranges[i] < usable
        length = min(ranges[i] + (depth if ends_in_hit else 0.0), usable) if hit[i] else 0.0
        length = without_return if no_return[i] else length
        if length > 0.0:
            reach = length / resolution
            end = (x + reach * cosines[i], y + reach * sines[i])
            count = _stroke(cells, shift, (x, y), end, _FREE, touched, count)
            index = (int(math.floor(end[1])) << shift) + int(math.floor(end[0]))
            touched[count] = index
            count += cells[index] == 0
            cells[index] |= _HIT if ends_in_hit else _FREE
            if flat_before or flat:
                count = _stroke(cells, shift, last, end, _SURFACE, touched, count)
            last = end
        flat_before = flat
    return count


@kernel
def _flag_tiles(needed: NDArray[np.bool_], touched: NDArray[np.int64], shift: int, row: int, col: int) -> None:
    """Flag the tiles in which the listed cells lie; (row, col): cell (0, 0) of the marks from the first tile on."""
    mask = (1 << shift) - 1
    for index in touched:
        needed[(row + (index >> shift)) >> _TILE_BITS, (col + (index & mask)) >> _TILE_BITS] = True


@inlined
def _odds_at(pool: NDArray[np.int16], directory: NDArray[np.int32], row: int, col: int) -> int:
    """Log odds of a cell, counted from the directory's first one on; 0 where no tile is."""
    tile_row, tile_col = row >> _TILE_BITS, col >> _TILE_BITS
    if tile_row < 0 or tile_col < 0 or tile_row >= directory.shape[0] or tile_col >= directory.shape[1]:
        return 0
    slot = directory[tile_row, tile_col]
    return 0 if slot < 0 else int(pool[slot, row & (TILE - 1), col & (TILE - 1)])


@inlined
def _run_of(
    pool: NDArray[np.int16],
    directory: NDArray[np.int32],
    row: int,
    col: int,
    away: tuple[float, float],
    sure: int,
    enough: int,
) -> int:
    """How many surely occupied cells lie in line with one along a beam, itself among them; counted up to `enough`.

    away: (x, y) from the laser to the cell, in cells.
    """
    longest = max(abs(away[0]), abs(away[1]), 1e-9)
    step_x, step_y = away[0] / longest, away[1] / longest
    run = 1
    for sign in (-1, 1):
        k = 1
        while run < enough:
            at_row, at_col = row + round(sign * k * step_y), col + round(sign * k * step_x)
            if _odds_at(pool, directory, at_row, at_col) < sure:
                break
            run, k = run + 1, k + 1
    return run


@kernel
def _spare(
    pool: NDArray[np.int16],
    directory: NDArray[np.int32],
    row: int,
    col: int,
    cells: NDArray[np.uint8],
    shift: int,
    touched: NDArray[np.int64],
    laser: tuple[float, float],
    steps: NDArray[np.int64],
    grazed: int,
) -> None:
    """Mark as surface what beams only passed, but what is surely occupied for as many cells as `grazed` along them.

    (row, col): cell (0, 0) of the marks, counted from the directory's first cell on; laser: (x, y) in cells of them.
    """
    mask, sure = (1 << shift) - 1, steps[10]
    for index in touched:
        if cells[index] != _FREE:
            continue
        in_row, in_col = index >> shift, index & mask
        if _odds_at(pool, directory, row + in_row, col + in_col) >= sure:
            away = (in_col + 0.5 - laser[0], in_row + 0.5 - laser[1])
            if _run_of(pool, directory, row + in_row, col + in_col, away, sure, grazed) >= grazed:
                cells[index] |= _SURFACE


@kernel
def _apply(
    pool: NDArray[np.int16],
    directory: NDArray[np.int32],
    row: int,
    col: int,
    cells: NDArray[np.uint8],
    shift: int,
    touched: NDArray[np.int64],
    steps: NDArray[np.int64],
) -> int:
    """Add the log odds of each marked cell, clamped, and clear its mark; where no tile is, leave it and list it anew.

    (row, col): cell (0, 0) of the marks, counted from the directory's first cell on; never negative within it.
    Returns how many cells are left at the beginning of the list.
    """
    odds_of = pool.ravel()
    mask, inner, left = (1 << shift) - 1, TILE - 1, 0
    low, high = steps[8], steps[9]
    for index in touched:
        cell_row, cell_col = row + (index >> shift), col + (index & mask)
        slot = np.int64(directory[cell_row >> _TILE_BITS, cell_col >> _TILE_BITS])
        if slot < 0:
            touched[left] = index
            left += 1
            continue
        step = steps[cells[index]]
        cells[index] = 0
        if step == 0:
            continue
        at = (((slot << _TILE_BITS) + (cell_row & inner)) << _TILE_BITS) + (cell_col & inner)
        odds = odds_of[at] + step
        # 0 is kept for cells never seen: a cell that comes back to even odds stays a thousandth off.
        odds = 1 if odds == 0 else odds
        odds_of[at] = min(max(odds, low), high)
    return left
