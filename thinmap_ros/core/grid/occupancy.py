"""Occupancy grid: log odds of each cell, updated by Bayes' rule from laser scans."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import Config, config_or_default, parameter
from thinmap_ros.core.errors import InputError, quoted, require_type
from thinmap_ros.core.grid.patch import (
    FRAME_FIELD,
    UNKNOWN,
    Bounds,
    GridFrame,
    GridPatch,
    bounds_of,
    union,
)
from thinmap_ros.core.grid.raytrace import fill_segment
from thinmap_ros.core.grid.tiles import MAX_TILE_INDEX, TILE, TileStore
from thinmap_ros.core.scan import NO_RETURN_CLEAR_RANGE_M, Scan
from thinmap_ros.core.se2 import Array, Cells, Mask
from thinmap_ros.core.snapshot import Field
from thinmap_ros.jit import inlined, kernel

# Log odds are kept as whole thousandths in int16: small, exact to add, and the same on every
# machine.
_SCALE = 1000.0
_LIMIT = 6000
# Occupancy in percent for log odds from -_LIMIT to _LIMIT; exactly 0 means unobserved.
_PERCENT = np.round(100.0 / (1.0 + np.exp(-np.arange(-_LIMIT, _LIMIT + 1) / _SCALE)))
_PERCENT = _PERCENT.astype(np.int8)
_PERCENT[_LIMIT] = UNKNOWN
# Clamps of the occupancy probability, so that a cell that has changed is relearned soon.
P_MIN = 0.05
P_MAX = 0.97
_GRAZED_M = 0.4  # of occupied cells through which a beam passes that grazes the face of a wall
_P_SURELY_OCCUPIED = 0.9

# Three neighbouring beams hit one surface if the middle range differs by less than this from the
# range that the others predict, m.
_FLAT_M = 0.06
_MAX_SURFACE_GAP_M = 3.0

_TILE_BITS = TILE.bit_length() - 1
_BAND_ROWS = 256  # rendered at once: a large map needs little more memory than its cells

FIELDS = {
    'frame': FRAME_FIELD,
    'tiles': Field(np.int64, ('n', 2), -MAX_TILE_INDEX, MAX_TILE_INDEX),
    'log_odds': Field(np.int16, ('n', TILE, TILE), -_LIMIT, _LIMIT),
}


class RenderedMap:
    """Occupancy of all tiles in percent, updated only where the grid has changed.

    Cells (H, W) int8, with the outdated part and the bounds of the known ones.
    """

    def __init__(self) -> None:
        self._cells: NDArray[np.int8] = np.empty((0, 0), dtype=np.int8)
        self._bounds: Bounds = (0, 0, 0, 0)
        self._known: Bounds | None = None
        self._stale: Bounds | None = None
        self._patch: GridPatch | None = None  # the newest copy, until a cell is outdated

    def mark_dirty(self, row: int, col: int, end_row: int, end_col: int) -> None:
        """Mark cells [row, end_row) x [col, end_col) as outdated."""
        self._stale = union(self._stale, (row, col, end_row, end_col))
        self._patch = None

    def render(self, tiles: TileStore, frame: GridFrame) -> GridPatch:
        """Bounding rectangle of the known cells; one unknown cell if there are none.

        A copy, which is the same object as long as no cell is outdated, and read-only.
        """
        if self._patch is None:
            self._patch = self._copy(tiles, frame)
            self._patch.cells.flags.writeable = False
        return self._patch

    def _copy(self, tiles: TileStore, frame: GridFrame) -> GridPatch:
        self._enlarge(tiles)
        if self._stale is not None:
            row, col = np.maximum(self._stale[:2], self._bounds[:2]).tolist()
            end_row, end_col = np.minimum(self._stale[2:], self._bounds[2:]).tolist()
            for top in range(row, end_row, _BAND_ROWS):
                self._refresh(tiles, top, col, min(top + _BAND_ROWS, end_row), end_col)
            self._stale = None
        if self._known is None:
            return GridPatch(frame, np.full((1, 1), UNKNOWN, dtype=np.int8))
        row, col, end_row, end_col = self._known
        top, left = self._bounds[:2]
        shown = self._cells[row - top : end_row - top, col - left : end_col - left]
        return GridPatch(frame.with_origin_at(row, col), shown.copy())

    def _enlarge(self, tiles: TileStore) -> None:
        """Enlarge the cells if tiles have been added outside of them."""
        bounds = tiles.bounds()
        if bounds is None or bounds == self._bounds:
            return
        cells = np.full((bounds[2] - bounds[0], bounds[3] - bounds[1]), UNKNOWN, dtype=np.int8)
        row = self._bounds[0] - bounds[0]
        col = self._bounds[1] - bounds[1]
        if self._cells.size:
            cells[row : row + self._cells.shape[0], col : col + self._cells.shape[1]] = self._cells
        self._cells = cells
        self._bounds = bounds

    def _refresh(self, tiles: TileStore, row: int, col: int, end_row: int, end_col: int) -> None:
        if end_col <= col:
            return  # beyond all tiles
        shown = _percentages(tiles.read(row, col, end_row - row, end_col - col))
        top, left = self._bounds[:2]
        self._cells[row - top : end_row - top, col - left : end_col - left] = shown
        known = bounds_of(shown != UNKNOWN)
        if known is not None:
            # Known cells stay known: the rectangle only grows.
            found = (row + known[0], col + known[1], row + known[2], col + known[3])
            self._known = union(self._known, found)


@dataclass(frozen=True)
class OccupancyConfig(Config):
    """Parameters of the grid and of the laser's inverse sensor model."""

    resolution_m: float = parameter(
        0.05,
        'Edge of a cell of the grid (m). Lower: finer walls, more memory and computing time.',
        low=0.01,
        high=1.0,
    )
    p_miss: float = parameter(
        0.35,
        'Occupancy probability of a cell that a beam passed through. Lower: moved objects vanish '
        'sooner, thin walls as well.',
        low=0.01,
        high=0.49,
    )
    p_hit: float = parameter(
        0.80,
        'Occupancy probability of the cell in which a beam ended. Higher: objects appear sooner, '
        'noise as well.',
        low=0.51,
        high=0.99,
    )
    no_return_clear_range_m: float = parameter(
        NO_RETURN_CLEAR_RANGE_M,
        'Range up to which a beam without return clears cells (m), at most max_range_m. Lower it '
        'for a laser that measures walls farther than it sees dark ones. 0: it clears nothing. A '
        'laser that often has no return from walls is recognized, and its beams clear nothing '
        'either.',
        low=0.0,
        high=200.0,
    )
    surface_thickness_m: float = parameter(
        0.03,
        'Depth behind the measured surface that is marked occupied (m). Raise it if walls that '
        'lie between two cells break up.',
        low=0.0,
        high=0.5,
    )

    def cleared_range_m(self, scan: Scan) -> float:
        """Range up to which the beams without return of a scan clear cells, m."""
        return min(self.no_return_clear_range_m, scan.range_max_m, scan.max_range_m)


