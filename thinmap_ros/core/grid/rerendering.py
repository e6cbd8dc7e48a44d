"""Re-renders a grid in slices after a correction, tiles near the robot first."""

from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.erasing import add_scan_outside
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.grid.tiles import TILE
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

# Work of a slice, in tiles that scans may touch: 2 to 15 ms on a desktop processor.
_TILES_PER_SLICE = 512
# At least two scans, whatever they touch: while one scan arrives, two are rendered.
_SCANS_PER_SLICE = 2
_MARGIN_CELLS = 2  # by which the cells of a scan may lie beyond the ends of its beams
_LAST_RING = 1 << 30
_Cells = NDArray[np.int64]


class StoredScan(NamedTuple):
    """A scan, and the bounding rectangle of its beams.

    extent (4,): lowest x and y, highest x and y, robot frame, m. erasures: how many parts of the
    map had been erased when it was made.
    """

    scan: Scan
    extent: Array
    erasures: int = 0

    @staticmethod
    def of(scan: Scan, config: OccupancyConfig, erasures: int = 0) -> 'StoredScan':
        """Store a scan, with the extent that a grid of this configuration renders.

        Or would render if beams without return showed free space.
        """
        usable = scan.max_range_m
        ranges = np.where(scan.returned, scan.ranges_m, 0.0)
        reach = np.minimum(ranges + config.surface_thickness_m, usable)
        without_return = min(config.no_return_clear_range_m, scan.range_max_m, usable)
        reach = np.where(scan.without_return, without_return, reach)
        bearings = scan.angles_rad + scan.T_base_laser[2]
        x = np.append(reach * np.cos(bearings), 0.0) + scan.T_base_laser[0]
        y = np.append(reach * np.sin(bearings), 0.0) + scan.T_base_laser[1]
        return StoredScan(scan, np.array([x.min(), y.min(), x.max(), y.max()]), erasures)


class _Task(NamedTuple):
    """A scan to be rendered.

    ring: of the nearest tile that it may touch; tiles: how many tiles it may touch.
    """

    ring: int
    tiles: int
    stored: StoredScan
    T_map_base: Array


class _Queue:
    """The scans to be rendered: first those before the correction, then those since.

    The former are stored in arrays: thousands of small objects would trigger the garbage collector.
    """

    def __init__(
        self, scans: Sequence[StoredScan], poses: Array, rings: _Cells, tile_counts: _Cells
    ) -> None:
        """Start with scans at poses (N, 3); nearest ring (N,) and number of tiles (N,) of each."""
        order = np.argsort(rings, kind='stable')
        self._scans = [scans[k] for k in order.tolist()]
        self._poses = poses[order]
        self._rings = rings[order]
        self._tiles = tile_counts[order]
        self._next = 0
        self._since: deque[_Task] = deque()

    def __len__(self) -> int:
        return len(self._scans) - self._next + len(self._since)

    def append(self, stored: StoredScan, T_map_base: Array, tiles: int) -> None:
        """Add a scan that was made since the correction."""
        self._since.append(_Task(_LAST_RING, tiles, stored, T_map_base))

    @property
    def first(self) -> _Task:
        """The next scan."""
        k = self._next
        if k == len(self._scans):
            return self._since[0]
        return _Task(int(self._rings[k]), int(self._tiles[k]), self._scans[k], self._poses[k])

    def pop(self) -> _Task:
        """Remove and return the next scan."""
        task = self.first
        if self._next == len(self._scans):
            self._since.popleft()
        else:
            self._next += 1
        return task


