"""The local map that scans are matched with: cells with hits, and the way to the nearest wall.

A cell counts how often a beam ended in it and how often one was seen through it or in it, and keeps
the mean of its hits, which lies much nearer to the surface than the middle of the cell. A cell is a
wall where enough of its observations are hits. Each cell near a wall knows the nearest one, so that
the distance from any point to the walls is looked up, not searched.
Source: Konolige et al., "Efficient sparse pose adjustment for 2D mapping", 2010, for the counts;
Lau, Sprunk and Burgard, "Efficient grid-based spatial representations for robot navigation in
dynamic environments", 2013, for distances that follow a changing map.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.grid.tiles import FARTHEST_TILE, NO_TILE, TILE, TileStore
from thinmap_ros.core.jit import inlined, kernel
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import Field

CELL = np.dtype(
    [
        ('hits', np.uint8),
        ('seen', np.uint8),
        ('to_row', np.uint8),  # the nearest wall, in cells from here, + HERE; 0: none within reach
        ('to_col', np.uint8),
        ('x', np.float32),  # mean of the hits, in cells from the middle of this one
        ('y', np.float32),
        ('normal', np.uint8),  # of the wall, as a code; 0: it has none
    ]
)
HERE = 100
_SHIFT = TILE.bit_length() - 1
_MASK = TILE - 1
_MOST_SEEN = 255
_CODES = 255  # of normals: 1 to so many
_ALONG = 2.0 * np.pi * np.arange(_CODES) / _CODES
_NORMALS = np.vstack([np.zeros((1, 2)), np.column_stack([-np.sin(_ALONG), np.cos(_ALONG)])])
_NORMAL_CELLS = (8, 4, 2)  # to each side, that tell the normal of a wall: the most that lie in line
_TILT = 0.07  # of a normal, rad, 1 sigma: one that is known no better is none
_NOISE = 0.2  # of the mean of a cell's hits, cells, 1 sigma
_HALF_WALL = 4.0  # to either side of the hits of a cell its wall goes on so many cells
_PARALLEL = 0.7  # cosine: normals that are nearer to each other are of one wall
_THICK = 0.55  # of what lies in line, cells, 1 sigma


@dataclass(frozen=True)
class LocalMapConfig(Config):
    """Parameters of the local map."""

    match_cell_m: float = parameter(0.05, 'edge of a cell of the local map, m', low=0.01, high=0.5)
    match_range_m: float = parameter(30.0, 'farther points are not matched, m', low=1.0, high=200.0)
    match_reach_m: float = parameter(
        0.5, 'a point looks for the nearest wall within, m', low=0.05, high=2.0
    )
    match_wall_share: float = parameter(
        0.25,
        'share of hits among the observations of a cell that make it a wall',
        low=0.01,
        high=1.0,
    )


class Lattice(NamedTuple):
    """The cells as kernels take them.

    pool: tiles of cells, CELL; directory: the slot of each tile, or NO_TILE; first_row, first_col:
    its first cell; reach: in cells.
    """

    pool: NDArray[Any]
    directory: NDArray[np.int32]
    first_row: int
    first_col: int
    cell_m: float
    reach: int


class LocalMap:
    """Cells that grow in any direction, in tiles, in the frame of the map."""

    def __init__(self, config: LocalMapConfig | None = None) -> None:
        self.config = config or LocalMapConfig()
        self.tiles = TileStore(CELL)

    @property
    def is_empty(self) -> bool:
        """Whether nothing was added yet."""
        return self.tiles.used == 0

    @property
    def lattice(self) -> Lattice:
        """The cells as kernels take them, until the map grows."""
        tiles, config = self.tiles, self.config
        reach = int(math.ceil(config.match_reach_m / config.match_cell_m))
        return Lattice(
            tiles.pool,
            tiles.directory,
            tiles.first_row * TILE,
            tiles.first_col * TILE,
            config.match_cell_m,
            min(reach, HERE - 1),
        )

    def add(self, points_map: Array, laser_map: Array) -> None:
        """Take in the points (N, 2) that beams from a laser at (2,) met, map frame."""
        if len(points_map) == 0:
            return
        self._reach(points_map, laser_map)
        _add(points_map, laser_map, self.lattice, self.config.match_wall_share)

    def add_scan(self, points_base: Array, T_base_laser: Array, T_map_base: Array) -> None:
        """Take in the points (N, 2), robot frame, of a scan at a pose (3,)."""
        laser = se2.transform_points(T_map_base, T_base_laser[None, :2])[0]
        self.add(se2.transform_points(T_map_base, points_base), laser)

    def distances(self, points_map: Array) -> Array:
        """Distances (N,) of points (N, 2) from the walls, m; `match_reach_m` where none is near."""
        return np.abs(_distances(points_map, self.lattice))

    def add_walls(self, points_map: Array) -> None:
        """Take in points (N, 2) of walls that were not seen by a scan, as of an occupancy map."""
        if len(points_map):
            cells = np.floor(points_map / self.config.match_cell_m).astype(np.int64)
            _, once = np.unique(cells, axis=0, return_index=True)
            points = points_map[np.sort(once)]
            self._reach(points, points[0])
            _hit(points, points.mean(axis=0), self.lattice, self.config.match_wall_share)

    def state(self) -> dict[str, NDArray[Any]]:
        """All cells as arrays by name, for `restore`."""
        tiles = self.tiles
        cells = tiles.pool[: tiles.used]
        return {
            'cell_m': np.array(self.config.match_cell_m),
            'tiles': tiles.places(),
            'hits': cells['hits'],
            'seen': cells['seen'],
            'means': np.stack([cells['x'], cells['y']], axis=-1),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take over the cells of a `state`, checked by FIELDS, into a map that is empty.

        Raises InputError where they are of another size, or lie too far apart for one map.
        """
        cell_m = float(state['cell_m'])
        own = self.config.match_cell_m
        snapshot.require(cell_m == own, f'local map: cells of {cell_m} m', f'{own} m')
        places = state['tiles']
        if not len(places):
            return
        once = len(np.unique(places, axis=0)) == len(places)
        snapshot.require(once, 'features: tiles: one twice', 'each tile once')
        low, high = places.min(axis=0), places.max(axis=0)
        self.tiles.reach(int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        self.tiles.ensure(places)
        cells = self.tiles.pool[: len(places)]
        cells['hits'] = np.minimum(state['hits'], state['seen'])
        cells['seen'] = state['seen']
        cells['x'] = state['means'][..., 0]
        cells['y'] = state['means'][..., 1]
        _lead(places * TILE, self.lattice, self.config.match_wall_share)

    def _reach(self, points_map: Array, laser_map: Array) -> None:
        """Have all tiles that the beams touch, and those within reach of their ends."""
        reach = self.config.match_reach_m
        edge_m = TILE * self.config.match_cell_m
        both = np.vstack([points_map, laser_map])
        low = np.floor((both.min(axis=0) - reach) / edge_m).astype(np.int64)[::-1]
        high = np.floor((both.max(axis=0) + reach) / edge_m).astype(np.int64)[::-1]
        self.tiles.reach(int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        touched = _touched(points_map, laser_map, low, high, edge_m, reach)
        first = (low[0] - self.tiles.first_row, low[1] - self.tiles.first_col)
        rows, cols = touched.shape
        missing = touched & (
            self.tiles.directory[first[0] : first[0] + rows, first[1] : first[1] + cols] == NO_TILE
        )
        if missing.any():
            self.tiles.ensure(np.argwhere(missing) + low)


FIELDS = {
    'cell_m': Field(np.float64, (), 1e-3, 10.0),
    'tiles': Field(np.int64, ('t', 2), -FARTHEST_TILE, FARTHEST_TILE),
    'hits': Field(np.uint8, ('t', TILE, TILE), 0, 255),
    'seen': Field(np.uint8, ('t', TILE, TILE), 0, 255),
    'means': Field(np.float32, ('t', TILE, TILE, 2), -0.5, 0.5),
}


@inlined
def cell_of(at: float) -> int:
    """Row or column of the cell at a place, in cells."""
    return int(math.floor(at))


@inlined
def slot_of(lattice: Lattice, row: int, col: int) -> int:
    """Slot of the tile with a cell, counted from the first one, or NO_TILE."""
    tile_row, tile_col = row >> _SHIFT, col >> _SHIFT
    if tile_row < 0 or tile_col < 0:
        return NO_TILE
    if tile_row >= lattice.directory.shape[0] or tile_col >= lattice.directory.shape[1]:
        return NO_TILE
    return int(lattice.directory[tile_row, tile_col])


@inlined
def nearest_wall(lattice: Lattice, row: int, col: int) -> tuple[int, int, int]:
    """Slot, row and column of the wall nearest to a cell; NO_TILE where none is within reach."""
    slot = slot_of(lattice, row, col)
    if slot == NO_TILE:
        return NO_TILE, row, col
    cell = lattice.pool[slot, row & _MASK, col & _MASK]
    if cell['to_row'] == 0:
        return NO_TILE, row, col
    row, col = row + int(cell['to_row']) - HERE, col + int(cell['to_col']) - HERE
    return slot_of(lattice, row, col), row, col


@inlined
def cell_distance(lattice: Lattice, row: int, col: int) -> float:
    """Distance, in cells, from the middle of a cell to the hits of its nearest wall, or `reach`."""
    slot, wall_row, wall_col = nearest_wall(lattice, row, col)
    if slot == NO_TILE:
        return float(lattice.reach)
    wall = lattice.pool[slot, wall_row & _MASK, wall_col & _MASK]
    dx, dy = wall_col - col + wall['x'], wall_row - row + wall['y']
    return min(math.sqrt(dx * dx + dy * dy), float(lattice.reach))


@inlined
def normal_of(code: int) -> tuple[float, float]:
    """Normal of a wall, by its code; (0, 0) where it has none."""
    return _NORMALS[code, 0], _NORMALS[code, 1]


@inlined
def _off_wall(lattice: Lattice, row: int, col: int) -> tuple[float, float, float]:
    """Distance, in cells, from the middle of a cell to its nearest wall, with the wall's normal.

    Negative behind the wall, as the normal points; a wall without one is a point, and (0, 0).
    """
    slot, wall_row, wall_col = nearest_wall(lattice, row, col)
    if slot == NO_TILE:
        return float(lattice.reach), 0.0, 0.0
    wall = lattice.pool[slot, wall_row & _MASK, wall_col & _MASK]
    dx, dy = col - wall_col - wall['x'], row - wall_row - wall['y']
    code = int(wall['normal'])
    if code == 0:
        return min(math.sqrt(dx * dx + dy * dy), float(lattice.reach)), 0.0, 0.0
    nx, ny = _NORMALS[code, 0], _NORMALS[code, 1]
    across = nx * dx + ny * dy
    beyond = max(abs(nx * dy - ny * dx) - _HALF_WALL, 0.0)
    distance = min(math.sqrt(across * across + beyond * beyond), float(lattice.reach))
    return math.copysign(distance, across), nx, ny


@inlined
def interpolated(lattice: Lattice, x: float, y: float) -> tuple[float, float, float]:
    """Distance at (x, y), and its slopes, by the four cells around; all in cells.

    It changes its sign where a wall runs between the cells: without, it would be the same
    anywhere between two cells on either side.
    """
    col, row = cell_of(x - 0.5), cell_of(y - 0.5)
    u, v = x - 0.5 - col, y - 0.5 - row
    d00, nx, ny = _off_wall(lattice, row, col)
    d01, nx01, ny01 = _off_wall(lattice, row, col + 1)
    d10, nx10, ny10 = _off_wall(lattice, row + 1, col)
    d11, nx11, ny11 = _off_wall(lattice, row + 1, col + 1)
    s01, s10, s11 = nx * nx01 + ny * ny01, nx * nx10 + ny * ny10, nx * nx11 + ny * ny11
    if min(abs(s01), abs(s10), abs(s11)) > _PARALLEL:
        d01 = math.copysign(1.0, s01) * d01
        d10 = math.copysign(1.0, s10) * d10
        d11 = math.copysign(1.0, s11) * d11
    else:
        d00, d01, d10, d11 = abs(d00), abs(d01), abs(d10), abs(d11)
    lower, upper = d00 + u * (d01 - d00), d10 + u * (d11 - d10)
    by_x = (1.0 - v) * (d01 - d00) + v * (d11 - d10)
    return lower + v * (upper - lower), by_x, upper - lower


@kernel
def _distances(points: Array, lattice: Lattice) -> Array:
    """Distances (N,) of points (N, 2), m, with the sign that they have there."""
    found = np.empty(len(points))
    for i in range(len(points)):
        x = points[i, 0] / lattice.cell_m - lattice.first_col
        y = points[i, 1] / lattice.cell_m - lattice.first_row
        found[i] = lattice.cell_m * interpolated(lattice, x, y)[0]
    return found


@kernel
def _fitted_normal(lattice: Lattice, row: int, col: int, to_x: float, to_y: float) -> int:
    """Code of the normal of the wall at a cell, by the means of those around; 0: it has none."""
    for cells in _NORMAL_CELLS:
        code = _normal_within(lattice, row, col, cells, to_x, to_y)
        if code:
            return code
    return 0


@kernel
def _normal_within(
    lattice: Lattice, row: int, col: int, cells: int, to_x: float, to_y: float
) -> int:
    """The same, by the cells within so many to each side."""
    n, mx, my, xx, xy, yy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(-cells, cells + 1):
        for k in range(-cells, cells + 1):
            slot = slot_of(lattice, row + i, col + k)
            if slot == NO_TILE:
                continue
            cell = lattice.pool[slot, (row + i) & _MASK, (col + k) & _MASK]
            if cell['to_row'] != HERE or cell['to_col'] != HERE:
                continue
            code = int(cell['normal'])
            if code and _NORMALS[code, 0] * to_x + _NORMALS[code, 1] * to_y < 0.0:
                continue  # the other face of a thin wall
            x, y = k + cell['x'], i + cell['y']
            n, mx, my = n + 1, mx + x, my + y
            xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
    if n < 3:
        return 0
    mx, my = mx / n, my / n
    xx, xy, yy = xx / n - mx * mx, xy / n - mx * my, yy / n - my * my
    spread = math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    across, along = max(0.5 * (xx + yy) - spread, 0.0), 0.5 * (xx + yy) + spread
    if across > _THICK**2 or max(across, _NOISE**2) > n * along * _TILT**2:
        return 0
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    if -math.sin(angle) * to_x + math.cos(angle) * to_y < 0.0:
        angle += math.pi
    return 1 + int(angle / (2.0 * math.pi) * _CODES + 0.5) % _CODES


@kernel
def _touched(
    points: Array,
    laser: Array,
    low: NDArray[np.int64],
    high: NDArray[np.int64],
    edge_m: float,
    reach_m: float,
) -> NDArray[np.bool_]:
    """Tiles from low to high that beams touch, or whose cells are within reach of their ends."""
    touched = np.zeros((high[0] - low[0] + 1, high[1] - low[1] + 1), dtype=np.bool_)
    for i in range(len(points)):
        dx, dy = points[i, 0] - laser[0], points[i, 1] - laser[1]
        steps = int(2.0 * math.hypot(dx, dy) / edge_m) + 1
        for k in range(steps):
            x, y = laser[0] + k / steps * dx, laser[1] + k / steps * dy
            row, col = int(math.floor(y / edge_m)), int(math.floor(x / edge_m))
            touched[row - low[0], col - low[1]] = True
        for a in range(-1, 2):
            for b in range(-1, 2):
                row = int(math.floor((points[i, 1] + a * reach_m) / edge_m))
                col = int(math.floor((points[i, 0] + b * reach_m) / edge_m))
                touched[row - low[0], col - low[1]] = True
    return touched


@inlined
def _is_wall(cell: Any, share: float) -> bool:
    return bool(cell['hits'] > share * cell['seen'])


@inlined
def _observe(cell: Any, hit: int) -> None:
    """Count an observation; what is old counts less and less."""
    if cell['seen'] == _MOST_SEEN:
        cell['seen'] //= 2
        cell['hits'] //= 2
    cell['seen'] += 1
    cell['hits'] += hit


@kernel
def _add(
    points: Array,
    laser: Array,
    lattice: Lattice,
    share: float,
) -> None:
    """Count what beams saw, then bring the ways to the walls up to date."""
    gone = [(0, 0) for _ in range(0)]
    x0, y0 = (
        laser[0] / lattice.cell_m - lattice.first_col,
        laser[1] / lattice.cell_m - lattice.first_row,
    )
    for i in range(len(points)):
        x1, y1 = (
            points[i, 0] / lattice.cell_m - lattice.first_col,
            points[i, 1] / lattice.cell_m - lattice.first_row,
        )
        end_row, end_col = int(math.floor(y1)), int(math.floor(x1))
        steps = int(max(abs(x1 - x0), abs(y1 - y0))) + 1
        step_x, step_y = (x1 - x0) / steps, (y1 - y0) / steps
        x, y = x0 + 0.5 * step_x, y0 + 0.5 * step_y
        for _ in range(steps):
            row, col = int(math.floor(y)), int(math.floor(x))
            x, y = x + step_x, y + step_y
            slot = slot_of(lattice, row, col)
            if slot == NO_TILE or (row == end_row and col == end_col):
                continue
            cell = lattice.pool[slot, row & _MASK, col & _MASK]
            was_wall = _is_wall(cell, share)
            _observe(cell, 0)
            if was_wall and not _is_wall(cell, share):
                gone.append((row, col))
    _hit(points, laser, lattice, share)
    if len(gone):
        _vanish(lattice, gone, share)


@kernel
def _hit(
    points: Array,
    laser: Array,
    lattice: Lattice,
    share: float,
) -> None:
    """Count the points that beams met."""
    for i in range(len(points)):
        x, y = (
            points[i, 0] / lattice.cell_m - lattice.first_col,
            points[i, 1] / lattice.cell_m - lattice.first_row,
        )
        row, col = int(math.floor(y)), int(math.floor(x))
        slot = slot_of(lattice, row, col)
        if slot == NO_TILE:
            continue
        cell = lattice.pool[slot, row & _MASK, col & _MASK]
        was_wall = _is_wall(cell, share)
        _observe(cell, 1)
        cell['x'] += np.float32((x - col - 0.5 - cell['x']) / cell['hits'])
        cell['y'] += np.float32((y - row - 0.5 - cell['y']) / cell['hits'])
        if not was_wall and _is_wall(cell, share):
            _appear(lattice, row, col)
    for i in range(len(points)):
        x, y = (
            points[i, 0] / lattice.cell_m - lattice.first_col,
            points[i, 1] / lattice.cell_m - lattice.first_row,
        )
        row, col = int(math.floor(y)), int(math.floor(x))
        slot = slot_of(lattice, row, col)
        if slot != NO_TILE:
            code = _fitted_normal(
                lattice, row, col, laser[0] - points[i, 0], laser[1] - points[i, 1]
            )
            lattice.pool[slot, row & _MASK, col & _MASK]['normal'] = code


@kernel
def _lead(
    corners: NDArray[np.int64],
    lattice: Lattice,
    share: float,
) -> None:
    """Have all cells of tiles with first cells (N, 2) know their nearest walls."""
    for i in range(len(corners)):
        top, left = corners[i, 0] - lattice.first_row, corners[i, 1] - lattice.first_col
        for row in range(top, top + TILE):
            for col in range(left, left + TILE):
                slot = slot_of(lattice, row, col)
                if _is_wall(lattice.pool[slot, row & _MASK, col & _MASK], share):
                    _appear(lattice, row, col)
    for i in range(len(corners)):
        top, left = corners[i, 0] - lattice.first_row, corners[i, 1] - lattice.first_col
        for row in range(top, top + TILE):
            for col in range(left, left + TILE):
                slot = slot_of(lattice, row, col)
                if _is_wall(lattice.pool[slot, row & _MASK, col & _MASK], share):
                    code = _fitted_normal(lattice, row, col, 0.0, 0.0)
                    lattice.pool[slot, row & _MASK, col & _MASK]['normal'] = code


@kernel
def _appear(lattice: Lattice, row: int, col: int) -> None:
    """A cell has become a wall: those around to which it is the nearest lead there."""
    for down in range(-lattice.reach, lattice.reach + 1):
        for right in range(-lattice.reach, lattice.reach + 1):
            squared = down * down + right * right
            slot = slot_of(lattice, row + down, col + right)
            if slot == NO_TILE or squared > lattice.reach * lattice.reach:
                continue
            cell = lattice.pool[slot, (row + down) & _MASK, (col + right) & _MASK]
            to_row, to_col = int(cell['to_row']) - HERE, int(cell['to_col']) - HERE
            if cell['to_row'] == 0 or squared < to_row * to_row + to_col * to_col:
                cell['to_row'], cell['to_col'] = HERE - down, HERE - right


@kernel
def _vanish(lattice: Lattice, gone: list[tuple[int, int]], share: float) -> None:
    """Cells are walls no more: those that led there take the nearest wall of their neighbours."""
    led = [(0, 0) for _ in range(0)]
    for row, col in gone:
        slot = slot_of(lattice, row, col)
        if _is_wall(lattice.pool[slot, row & _MASK, col & _MASK], share):
            continue
        for down in range(-lattice.reach, lattice.reach + 1):
            for right in range(-lattice.reach, lattice.reach + 1):
                slot = slot_of(lattice, row + down, col + right)
                if slot == NO_TILE:
                    continue
                cell = lattice.pool[slot, (row + down) & _MASK, (col + right) & _MASK]
                if cell['to_row'] == HERE - down and cell['to_col'] == HERE - right:
                    cell['to_row'] = 0
                    led.append((row + down, col + right))
    changed = len(led) > 0
    while changed:
        changed = False
        for row, col in led:
            slot = slot_of(lattice, row, col)
            changed |= _ask(lattice, row, col)


@inlined
def _ask(lattice: Lattice, row: int, col: int) -> bool:
    """Whether one of its neighbours knows a nearer wall for a cell, which leads there then."""
    changed = False
    cell = lattice.pool[slot_of(lattice, row, col), row & _MASK, col & _MASK]
    for i in range(-1, 2):
        for j in range(-1, 2):
            slot = slot_of(lattice, row + i, col + j)
            if slot == NO_TILE:
                continue
            other = lattice.pool[slot, (row + i) & _MASK, (col + j) & _MASK]
            if other['to_row'] == 0:
                continue
            down = i + int(other['to_row']) - HERE
            right = j + int(other['to_col']) - HERE
            to_row, to_col = int(cell['to_row']) - HERE, int(cell['to_col']) - HERE
            squared = down * down + right * right
            nearer = cell['to_row'] == 0 or squared < to_row * to_row + to_col * to_col
            if squared <= lattice.reach * lattice.reach and nearer:
                cell['to_row'], cell['to_col'] = HERE + down, HERE + right
                changed = True
    return changed