# Cells of the papers, and of all results that are compared with published ones: experiments,
# explorations in the simulator, benchmarks.
PAPER_GRID = OccupancyConfig(resolution_m=0.10)


def log_odds(probability: float) -> float:
    """Log odds ln(p / (1 - p))."""
    return math.log(probability / (1.0 - probability))


@dataclass(frozen=True)
class WindowConfig(Config):
    """The part of the map around the robot that a scan changes."""

    local_map_size_m: float = parameter(
        16.0,
        'Side length of local_grid, centred on the robot (m). Twice max_range_m holds all that a '
        'scan changes; lower: less computing time.',
        low=2.0,
        high=100.0,
    )


class OccupancyGrid:
    """Occupancy map of any extent, in tiles that exist only where something was observed.

    The inverse sensor model: cells along a beam are free, its end is occupied, cells beyond are
    unchanged. The end is surface_thickness_m behind the measured surface, inside the obstacle:
    for a wall on the border of two cells, noise would otherwise fill the free cell in front of it
    half the time. Each cell is counted once per scan, and a cell in which any beam of the scan ends
    counts as occupied. Beams that graze a wall pass through its cells long before they end. A cell
    on the line between the ends of neighbouring beams on one surface is therefore never counted as
    free. Neither is a surely occupied cell in a run of such cells of at least 0.4 m along the beam:
    a laser does not see through walls. Beams that cross a removed obstacle still clear it.
    Source: topological map paper section 2.1 (binary local map), exploration paper section 2.1
    (Bayes update).
    """

    def __init__(
        self, config: OccupancyConfig | None = None, frame: GridFrame | None = None
    ) -> None:
        """Start empty; frame: of the map to continue, which gives the resolution."""
        self.config = config_or_default(config, OccupancyConfig)
        self.frame = frame or GridFrame(0.0, 0.0, self.config.resolution_m)
        self._tiles = TileStore()
        self._rendered = RenderedMap()
        self._changed: Bounds | None = None
        self._increments: NDArray[np.int16] = np.zeros((0, 0), dtype=np.int16)
        self._beam_geometry: tuple[int, float, float] = (0, 0.0, 0.0)
        self._cosines = self._sines = np.empty(0)
        self._steps = _steps(self.config)
        self._grazed = max(3, round(_GRAZED_M / self.frame.resolution))

    def __repr__(self) -> str:
        known = self.known_area()
        rows, cols = known.shape
        free = np.count_nonzero(known.free)
        occupied = np.count_nonzero(known.occupied)
        size = f'{rows} x {cols} cells of {self.frame.resolution:g} m'
        return f'OccupancyGrid({size}, {free} free, {occupied} occupied)'

    @staticmethod
    def from_patch(patch: GridPatch, config: OccupancyConfig | None = None) -> 'OccupancyGrid':
        """Start from a finished map, with the same cells and resolution."""
        require_type('patch', patch, GridPatch)
        grid = OccupancyGrid(config, patch.frame)
        # A table takes a tenth of the memory that arithmetic on the cells of a large map takes.
        values = np.arange(1 << 8, dtype=np.uint8).view(np.int8)
        clamped = np.clip(values / 100.0, P_MIN, P_MAX)
        odds = np.round(_SCALE * np.log(clamped / (1.0 - clamped))).astype(np.int16)
        odds[values == UNKNOWN] = 0
        grid._write(0, 0, odds[patch.cells.view(np.uint8)])
        return grid

    def state(self) -> dict[str, NDArray[Any]]:
        """The exact state of the grid, as arrays by name; `from_state` restores it."""
        return {
            'frame': self.frame.as_array(),
            'tiles': self._tiles.tile_coordinates(),
            'log_odds': self._tiles.pool[: self._tiles.used].copy(),
        }

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: OccupancyConfig | None = None
    ) -> 'OccupancyGrid':
        """Restore a grid from its `state`. Raises InputError if the state is invalid."""
        checked = snapshot.validate(state, FIELDS, 'grid')
        tiles = checked['tiles']
        odds = checked['log_odds']
        flat = tiles[:, 0] * (2 * MAX_TILE_INDEX + 1) + tiles[:, 1]
        snapshot.require(len(np.unique(flat)) == len(tiles), 'grid: tiles', 'each once')
        origin_x, origin_y, resolution = checked['frame'].tolist()
        grid = OccupancyGrid(config, GridFrame(origin_x, origin_y, resolution))
        for (row, col), cells in zip(tiles.tolist(), odds, strict=True):
            grid._write(row * TILE, col * TILE, cells)
        return grid

    def _write(self, row: int, col: int, odds: NDArray[np.int16]) -> None:
        self._tiles.write(row, col, odds)
        self._mark_changed(row, col, row + odds.shape[0], col + odds.shape[1])

    def add_scan(self, scan: Scan, T_map_base: Array) -> None:
        """Add a scan made at a robot pose T_map_base (3,).

        Raises InputError, and leaves the map unchanged, if the laser is beyond MAX_COORDINATE_M or
        the map would become too large, and for anything but a scan and a pose.
        """
        require_type('scan', scan, Scan)
        if np.shape(T_map_base) != (3,):
            raise InputError(f'T_map_base = {quoted(T_map_base)}: expected a pose (3,)')
        if scan.ranges_m.size == 0 or not se2.is_finite(T_map_base):
            return
        T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
        if not se2.is_bounded_pose(T_map_laser):
            place = f'{T_map_laser[0]:g}, {T_map_laser[1]:g} m'
            raise InputError(f'scan at {scan.stamp_ns} ns: laser at {place}: too far to be mapped')
        resolution = self.frame.resolution
        usable = scan.max_range_m
        depth = self.config.surface_thickness_m
        x = (float(T_map_laser[0]) - self.frame.origin_x) / resolution
        y = (float(T_map_laser[1]) - self.frame.origin_y) / resolution
        radius = math.ceil(min(usable, scan.range_max_m + depth) / resolution) + 2
        tile_row = (math.floor(y) - radius) // TILE
        tile_col = (math.floor(x) - radius) // TILE
        laser = (x - tile_col * TILE, y - tile_row * TILE)
        # Before drawing: increments that cannot be merged must not remain in the buffer.
        last_row = (math.floor(y) + radius) // TILE
        last_col = (math.floor(x) + radius) // TILE
        try:
            self._tiles.grow_to(tile_row, tile_col, last_row, last_col)
        except InputError as error:
            place = f'{T_map_laser[0]:g}, {T_map_laser[1]:g} m'
            raise InputError(f'scan at {scan.stamp_ns} ns: laser at {place}: {error}') from error
        increments = self._empty_increments(radius)
        self._cache_bearings(scan)
        heading = float(T_map_laser[2])
        bend = 2.0 * math.cos(scan.angle_increment_rad)
        turn = (math.cos(heading), math.sin(heading))
        beams = (scan.ranges_m, scan.returned, scan.no_return, self._cosines, self._sines)
        limits = (usable, self.config.cleared_range_m(scan), depth, resolution, bend)
        box = _draw(increments, laser, turn, *beams, limits, self._steps)
        self._merge(tile_row, tile_col, box, laser)

    def _merge(
        self,
        tile_row: int,
        tile_col: int,
        box: tuple[int, int, int, int],
        laser: tuple[float, float],
    ) -> None:
        """Add the increments to the tiles, and allocate missing tiles.

        (tile_row, tile_col): first tile of the increments.
        """
        tiles = self._tiles
        row = tile_row * TILE
        col = tile_col * TILE
        self._mark_changed(row + box[0], col + box[2], row + box[1] + 1, col + box[3] + 1)
        place = (tile_row - tiles.first_row, tile_col - tiles.first_col)
        _keep_grazed_walls(
            tiles.pool,
            tiles.directory,
            place,
            self._increments,
            box,
            laser,
            self._steps,
            self._grazed,
        )
        if _apply(tiles.pool, tiles.directory, place, self._increments, box, self._steps):
            tiles.allocate(_tiles_of(self._increments, box) + (tile_row, tile_col))
            _apply(tiles.pool, tiles.directory, place, self._increments, box, self._steps)

    def tiles(self) -> Cells:
        """Tile coordinates (N, 2) as (row, col) of the tiles that exist."""
        return self._tiles.tile_coordinates()

    def set_tiles(self, tiles: Cells, *grids: 'OccupancyGrid') -> None:
        """Set tiles (N, 2) to the sum of the log odds of some grids with the same frame."""
        if not len(tiles):
            return
        odds = np.zeros((len(tiles), TILE, TILE), dtype=np.int16)
        seen = np.zeros(odds.shape, dtype=np.bool_)
        for grid in grids:
            part = grid._tiles.read_tiles(tiles)
            odds += part
            seen |= part != 0
        odds[seen & (odds == 0)] = 1  # 0 means unobserved
        low, high = self._steps[2:4]
        self._tiles.write_tiles(tiles, np.clip(odds, low, high))
        row, col = (tiles.min(axis=0) * TILE).tolist()
        end_row, end_col = ((tiles.max(axis=0) + 1) * TILE).tolist()
        self._mark_changed(row, col, end_row, end_col)

    def odds(self, bounds: Bounds) -> NDArray[np.int16]:
        """Copy of the log odds (H, W) within bounds, in thousandths; 0: unknown."""
        row, col, end_row, end_col = bounds
        return self._tiles.read(row, col, end_row - row, end_col - col)

    def set_odds(self, bounds: Bounds, odds: NDArray[np.int16]) -> None:
        """Set the log odds (H, W) within bounds, where there are tiles."""
        self._tiles.overwrite(*bounds[:2], odds)
        self._mark_changed(*bounds)

    def window(self, x: float, y: float, size_m: float) -> GridPatch:
        """Square of size_m around a point, aligned with the cells, copied out of the tiles."""
        count = max(1, round(size_m / self.frame.resolution))
        row, col = self.frame.cells_of(np.array([[x, y]]))[0] - count // 2
        return self._cut(int(row), int(col), count, count)

    def known_area(self) -> GridPatch:
        """Bounding rectangle of all known cells; one unknown cell if there are none.

        Read-only, and the same object as long as the grid does not change.
        """
        return self._rendered.render(self._tiles, self.frame)

    def take_changes(self) -> GridPatch | None:
        """Rectangle of all cells that may have changed since the last call; None if none has."""
        if self._changed is None:
            return None
        row, col, end_row, end_col = self._changed
        self._changed = None
        return self._cut(row, col, end_row - row, end_col - col)

    def _mark_changed(self, row: int, col: int, end_row: int, end_col: int) -> None:
        """The cells [row, end_row) x [col, end_col) may have changed."""
        self._rendered.mark_dirty(row, col, end_row, end_col)
        self._changed = union(self._changed, (row, col, end_row, end_col))

    def _cut(self, row: int, col: int, rows: int, cols: int) -> GridPatch:
        odds = self._tiles.read(row, col, rows, cols)
        return GridPatch(self.frame.with_origin_at(row, col), _percentages(odds))

    def _empty_increments(self, radius: int) -> NDArray[np.int16]:
        """Zeros for the increments of a scan: whole tiles, `radius` cells around any cell.

        The buffer is reused; `_apply` clears it. Its rows are padded by one cache line: with a
        power of two, cells above each other would compete for the same cache lines.
        """
        tiles = (2 * radius) // TILE + 2
        if self._increments.shape[0] != tiles * TILE:
            self._increments = np.zeros((tiles * TILE, tiles * TILE + 32), dtype=np.int16)
        return self._increments

    def _cache_bearings(self, scan: Scan) -> None:
        """Cache the cosines and sines of the bearings for scans with the same geometry."""
        fan = (scan.ranges_m.size, scan.angle_min_rad, scan.angle_increment_rad)
        if fan != self._beam_geometry:
            self._beam_geometry = fan
            self._cosines = np.cos(scan.angles_rad)
            self._sines = np.sin(scan.angles_rad)