class Rerendering:
    """Renders all stored scans at their corrected poses, in slices.

    Tiles form square rings around the tile of the robot. Scans are sorted by the nearest ring that
    they may touch, and within a ring by time. A ring is complete as soon as the next scan does not
    touch it, and the tiles near the robot are rendered in the order of their scans.
    Scans that arrive meanwhile are rendered last. Until then, they are added to the completed tiles
    that are shown. At the end, `grid` equals a rendering of all scans at once.
    """

    def __init__(
        self,
        like: OccupancyGrid,
        kept: Sequence[StoredScan],
        poses: Array,
        T_map_base: Array,
        drops_out: bool = False,
        erased: Sequence[Array] = (),
    ) -> None:
        """Start with the stored scans at their poses (N, 3).

        like: a grid with the same cells and configuration; T_map_base (3,): pose of the robot;
        drops_out: of the laser, as is known now, for all scans; those that have it, keep it;
        erased: polygons (M, 2), m, of which only scans since show anything.
        """
        self._drops_out = drops_out
        self._erased = erased
        self.grid = OccupancyGrid(like.config, like.frame)
        self._added = OccupancyGrid(like.config, like.frame)  # scans that arrived meanwhile
        self._robot_tile = like.frame.cells_of(T_map_base[None, :2])[0] // TILE
        self._complete_rings = 0
        boxes = _tile_boxes([each.extent for each in kept], poses, like.frame)
        rings = self._rings(boxes[:, 0], boxes[:, 1])
        counts = np.prod(boxes[:, 1] - boxes[:, 0] + 1, axis=1)
        self._queue = _Queue(kept, poses, rings, counts)

    @property
    def is_complete(self) -> bool:
        """Whether all scans are rendered."""
        return len(self._queue) == 0

    def add_scan(self, kept: StoredScan, T_map_base: Array) -> None:
        """Add a scan that arrived meanwhile, made at a pose (3,) that is already correct."""
        with suppress(InputError):  # it is shown when all is complete
            self._added.add_scan(kept.scan, T_map_base)
        box = _tile_boxes([kept.extent], T_map_base[None], self.grid.frame)[0]
        tiles = int(np.prod(box[1] - box[0] + 1))
        self._queue.append(kept, T_map_base, tiles)

    def render_slice(self, shown: OccupancyGrid) -> list[str]:
        """Render some scans, and update the shown grid, unless `grid` is complete now.

        Returns why scans were left out whose corrected poses would make the map too large.
        """
        scans = 0
        tiles = 0
        refusals: list[str] = []
        while self._queue:
            tiles += self._queue.first.tiles
            if scans >= _SCANS_PER_SLICE and tiles > _TILES_PER_SLICE:
                break
            task = self._queue.pop()
            try:
                scan = task.stored.scan
                scan = replace(scan, drops_out=self._drops_out or scan.drops_out)
                erased = self._erased[task.stored.erasures :]
                add_scan_outside(self.grid, scan, task.T_map_base, erased)
            except InputError as error:
                refusals.append(str(error))
            scans += 1
        if self._queue:
            self._show_complete_rings(shown)
        return refusals

    def _show_complete_rings(self, shown: OccupancyGrid) -> None:
        complete = self._queue.first.ring
        if complete <= self._complete_rings:
            return
        places = np.unique(np.vstack([shown.tiles(), self.grid.tiles()]), axis=0)
        rings = self._rings(places, places)
        completed = places[(rings >= self._complete_rings) & (rings < complete)]
        with suppress(InputError):  # old and new rendering are too far apart for one map
            shown.set_tiles(completed, self.grid, self._added)
        self._complete_rings = complete

    def _rings(self, low: _Cells, high: _Cells) -> _Cells:
        """Nearest ring (N,) of each box of tiles from low (N, 2) to high (N, 2), inclusive."""
        beyond = np.maximum(low - self._robot_tile, self._robot_tile - high)
        rings: _Cells = np.maximum(beyond.max(axis=1), 0)
        return rings


def _tile_boxes(extents: Sequence[Array], poses: Array, frame: GridFrame) -> _Cells:
    """First and last tile (N, 2, 2), each (row, col), that scans at poses (N, 3) may touch."""
    corners = np.array(extents).reshape(-1, 4)[:, [[0, 1], [0, 3], [2, 1], [2, 3]]]
    c = np.cos(poses[:, 2])[:, None]
    s = np.sin(poses[:, 2])[:, None]
    x = poses[:, None, 0] + c * corners[..., 0] - s * corners[..., 1]
    y = poses[:, None, 1] + s * corners[..., 0] + c * corners[..., 1]
    rows = (y - frame.origin_y) / frame.resolution
    cols = (x - frame.origin_x) / frame.resolution
    low = np.column_stack([rows.min(axis=1), cols.min(axis=1)]) - _MARGIN_CELLS
    high = np.column_stack([rows.max(axis=1), cols.max(axis=1)]) + _MARGIN_CELLS
    return np.floor(np.stack([low, high], axis=1) / TILE).astype(np.int64)
