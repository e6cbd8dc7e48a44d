"""Local map for scan matching: hit counts, and the offset to the nearest wall for each cell.

A cell counts its hits (beams that end in it) and its observations (hits, and beams through it). It
stores the mean of its hits, which is much nearer to the surface than the centre of the cell. A cell
is a wall if enough of its observations are hits. Each cell near a wall stores the offset to the
nearest one, so that distances to walls are looked up, not searched.
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
from thinmap_ros.core.grid.tiles import MAX_TILE_INDEX, NO_TILE, TILE, TileStore
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.matching.surface import COLUMNS
from thinmap_ros.core.snapshot import Field
from thinmap_ros.jit import inlined, kernel

# Apart from the surfaces, which walls alone have: kernels pass through many cells for each hit, and
# most of their time is that of the memory.
CELL = np.dtype(
    [
        ('hits', np.uint8),
        ('seen', np.uint8),
        ('to_row', np.uint8),  # offset to the nearest wall, cells, + HERE; 0: none within reach
        ('to_col', np.uint8),
    ]
)
SURFACE = np.dtype(
    [
        ('x', np.float32),  # mean of the hits, in cells from the corner of this cell
        ('y', np.float32),
        ('cos2', np.float32),  # mean of the double angle of the surface normal
        ('sin2', np.float32),
        ('face_x', np.float32),  # mean of the normal towards the laser; 0 if hit from both sides
        ('face_y', np.float32),
    ]
)
HERE = 100  # stored value of an offset of 0
_SHIFT = TILE.bit_length() - 1
TILE_MASK = TILE - 1
_MAX_SEEN = 255
_MAX_EXTENT_TILES = 1 << 20  # at cells of 0.05 m 3.3 km in each direction, mostly without tiles
# Largest distance at which a point still finds its wall; at most TILE - 1 cells.
MAX_WALL_DISTANCE_M = 0.5
# Smallest ratio of hits to observations of a wall: more, and poles are lost; less, and people who
# move leave walls behind.
MIN_HIT_RATIO = 0.25
_FAR_M = 1e4  # distance from which the walls of an occupancy map are taken to be observed


@dataclass(frozen=True)
class LocalMapConfig(Config):
    """Parameters of the local map."""

    resolution_m: float = parameter(
        0.05,
        'Edge of a cell of the local map (m). Lower: more accurate and more memory.',
        low=0.01,
        high=0.5,
    )


class LocalMapView(NamedTuple):
    """View of the cells for kernels, valid until the map grows.

    pool: tiles of cells, dtype CELL; surfaces: of those in them, dtype SURFACE; directory: the slot
    of each tile, or NO_TILE; first_row, first_col: first cell of the directory; reach: largest
    distance to a wall, in cells.
    """

    pool: NDArray[Any]
    surfaces: NDArray[Any]
    directory: NDArray[np.int32]
    first_row: int
    first_col: int
    cell_m: float
    reach: int


class LocalMap:
    """Grid of cells in tiles, map frame, that grows in any direction."""

    def __init__(self, config: LocalMapConfig | None = None) -> None:
        self.config = config or LocalMapConfig()
        self.tiles, self.surfaces = (
            TileStore(dtype, max_extent_tiles=_MAX_EXTENT_TILES, begins_at_origin=False)
            for dtype in (CELL, SURFACE)
        )
        # Below a tile, so that only adjacent tiles are read.
        reach = math.ceil(MAX_WALL_DISTANCE_M / self.config.resolution_m)
        self._reach_cells = min(reach, TILE - 1)

    @property
    def is_empty(self) -> bool:
        """Whether no scan or wall was added yet."""
        return self.tiles.used == 0

    @property
    def lattice(self) -> LocalMapView:
        """View of the cells for kernels, valid until the map grows."""
        tiles = self.tiles
        return LocalMapView(
            tiles.pool,
            self.surfaces.pool,
            tiles.directory,
            tiles.first_row * TILE,
            tiles.first_col * TILE,
            self.config.resolution_m,
            self._reach_cells,
        )

    def add_scan(self, points: Array, T_base_laser: Array, T_map_base: Array) -> None:
        """Add surface points (N, 5), robot frame, of a scan at a pose (3,).

        Raises InputError, and leaves the map unchanged, if it would become too large.
        """
        if len(points) == 0:
            return
        laser = np.ascontiguousarray(T_base_laser[:2])
        ends_map = se2.transform_points(T_map_base, points[:, :2])
        self._reach(ends_map, se2.transform_points(T_map_base, laser[None])[0])
        _add(points, laser, T_map_base, self.lattice, MIN_HIT_RATIO)

    def add_walls(self, points_map: Array, normal: Array) -> None:
        """Add points (N, 2), map frame, on walls of an occupancy map with a normal (2,)."""
        if len(points_map):
            cells = np.floor(points_map / self.config.resolution_m).astype(np.int64)
            _, once = np.unique(cells, axis=0, return_index=True)
            points = np.zeros((len(once), COLUMNS))
            points[:, :2] = points_map[np.sort(once)]
            points[:, 2] = normal[0] ** 2 - normal[1] ** 2
            points[:, 3] = 2.0 * normal[0] * normal[1]
            self._reach(np.ascontiguousarray(points[:, :2]), points[0, :2])
            far = points[:, :2].mean(axis=0) + _FAR_M * normal
            _hit(points, far, np.zeros(3), self.lattice, MIN_HIT_RATIO)

    def add_free_cells(self, free: NDArray[np.bool_], row: int, col: int) -> None:
        """Add cells (H, W) that an occupancy map knows to be free, the first one at (row, col).

        Before its walls: these are propagated into the cells that exist.
        """
        if not free.any():
            return
        padded = np.pad(free, ((row % TILE, -(row + free.shape[0]) % TILE), (col % TILE, 0)))
        padded = np.pad(padded, ((0, 0), (0, -padded.shape[1] % TILE)))
        rows = padded.shape[0] // TILE
        cols = padded.shape[1] // TILE
        blocks = padded.reshape(rows, TILE, cols, TILE).swapaxes(1, 2)
        used = np.argwhere(blocks.any(axis=(2, 3)))
        places = used + (row // TILE, col // TILE)
        self._allocate(places)
        cells = self.tiles.read_tiles(places)
        cells['seen'] = np.maximum(cells['seen'], blocks[tuple(used.T)])
        self.tiles.write_tiles(places, cells)

    def corners(self) -> Array:
        """First and last corner (2, 2) of the box of its tiles, m, map frame; (0, 2) if empty."""
        bounds = self.tiles.bounds()
        if bounds is None:
            return np.empty((0, 2))
        row, col, end_row, end_col = bounds
        return self.config.resolution_m * np.array([[col, row], [end_col, end_row]], dtype=float)

    def state(self) -> dict[str, NDArray[Any]]:
        """All cells as arrays by name, for `restore`."""
        tiles = self.tiles
        cells = tiles.pool[: tiles.used]
        means, normals, faces = np.split(self._surface_values, 3, axis=-1)
        return {
            'cell_m': np.array(self.config.resolution_m),
            'tiles': tiles.tile_coordinates(),
            'hits': cells['hits'],
            'seen': cells['seen'],
            'means': means,
            'normals': normals,
            'faces': faces,
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore the cells of a `state`, checked by FIELDS, into an empty map.

        Raises InputError if the cell size differs, or if the tiles are too far apart for one map.
        """
        cell_m = float(state['cell_m'])
        own = self.config.resolution_m
        snapshot.require(cell_m == own, f'local map: cells of {cell_m} m', f'{own} m')
        places = state['tiles']
        if not len(places):
            return
        once = len(np.unique(places, axis=0)) == len(places)
        snapshot.require(once, 'local map: tiles: one occurs twice', 'each tile once')
        self._allocate(places)
        cells = self.tiles.pool[: len(places)]
        cells['hits'] = np.minimum(state['hits'], state['seen'])
        cells['seen'] = state['seen']
        values = [state[name] for name in ('means', 'normals', 'faces')]
        self._surface_values[:] = np.concatenate(values, axis=-1)
        _lead(places * TILE, self.lattice, MIN_HIT_RATIO)

    def _reach(self, points_map: Array, laser_map: Array) -> None:
        """Allocate all tiles that the beams touch, and those within reach of their ends."""
        reach = self._reach_cells * self.config.resolution_m
        edge_m = TILE * self.config.resolution_m
        both = np.vstack([points_map, laser_map])
        low = np.floor((both.min(axis=0) - reach) / edge_m).astype(np.int64)[::-1]
        high = np.floor((both.max(axis=0) + reach) / edge_m).astype(np.int64)[::-1]
        self._grow_to(low, high)
        touched = _touched(points_map, laser_map, low, high, edge_m, reach)
        self._allocate(np.argwhere(touched) + low)

    @property
    def _surface_values(self) -> NDArray[np.float32]:
        """View (T, TILE, TILE, 6) of the surfaces of all tiles."""
        surfaces = self.surfaces.pool[: self.surfaces.used]
        return surfaces.view(np.float32).reshape(*surfaces.shape, len(SURFACE.names or ()))

    def _allocate(self, places: NDArray[np.int64]) -> None:
        """Allocate tiles (N, 2) of cells, and of their surfaces in the same slots."""
        self._grow_to(places.min(axis=0), places.max(axis=0))
        for store in (self.tiles, self.surfaces):
            store.allocate(places)

    def _grow_to(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
        """Make room for tiles between two (2,). Raises InputError if they are too far apart."""
        for store in (self.tiles, self.surfaces):
            store.grow_to(*low.tolist(), *high.tolist())


FIELDS = {
    'cell_m': Field(np.float64, (), 1e-3, 10.0),
    'tiles': Field(np.int64, ('t', 2), -MAX_TILE_INDEX, MAX_TILE_INDEX),
    'hits': Field(np.uint8, ('t', TILE, TILE), 0, 255),
    'seen': Field(np.uint8, ('t', TILE, TILE), 0, 255),
    'means': Field(np.float32, ('t', TILE, TILE, 2), 0.0, 1.0),
    'normals': Field(np.float32, ('t', TILE, TILE, 2), -1.001, 1.001),
    'faces': Field(np.float32, ('t', TILE, TILE, 2), -1.001, 1.001),
}


@inlined
def cell_of(at: float) -> int:
    """Row or column of the cell at a coordinate, in cells."""
    return int(math.floor(at))


@inlined
def slot_of(lattice: LocalMapView, row: int, col: int) -> int:
    """Slot of the tile with a cell (row and column relative to the first cell), or NO_TILE."""
    tile_row = row >> _SHIFT
    tile_col = col >> _SHIFT
    if tile_row < 0 or tile_col < 0:
        return NO_TILE
    if tile_row >= lattice.directory.shape[0] or tile_col >= lattice.directory.shape[1]:
        return NO_TILE
    return int(lattice.directory[tile_row, tile_col])


@inlined
def cells_to_wall(cell: Any) -> float:
    """Length of the offset of a cell to its nearest wall, in cells; inf beyond the reach."""
    if cell['to_row'] == 0:
        return np.inf
    down = int(cell['to_row']) - HERE
    right = int(cell['to_col']) - HERE
    return math.sqrt(down * down + right * right)


@inlined
def off_wall(
    lattice: LocalMapView, x: float, y: float
) -> tuple[bool, bool, float, float, int, Any]:
    """Offset of a point (x, y), in cells, from its nearest wall.

    Returns whether the point's cell was observed, whether a wall is within reach, the offset (2)
    from the mean of the wall's hits, in cells, their number, and the surface of the wall.
    """
    row = cell_of(y)
    col = cell_of(x)
    slot = slot_of(lattice, row, col)
    if slot == NO_TILE:
        return False, False, 0.0, 0.0, 0, lattice.surfaces[0, 0, 0]
    cell = lattice.pool[slot, row & TILE_MASK, col & TILE_MASK]
    is_seen = bool(cell['seen'] > 0)
    if cell['to_row'] == 0:
        return is_seen, False, 0.0, 0.0, 0, lattice.surfaces[0, 0, 0]
    row += int(cell['to_row']) - HERE
    col += int(cell['to_col']) - HERE
    slot = slot_of(lattice, row, col)
    hits = int(lattice.pool[slot, row & TILE_MASK, col & TILE_MASK]['hits'])
    wall = lattice.surfaces[slot, row & TILE_MASK, col & TILE_MASK]
    return is_seen, True, x - col - wall['x'], y - row - wall['y'], hits, wall


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
        dx = points[i, 0] - laser[0]
        dy = points[i, 1] - laser[1]
        steps = int(2.0 * math.hypot(dx, dy) / edge_m) + 1
        for k in range(steps):
            x = laser[0] + k / steps * dx
            y = laser[1] + k / steps * dy
            row = int(math.floor(y / edge_m))
            col = int(math.floor(x / edge_m))
            touched[row - low[0], col - low[1]] = True
        for a in range(-1, 2):
            for b in range(-1, 2):
                row = int(math.floor((points[i, 1] + a * reach_m) / edge_m))
                col = int(math.floor((points[i, 0] + b * reach_m) / edge_m))
                touched[row - low[0], col - low[1]] = True
    return touched


@inlined
def is_wall(cell: Any, share: float) -> bool:
    """Whether a cell is a wall: hits are more than a share of its observations."""
    return bool(cell['hits'] > share * cell['seen'])


@inlined
def _observe(cell: Any, hit: int) -> None:
    """Count an observation; the weight of old ones decays once the counter is full."""
    if cell['seen'] == _MAX_SEEN:
        cell['seen'] //= 2
        cell['hits'] //= 2
    cell['seen'] += 1
    cell['hits'] += hit


@kernel
def _add(
    points: Array, laser: Array, T_map_base: Array, lattice: LocalMapView, share: float
) -> None:
    """Count the cells that beams traverse, then those where they end; update nearest walls."""
    cos = math.cos(T_map_base[2])
    sin = math.sin(T_map_base[2])
    x0 = (T_map_base[0] + cos * laser[0] - sin * laser[1]) / lattice.cell_m - lattice.first_col
    y0 = (T_map_base[1] + sin * laser[0] + cos * laser[1]) / lattice.cell_m - lattice.first_row
    gone = [(0, 0) for _ in range(0)]
    for i in range(len(points)):
        px = points[i, 0]
        py = points[i, 1]
        x1 = (T_map_base[0] + cos * px - sin * py) / lattice.cell_m - lattice.first_col
        y1 = (T_map_base[1] + sin * px + cos * py) / lattice.cell_m - lattice.first_row
        end_row = cell_of(y1)
        end_col = cell_of(x1)
        steps = int(max(abs(x1 - x0), abs(y1 - y0))) + 1
        step_x = (x1 - x0) / steps
        step_y = (y1 - y0) / steps
        x = x0 + 0.5 * step_x
        y = y0 + 0.5 * step_y
        for _ in range(steps):
            row = cell_of(y)
            col = cell_of(x)
            x = x + step_x
            y = y + step_y
            slot = slot_of(lattice, row, col)
            # Near its end a beam that grazes a wall traverses cells of this wall.
            if slot == NO_TILE or (abs(row - end_row) <= 1 and abs(col - end_col) <= 1):
                continue
            cell = lattice.pool[slot, row & TILE_MASK, col & TILE_MASK]
            was_wall = is_wall(cell, share)
            _observe(cell, 0)
            if was_wall and not is_wall(cell, share):
                gone.append((row, col))
    _hit(points, laser, T_map_base, lattice, share)
    if len(gone):
        _vanish(lattice, gone, share)


@inlined
def _learn_surface(
    surface: Any, hits: int, x: float, y: float, normal: tuple[float, float, float]
) -> None:
    """Update the means of a surface by the last of its hits, at (x, y), in cells from its corner.

    normal: cosine and sine of the double angle of the surface normal, and the signed distance of
    the laser along the normal at half of this angle.
    """
    gain = np.float32(1.0 / hits)
    cos2, sin2, side = normal
    half = 0.5 * math.atan2(sin2, cos2)
    sign = math.copysign(1.0, side)
    surface['x'] += gain * np.float32(x - surface['x'])
    surface['y'] += gain * np.float32(y - surface['y'])
    surface['cos2'] += gain * np.float32(cos2 - surface['cos2'])
    surface['sin2'] += gain * np.float32(sin2 - surface['sin2'])
    surface['face_x'] += gain * np.float32(sign * math.cos(half) - surface['face_x'])
    surface['face_y'] += gain * np.float32(sign * math.sin(half) - surface['face_y'])


@kernel
def _hit(
    points: Array, laser: Array, T_map_base: Array, lattice: LocalMapView, share: float
) -> None:
    """Count hits, and update nearest walls where cells become walls."""
    cos = math.cos(T_map_base[2])
    sin = math.sin(T_map_base[2])
    cos2 = math.cos(2.0 * T_map_base[2])
    sin2 = math.sin(2.0 * T_map_base[2])
    for i in range(len(points)):
        px = points[i, 0]
        py = points[i, 1]
        x = (T_map_base[0] + cos * px - sin * py) / lattice.cell_m - lattice.first_col
        y = (T_map_base[1] + sin * px + cos * py) / lattice.cell_m - lattice.first_row
        row = cell_of(y)
        col = cell_of(x)
        slot = slot_of(lattice, row, col)
        if slot == NO_TILE:
            continue
        cell = lattice.pool[slot, row & TILE_MASK, col & TILE_MASK]
        was_wall = is_wall(cell, share)
        _observe(cell, 1)
        c2 = points[i, 2]
        s2 = points[i, 3]
        back_x = cos * (laser[0] - px) - sin * (laser[1] - py)
        back_y = sin * (laser[0] - px) + cos * (laser[1] - py)
        turned = (cos2 * c2 - sin2 * s2, sin2 * c2 + cos2 * s2)
        own = 0.5 * math.atan2(turned[1], turned[0])
        side = math.cos(own) * back_x + math.sin(own) * back_y
        surface = lattice.surfaces[slot, row & TILE_MASK, col & TILE_MASK]
        normal = (turned[0], turned[1], side)
        _learn_surface(surface, cell['hits'], x - col, y - row, normal)
        if not was_wall and is_wall(cell, share):
            _appear(lattice, row, col)


@kernel
def _lead(
    corners: NDArray[np.int64],
    lattice: LocalMapView,
    share: float,
) -> None:
    """Compute the nearest-wall offsets of whole tiles, given their first cells (N, 2)."""
    for i in range(len(corners)):
        top = corners[i, 0] - lattice.first_row
        left = corners[i, 1] - lattice.first_col
        for row in range(top, top + TILE):
            for col in range(left, left + TILE):
                slot = slot_of(lattice, row, col)
                if is_wall(lattice.pool[slot, row & TILE_MASK, col & TILE_MASK], share):
                    _appear(lattice, row, col)


@kernel
def _appear(lattice: LocalMapView, row: int, col: int) -> None:
    """Add a wall: cells to which it is the nearest one refer to it."""
    for down in range(-lattice.reach, lattice.reach + 1):
        side = int(math.sqrt(lattice.reach * lattice.reach - down * down))
        for right in range(-side, side + 1):
            squared = down * down + right * right
            slot = slot_of(lattice, row + down, col + right)
            if slot == NO_TILE:
                continue
            cell = lattice.pool[slot, (row + down) & TILE_MASK, (col + right) & TILE_MASK]
            to_row = int(cell['to_row']) - HERE
            to_col = int(cell['to_col']) - HERE
            if cell['to_row'] == 0 or squared < to_row * to_row + to_col * to_col:
                cell['to_row'] = HERE - down
                cell['to_col'] = HERE - right


@kernel
def _vanish(lattice: LocalMapView, gone: list[tuple[int, int]], share: float) -> None:
    """Remove walls, and propagate other nearest walls into the cells that referred to them."""
    led = [(0, 0) for _ in range(0)]
    for row, col in gone:
        slot = slot_of(lattice, row, col)
        if is_wall(lattice.pool[slot, row & TILE_MASK, col & TILE_MASK], share):
            continue
        for down in range(-lattice.reach, lattice.reach + 1):
            for right in range(-lattice.reach, lattice.reach + 1):
                slot = slot_of(lattice, row + down, col + right)
                if slot == NO_TILE:
                    continue
                cell = lattice.pool[slot, (row + down) & TILE_MASK, (col + right) & TILE_MASK]
                if cell['to_row'] == HERE - down and cell['to_col'] == HERE - right:
                    cell['to_row'] = 0
                    led.append((row + down, col + right))
    changed = len(led) > 0
    while changed:
        changed = False
        for row, col in led:
            changed |= _ask(lattice, row, col)


@inlined
def _ask(lattice: LocalMapView, row: int, col: int) -> bool:
    """Adopt the nearest wall of a neighbour cell if it is nearer; returns whether it was."""
    changed = False
    cell = lattice.pool[slot_of(lattice, row, col), row & TILE_MASK, col & TILE_MASK]
    for i in range(-1, 2):
        for j in range(-1, 2):
            slot = slot_of(lattice, row + i, col + j)
            if slot == NO_TILE:
                continue
            other = lattice.pool[slot, (row + i) & TILE_MASK, (col + j) & TILE_MASK]
            if other['to_row'] == 0:
                continue
            down = i + int(other['to_row']) - HERE
            right = j + int(other['to_col']) - HERE
            to_row = int(cell['to_row']) - HERE
            to_col = int(cell['to_col']) - HERE
            squared = down * down + right * right
            nearer = cell['to_row'] == 0 or squared < to_row * to_row + to_col * to_col
            if squared <= lattice.reach * lattice.reach and nearer:
                cell['to_row'] = HERE + down
                cell['to_col'] = HERE + right
                changed = True
    return changed