def _steps(config: OccupancyConfig) -> NDArray[np.int16]:
    """Log-odds increments and limits, (5,).

    Increment of a miss and of a hit; lowest and highest log odds; log odds of a surely occupied
    cell.
    """
    free, hit, low, high = (
        round(_SCALE * log_odds(p)) for p in (config.p_miss, config.p_hit, P_MIN, P_MAX)
    )
    sure = min(round(_SCALE * log_odds(_P_SURELY_OCCUPIED)), high)
    return np.array([free, hit, low, high, sure], dtype=np.int16)


@inlined
def _is_flat(ranges: Array, hit: Mask, usable: float, bend: float, i: int) -> bool:
    """Whether a beam and those beside it end on one surface.

    On a straight line 1 / range is a sine of the bearing: the two outer ranges predict the middle
    one, even if the beams graze the wall. bend: twice the cosine of the angle between beams.
    """
    if i < 1 or i > ranges.size - 2 or not (hit[i - 1] and hit[i] and hit[i + 1]):
        return False
    before = ranges[i - 1]
    between = ranges[i]
    after = ranges[i + 1]
    if max(before, between, after) >= usable:
        return False
    flat: bool = abs(between - bend * before * after / (before + after)) < _FLAT_M
    return flat and abs(after - before) < _MAX_SURFACE_GAP_M


@kernel
def _draw(
    increments: NDArray[np.int16],
    laser: tuple[float, float],
    turn: tuple[float, float],
    ranges: Array,
    hit: Mask,
    no_return: Mask,
    cosines: Array,
    sines: Array,
    limits: tuple[float, float, float, float, float],
    steps: NDArray[np.int16],
) -> tuple[int, int, int, int]:
    """Draw the log-odds increments of a scan.

    First the cells that beams passed, over them the surfaces (0), over these the ends of beams.

    increments (H, W): zeros, large enough for every beam; laser: (x, y) in cells of this array;
    turn: cosine and sine of its heading; ranges (m), hit, no_return, cosines, sines (N,): beams,
    with bearings in the laser frame; limits: usable range, range cleared by beams without return,
    surface depth, edge of a cell, all m, and the `bend` of `_is_flat`. Returns first and last row,
    first and last column of the bounding box of the drawn cells.
    """
    usable, without_return, depth, resolution, bend = limits
    cells = increments.ravel()
    width = increments.shape[1]
    ends = np.empty((ranges.size, 2))
    low_x = laser[0]
    low_y = laser[1]
    high_x = laser[0]
    high_y = laser[1]
    for i in range(ranges.size):
        length = min(ranges[i] + depth if ranges[i] < usable else usable, usable) if hit[i] else 0.0
        reach = (without_return if no_return[i] else length) / resolution
        x = laser[0] + reach * (turn[0] * cosines[i] - turn[1] * sines[i])
        y = laser[1] + reach * (turn[1] * cosines[i] + turn[0] * sines[i])
        ends[i, 0] = x
        ends[i, 1] = y
        if reach > 0.0:
            fill_segment(cells, width, laser, (x, y), steps[0])
            low_x = min(low_x, x)
            low_y = min(low_y, y)
            high_x = max(high_x, x)
            high_y = max(high_y, y)
    _draw_ends(cells, width, ends, ranges, hit, usable, bend, steps[1])
    # One more on each side: a fixed-point coordinate may be rounded across a border.
    return int(low_y) - 1, int(high_y) + 1, int(low_x) - 1, int(high_x) + 1


@inlined
def _draw_ends(
    cells: NDArray[np.int16],
    width: int,
    ends: Array,
    ranges: Array,
    hit: Mask,
    usable: float,
    bend: float,
    step: int,
) -> None:
    """Draw the hits of a scan over the passed cells: surfaces between beam ends, then the ends."""
    flat_before = False
    for i in range(1, ranges.size):
        flat = _is_flat(ranges, hit, usable, bend, i)
        if flat or flat_before:
            fill_segment(
                cells, width, (ends[i - 1, 0], ends[i - 1, 1]), (ends[i, 0], ends[i, 1]), 0
            )
        flat_before = flat
    for i in range(ranges.size):
        if hit[i] and ranges[i] < usable:
            cells[int(ends[i, 1]) * width + int(ends[i, 0])] = step


@kernel
def _percentages(odds: NDArray[np.int16]) -> NDArray[np.int8]:
    """Occupancy (H, W), in percent, of log odds."""
    cells = np.empty(odds.shape, dtype=np.int8)
    for row in range(odds.shape[0]):
        for col in range(odds.shape[1]):
            cells[row, col] = _PERCENT[np.int64(odds[row, col]) + _LIMIT]
    return cells


@inlined
def _odds_at(pool: NDArray[np.int16], directory: NDArray[np.int32], row: int, col: int) -> int:
    """Log odds of a cell, relative to the first cell of the directory; 0 if there is no tile."""
    tile_row = row >> _TILE_BITS
    tile_col = col >> _TILE_BITS
    if (
        tile_row < 0
        or tile_col < 0
        or tile_row >= directory.shape[0]
        or tile_col >= directory.shape[1]
    ):
        return 0
    slot = directory[tile_row, tile_col]
    return 0 if slot < 0 else int(pool[slot, row & (TILE - 1), col & (TILE - 1)])


@inlined
def _occupied_run(
    pool: NDArray[np.int16],
    directory: NDArray[np.int32],
    row: int,
    col: int,
    away: tuple[float, float],
    sure: int,
    enough: int,
) -> int:
    """Length of the run of surely occupied cells through a cell along a beam, up to `enough`.

    away: (x, y) from the laser to the cell, in cells.
    """
    longest = max(abs(away[0]), abs(away[1]), 1e-9)
    step_x = away[0] / longest
    step_y = away[1] / longest
    run = 1
    for sign in (-1, 1):
        k = 1
        while run < enough:
            at_row = row + round(sign * k * step_y)
            at_col = col + round(sign * k * step_x)
            if _odds_at(pool, directory, at_row, at_col) < sure:
                break
            run = run + 1
            k = k + 1
    return run


@inlined
def _has_occupied(increments: NDArray[np.int16], odds: NDArray[np.int16], sure: int) -> bool:
    """Whether beams passed a surely occupied cell of a strip of TILE cells."""
    found = 0
    for k in range(TILE):
        found |= (increments[k] < 0) & (odds[k] >= sure)
    return found != 0


@kernel
def _keep_grazed_walls(
    pool: NDArray[np.int16],
    directory: NDArray[np.int32],
    place: tuple[int, int],
    increments: NDArray[np.int16],
    box: tuple[int, int, int, int],
    laser: tuple[float, float],
    steps: NDArray[np.int16],
    grazed: int,
) -> None:
    """Reset the increments of passed cells in runs of at least `grazed` surely occupied cells.

    Such beams graze a wall. place: (row, col) in the directory of the first tile of the increments;
    laser: (x, y) in cells of the increments.
    """
    sure = steps[4]
    top = place[0] * TILE
    left = place[1] * TILE
    for row in range(box[0], box[1] + 1):
        for tile in range(box[2] >> _TILE_BITS, (box[3] >> _TILE_BITS) + 1):
            slot = directory[place[0] + (row >> _TILE_BITS), place[1] + tile]
            first = tile * TILE
            if slot < 0:
                continue
            added = increments[row, first : first + TILE]
            odds = pool[slot, row & (TILE - 1)]
            if _has_occupied(added, odds, sure):
                for k in range(TILE):
                    if added[k] < 0 and odds[k] >= sure:
                        away = (first + k + 0.5 - laser[0], row + 0.5 - laser[1])
                        run = _occupied_run(
                            pool, directory, top + row, left + first + k, away, sure, grazed
                        )
                        added[k] = 0 if run >= grazed else added[k]


@kernel
def _apply(
    pool: NDArray[np.int16],
    directory: NDArray[np.int32],
    place: tuple[int, int],
    increments: NDArray[np.int16],
    box: tuple[int, int, int, int],
    steps: NDArray[np.int16],
) -> bool:
    """Add the increments to the log odds, clamped, and clear them.

    Returns whether increments remain where tiles are missing. The inner loop has no branches, so
    that the compiler can vectorize it.
    """
    missing = False
    low = steps[2]
    high = steps[3]
    one = np.int16(1)
    none = np.int16(0)
    for row in range(box[0], box[1] + 1):
        for tile in range(box[2] >> _TILE_BITS, (box[3] >> _TILE_BITS) + 1):
            slot = directory[place[0] + (row >> _TILE_BITS), place[1] + tile]
            added = increments[row, tile * TILE : tile * TILE + TILE]
            if slot < 0:
                missing = missing or bool(added.any())
                continue
            odds = pool[slot, row & (TILE - 1)]
            for k in range(TILE):
                # 0 means unobserved: a cell that returns to even odds gets a thousandth instead.
                total = np.int16(odds[k] + added[k])
                total = one if total == none else total
                total = low if total < low else total
                total = high if total > high else total
                odds[k] = odds[k] if added[k] == none else total
                added[k] = none
    return missing


def _tiles_of(increments: NDArray[np.int16], box: tuple[int, int, int, int]) -> Cells:
    """Tiles (N, 2), relative to the first one, that have increments."""
    rows, cols = np.nonzero(increments[: box[1] + 1])
    width = increments.shape[1] // TILE + 1
    drawn = np.zeros((increments.shape[0] // TILE + 1) * width, dtype=np.bool_)
    drawn[rows // TILE * width + cols // TILE] = True
    return np.column_stack(np.divmod(np.flatnonzero(drawn), width))
