"""A grid that is corrected: rendered again from stored scans, tiles near the robot first."""

import math
from array import array
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.edits import Erasures, touched_cells
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import Bounds, GridFrame
from thinmap_ros.core.grid.tiles import TILE
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, Cells, Mask
from thinmap_ros.core.stage import Destination

_MAX_PLACE = 1 << 26  # more places than lie within MAX_COORDINATE_M
# Of the place of another robot's map: less than what is cut out around a robot beside it.
_CORRECTED_M = 0.1
_CORRECTED_RAD = 0.02
_MARGIN_CELLS = 2  # by which the cells of a scan may lie beyond the ends of its beams
MAX_OPEN = 1000  # scans that wait, the latest; 10 MB of a robot that stands at a start pose

# Work of a slice, in tiles that scans may touch: 2 to 15 ms on a desktop processor.
_TILES_PER_SLICE = 512
# At least two scans, whatever they touch: while one scan arrives, two are rendered.
_SCANS_PER_SLICE = 2
_LAST_RING = 1 << 30

Kept = TypeVar('Kept')


# Which scans are stored: those some distance or angle apart, the newest of each place.
_APART_M = 0.25
_APART_RAD = 0.25
_PLACE_M = 1.0  # edge of a place
_DIRECTIONS = 8  # robot headings that are distinguished at each place
_SCANS_PER_PLACE = 4  # and direction: about one visit


class CorrectedPoses(NamedTuple):
    """Poses (N, 3) of the stored scans before and after the corrections of a map."""

    before: Array
    after: Array


class PoseHistory(Generic[Kept]):
    """The pose of every scan, and stored data of some scans.

    Of the scans of a laser that are 0.25 m or 0.25 rad apart, the newest four of each place and
    direction are stored: their number grows with the area, not with time. A correction gives the
    poses of some scans, by their stamps. Every other scan moves with the last of these before it,
    in the order in which the scans were added: stamps of real robots step back now and then.
    """

    def __init__(self) -> None:
        self._stamps = array('q')
        self._poses = array('d')
        self._last_apart: dict[str, int] = {}  # by the frame of the laser
        self._kept: dict[int, tuple[str, Kept]] = {}  # frame and data, by the index of the scan
        self._at_place: dict[tuple[str, int], deque[int]] = {}
        # All poses before the first correction that has not been accepted yet.
        self._before: Array | None = None

    def add_pose(self, stamp_ns: int, T_map_base: Array, kept: Kept, frame: str = '') -> None:
        """Add the pose (3,) of a scan; `kept` is stored if the scan is far enough from others.

        frame: of its laser.
        """
        number = len(self._stamps)
        self._stamps.append(stamp_ns)
        self._poses.extend(T_map_base.tolist())
        if frame not in self._last_apart:
            self._adopt(frame)
        before = self._last_apart.get(frame)
        if before is not None:
            last = np.array(self._poses[3 * before : 3 * before + 3])
            moved = se2.between(last, T_map_base)
            is_near = math.hypot(moved[0], moved[1]) < _APART_M
            if is_near and abs(float(moved[2])) < _APART_RAD:
                return
        self._last_apart[frame] = number
        self._kept[number] = (frame, kept)
        at_place = self._at_place.setdefault((frame, int(_places_of(T_map_base[None])[0])), deque())
        at_place.append(number)
        while len(at_place) > _SCANS_PER_PLACE:
            del self._kept[at_place.popleft()]

    def _adopt(self, frame: str) -> None:
        """Take the scans of an unknown laser, as of a session, for those of one that is new."""
        last = self._last_apart.pop('', None)
        if last is None:
            return
        self._last_apart[frame] = last
        self._kept = {number: (own or frame, kept) for number, (own, kept) in self._kept.items()}
        self._sort_by_place()

    def last_pose(self) -> Array | None:
        """Pose (3,) of the newest scan; None before the first."""
        return np.array(self._poses[-3:]) if self._poses else None

    def extend(self, other: 'PoseHistory[Kept]') -> None:
        """Add the scans of another history, at their present poses."""
        first = len(self._stamps)
        self._stamps.extend(other._stamps)
        self._poses.extend(other._poses)
        self._last_apart |= {frame: first + last for frame, last in other._last_apart.items()}
        self._kept |= {first + number: kept for number, kept in other._kept.items()}
        self._sort_by_place()

    def kept(self) -> list[Kept]:
        """The stored data, in the order in which it was added."""
        return [kept for _, kept in self._kept.values()]

    def kept_poses(self) -> Array:
        """Current poses (N, 3) of the stored scans."""
        return self._all_poses()[self._kept_numbers()]

    def apply_correction(self, stamps_ns: NDArray[np.int64], poses: Array, since_ns: int) -> None:
        """Correct all poses: the scans of these stamps (M,) were made at poses (M, 3).

        since_ns: stamp of the first scan whose pose is already correct, whether it was added yet or
        not. Unknown stamps are ignored.
        """
        stamps = np.array(self._stamps, dtype=np.int64)
        right_already = np.flatnonzero(stamps == since_ns)
        count = int(right_already[0]) if right_already.size else len(stamps)
        numbers, named = _numbers_of(stamps_ns, stamps[:count])
        if numbers.size == 0:
            return
        before = self._all_poses()[:count]
        if self._before is None:
            self._before = before
        anchors = np.maximum(np.searchsorted(numbers, np.arange(count), side='right') - 1, 0)
        after = _moved_along(before, before[numbers][anchors], poses[named][anchors])
        np.frombuffer(self._poses)[: 3 * count] = after.ravel()
        self._sort_by_place()

    def _sort_by_place(self) -> None:
        """Sort the stored scans by place.

        Places that have too many scans now lose the oldest ones when more arrive.
        """
        kept = self._kept_numbers()
        self._at_place = {}
        places = _places_of(self._all_poses()[kept])
        for number, place in zip(kept.tolist(), places.tolist(), strict=True):
            frame, _ = self._kept[number]
            self._at_place.setdefault((frame, place), deque()).append(number)

    def accept_corrections(self) -> CorrectedPoses:
        """Poses of the stored scans before and after the corrections since the last call.

        For scans added after the first of these corrections, the pose before is the one that they
        would have without it.
        """
        after = self._all_poses()
        before = after
        if self._before is not None and len(self._before):
            corrected = len(self._before)
            last = corrected - 1
            later = _moved_along(after[corrected:], after[last][None], self._before[last][None])
            before = np.vstack([self._before, later])
        self._before = None
        kept = self._kept_numbers()
        return CorrectedPoses(before[kept], after[kept])

    def _kept_numbers(self) -> NDArray[np.int64]:
        return np.array(list(self._kept), dtype=np.int64)

    def _all_poses(self) -> Array:
        return np.array(self._poses).reshape(-1, 3)


def _places_of(poses: Array) -> NDArray[np.int64]:
    """Number (N,) of the place and direction of each pose (N, 3)."""
    turn = np.floor(poses[:, 2] % (2.0 * math.pi) / (2.0 * math.pi) * _DIRECTIONS)
    x, y = np.floor(poses[:, :2] / _PLACE_M).astype(np.int64).T
    return np.asarray((x * _MAX_PLACE + y) * _DIRECTIONS + turn.astype(np.int64))


def _numbers_of(
    wanted: NDArray[np.int64], stamps: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the wanted stamps (M,) among all (N,), ascending, and their positions in wanted.

    Of equal stamps the last is found. Unknown stamps are left out.
    """
    order = np.argsort(stamps, kind='stable')
    at = np.searchsorted(stamps[order], wanted, side='right') - 1
    named = np.flatnonzero(at >= 0)
    numbers = order[at[named]]
    found = stamps[numbers] == wanted[named]
    ascending = np.argsort(numbers[found], kind='stable')
    return numbers[found][ascending], named[found][ascending]


def _moved_along(poses: Array, before: Array, after: Array) -> Array:
    """Poses (N, 3), each moved rigidly with another from `before` to `after`, (N, 3) or (1, 3)."""
    turn = after[:, 2] - before[:, 2]
    c = np.cos(turn)
    s = np.sin(turn)
    dx, dy = (poses - before)[:, :2].T
    x = after[:, 0] + c * dx - s * dy
    y = after[:, 1] + s * dx + c * dy
    return np.column_stack([x, y, se2.wrap(poses[:, 2] + turn)])


def erase(grid: OccupancyGrid, corners: Array) -> None:
    """Set the cells of a grid that a polygon (M, 2), m, touches to unknown."""
    tiles = grid.tiles()
    if not len(tiles):
        return
    low = tiles.min(axis=0) * TILE
    high = (tiles.max(axis=0) + 1) * TILE
    cells = grid.frame.cells_of(corners)
    row, col = np.maximum(cells.min(axis=0), low).tolist()
    end_row, end_col = np.minimum(cells.max(axis=0) + 1, high).tolist()
    if row >= end_row or col >= end_col:
        return
    bounds = (row, col, end_row, end_col)
    odds = grid.odds(bounds)
    odds[_erased(grid.frame, bounds, [corners])] = 0
    grid.set_odds(bounds, odds)


def add_scan_outside(
    grid: OccupancyGrid, scan: Scan, T_map_base: Array, polygons: Sequence[Array]
) -> None:
    """Add a scan made at a pose (3,), but for what it shows of some polygons (M, 2), m.

    Raises InputError as `OccupancyGrid.add_scan`.
    """
    bounds = _reach(grid, scan, T_map_base)
    near = [corners for corners in polygons if _touches(grid.frame.cells_of(corners), bounds)]
    if not near:
        grid.add_scan(scan, T_map_base)
        return
    cells = _erased(grid.frame, bounds, near)
    before = grid.odds(bounds)
    grid.add_scan(scan, T_map_base)
    grid.set_odds(bounds, np.where(cells, before, grid.odds(bounds)))


def _erased(frame: GridFrame, bounds: Bounds, polygons: Sequence[Array]) -> Mask:
    """Cells within bounds that one of some polygons (M, 2), m, touches."""
    row, col, end_row, end_col = bounds
    shape = (end_row - row, end_col - col)
    at = frame.with_origin_at(row, col)
    cells = np.zeros(shape, dtype=np.bool_)
    for corners in polygons:
        cells |= touched_cells(corners, at, shape)
    return cells


def _touches(cells: Cells, bounds: Bounds) -> bool:
    """Whether the rectangle of some cells (M, 2) and another have a cell in common."""
    low = cells.min(axis=0)
    high = cells.max(axis=0)
    return bool(
        low[0] < bounds[2] and bounds[0] <= high[0] and low[1] < bounds[3] and bounds[1] <= high[1]
    )


def _reach(grid: OccupancyGrid, scan: Scan, T_map_base: Array) -> Bounds:
    """Rectangle of all cells of a grid that a scan made at a pose (3,) can change."""
    T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
    row, col = grid.frame.cells_of(T_map_laser[None, :2])[0].tolist()
    reach_m = min(scan.max_range_m, scan.range_max_m + grid.config.surface_thickness_m)
    cells = math.ceil(reach_m / grid.frame.resolution) + _MARGIN_CELLS
    return row - cells, col - cells, row + cells + 1, col + cells + 1


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
        reach = np.where(scan.without_return, config.cleared_range_m(scan), reach)
        bearings = scan.angles_rad + scan.T_base_laser[2]
        x = np.append(reach * np.cos(bearings), 0.0) + scan.T_base_laser[0]
        y = np.append(reach * np.sin(bearings), 0.0) + scan.T_base_laser[1]
        return StoredScan(scan, np.array([x.min(), y.min(), x.max(), y.max()]), erasures)


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
        dropping: frozenset[str] = frozenset(),
        erased: Sequence[Array] = (),
        bodies: Mapping[str, Array | None] | None = None,
        mates: Mapping[str, Array] | None = None,
    ) -> None:
        """Start with the stored scans at their poses (N, 3).

        like: a grid with the same cells and configuration; T_map_base (3,): pose of the robot;
        dropping: frames of the lasers that drop out, as is known now, for all their scans, and for
        those of an unknown laser; those that have it, keep it;
        erased: polygons (M, 2), m, of which only scans since show anything; bodies: what each
        laser, by its frame, is known to see of the robot; mates: places (3,) of the maps of other
        robots, by their names.
        """
        self._bodies = bodies or {}
        self._mates = mates or {}
        self._dropping = dropping
        self._erased = erased
        self.grid = OccupancyGrid(like.config, like.frame)
        self._added = OccupancyGrid(like.config, like.frame)  # scans that arrived meanwhile
        self._robot_tile = like.frame.cells_of(T_map_base[None, :2])[0] // TILE
        self._complete_rings = 0
        boxes = _tile_boxes([each.extent for each in kept], poses, like.frame)
        rings = self._rings(boxes[:, 0], boxes[:, 1])
        order = np.argsort(rings, kind='stable')
        # In lists of their own: thousands of small objects would trigger the garbage collector.
        self._scans = [kept[k] for k in order.tolist()]
        self._poses = list(poses[order])
        self._nearest: list[int] = rings[order].tolist()  # ring that each may touch
        self._tiles: list[int] = _tile_counts(boxes[order]).tolist()  # how many each may touch
        self._next = 0

    @property
    def is_complete(self) -> bool:
        """Whether all scans are rendered."""
        return self._next == len(self._scans)

    def add_scan(self, kept: StoredScan, T_map_base: Array) -> None:
        """Add a scan that arrived meanwhile, made at a pose (3,) that is already correct."""
        with suppress(InputError):  # it is shown when all is complete
            seen = kept.scan.without_robots(T_map_base, self._mates)
            self._added.add_scan(seen, T_map_base)
        boxes = _tile_boxes([kept.extent], T_map_base[None], self.grid.frame)
        self._scans.append(kept)
        self._poses.append(T_map_base)
        self._nearest.append(_LAST_RING)
        self._tiles += _tile_counts(boxes).tolist()

    def render_slice(self, shown: OccupancyGrid) -> list[str]:
        """Render some scans, and update the shown grid, unless `grid` is complete now.

        Returns why scans were left out whose corrected poses would make the map too large.
        """
        first = self._next
        tiles = 0
        refusals: list[str] = []
        while not self.is_complete:
            k = self._next
            tiles += self._tiles[k]
            if k >= first + _SCANS_PER_SLICE and tiles > _TILES_PER_SLICE:
                break
            self._next += 1
            try:
                self._render(self._scans[k], self._poses[k])
            except InputError as error:
                refusals.append(str(error))
        if not self.is_complete:
            self._show_complete_rings(shown)
        return refusals

    def _render(self, stored: StoredScan, T_map_base: Array) -> None:
        """Render a scan, made at a pose (3,), as is known now of its laser and other robots."""
        scan = stored.scan
        scan = scan.without_body(self._bodies.get(scan.frame))
        scan = scan.without_robots(T_map_base, self._mates)
        drops_out = scan.frame in self._dropping or bool(self._dropping and not scan.frame)
        scan = replace(scan, drops_out=drops_out or scan.drops_out)
        add_scan_outside(self.grid, scan, T_map_base, self._erased[stored.erasures :])

    def _show_complete_rings(self, shown: OccupancyGrid) -> None:
        complete = self._nearest[self._next]
        if complete <= self._complete_rings:
            return
        places = np.unique(np.vstack([shown.tiles(), self.grid.tiles()]), axis=0)
        rings = self._rings(places, places)
        completed = places[(rings >= self._complete_rings) & (rings < complete)]
        with suppress(InputError):  # old and new rendering are too far apart for one map
            shown.set_tiles(completed, self.grid, self._added)
        self._complete_rings = complete

    def _rings(self, low: Cells, high: Cells) -> Cells:
        """Nearest ring (N,) of each box of tiles from low (N, 2) to high (N, 2), inclusive."""
        beyond = np.maximum(low - self._robot_tile, self._robot_tile - high)
        return np.asarray(np.maximum(beyond.max(axis=1), 0))


def _tile_counts(boxes: Cells) -> Cells:
    """Number of tiles (N,) from the first to the last of each box (N, 2, 2), inclusive."""
    return np.asarray(np.prod(boxes[:, 1] - boxes[:, 0] + 1, axis=1))


def _tile_boxes(extents: Sequence[Array], poses: Array, frame: GridFrame) -> Cells:
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


class CorrectableGrid:
    """A grid that is re-rendered from stored scans after a loop closure, one slice per scan.

    So it is when the beams without return of a laser turn out to show no free space (`drops_out`),
    or some of its beams to end at the robot (`body_m`), or at another one (`place_mates`).
    `shown` is the published map. It is always complete: each tile shows the old rendering until its
    new one is complete. `corrected_ns` is the stamp of the newest correction that has been
    applied to the whole map.
    Scans whose destination is open wait: they are added once a scan belongs in the map, and dropped
    if the robot was lost. Those of a robot that maps apart are stored and not shown. They join the
    map if a correction comes before the robot is in the map again; otherwise they are dropped.
    `erasures` are the parts of the map of which only later scans show anything, whenever it is
    rendered again; a correction moves them.
    The stored scans of a laser take 10 kB per metre of new ground, at most 30 kB per square metre.
    """

    def __init__(
        self,
        grid: OccupancyGrid,
        keeps_scans: bool = True,
        scans: Sequence[tuple[Scan, Array]] = (),
        erasures: Erasures | None = None,
    ) -> None:
        """Start with a grid. If keeps_scans is False, it is never corrected.

        scans: with poses (3,), from which a grid that is not empty can be rendered. It is shown as
        it is until the first correction. erasures: of the grid, among its scans by their stamps.
        """
        self.shown = grid
        self.corrected_ns = 0
        self.erasures = erasures or Erasures()
        self._dropping: frozenset[str] = frozenset()  # frames of the lasers that drop out
        self._bodies: dict[str, Array | None] = {}  # by the frame of the laser
        self._mates: dict[str, Array] = {}  # place (3,) of the map of each other robot
        # Where each of them was, in its own map: x, y, radius (m), one for each cell of some size.
        self._heard: dict[str, dict[tuple[int, int], Array]] = {}
        self._refusals: list[str] = []
        history: PoseHistory[StoredScan] = PoseHistory()
        for scan, T_scan in scans:
            count = self.erasures.count_before(scan.stamp_ns)
            kept = StoredScan.of(scan, grid.config, count)
            history.add_pose(scan.stamp_ns, T_scan, kept, scan.frame)
        self._history = history if keeps_scans else None
        # With the poses (3,) at which they were made.
        self._open: deque[tuple[Scan, Array]] = deque(maxlen=MAX_OPEN)
        self._apart: PoseHistory[StoredScan] | None = None
        self._is_joined = False  # whether a correction has come since the last scan that is apart
        self._pending_ns: int | None = None
        self._rerendering: Rerendering | None = None
        self._T_map_base = np.zeros(3)  # pose of the robot

    @property
    def is_rerendering(self) -> bool:
        """Whether a correction has not yet been applied to the whole grid."""
        return self._pending_ns is not None

    def apply_correction(self, stamps_ns: NDArray[np.int64], poses: Array, since_ns: int) -> bool:
        """Apply a correction: the scans of these stamps (M,) were made at poses (M, 3).

        since_ns: stamp of the first scan whose pose is already correct. A re-rendering in progress
        starts again with the newer poses. Returns False, and changes nothing, if the scans of the
        grid are not stored.
        """
        if self._history is None:
            self.corrected_ns = since_ns
            return False
        before = self._history.last_pose()
        places = self._history.kept_poses()
        self._history.apply_correction(stamps_ns, poses, since_ns)
        self.erasures.move(places, self._history.kept_poses())
        self._move_open(before, self._history.last_pose())
        if self._apart is not None:
            self._apart.apply_correction(stamps_ns, poses, since_ns)
            self._is_joined = True
        self._pending_ns = since_ns
        self._rerendering = None
        return True

    def update(
        self, scan: Scan | None, T_map_base: Array, destination: Destination = Destination.MAP
    ) -> CorrectedPoses | None:
        """Continue the re-rendering, then add a scan made at a robot pose (3,).

        scan: None where there is none that belongs anywhere. Returns the corrected poses when a
        re-rendering is complete, without that of this scan. Scans that `OccupancyGrid.add_scan`
        refuses are left out: `take_refusals`.
        """
        self._T_map_base = T_map_base
        if scan is None:
            destination = Destination.NOWHERE
        if destination is Destination.MAP:
            self._end_apart()
        moved = self._render_slice()
        if scan is not None:
            self._place(scan, T_map_base, destination)
        return moved

    def _place(self, scan: Scan, T_map_base: Array, destination: Destination) -> None:
        if destination is Destination.MAP:
            self._set_drops_out(scan)
            self._set_body(scan)
            for earlier, T_earlier in self._open:
                self._add_scan(earlier, T_earlier)
            self._open.clear()
            self._add_scan(scan, T_map_base)
        elif destination is Destination.OPEN:
            self._open.append((scan, T_map_base))
        elif destination is Destination.APART:
            self._open.clear()
            self._store_apart(scan, T_map_base)

    def place_mates(self, places: Mapping[str, Array]) -> None:
        """Cut other robots out of the scans: their maps have places (3,) in this one, by name.

        Where one was while its place was unknown, it is a wall: these cells then show what the
        stored scans do without it.
        """
        before = self._mates
        self._mates = {name: _kept_place(before.get(name), T) for name, T in places.items()}
        for name, T in self._mates.items():
            if T is not before.get(name) and name in self._heard:
                heard = np.array(list(self._heard[name].values()))
                self._cut_again(se2.transform_points(T, heard[:, :2]), heard[:, 2])

    def _cut_again(self, places: Array, radii_m: Array) -> None:
        """Render the cells around places (N, 2) again, each within a radius (N,), m."""
        if self._history is None:
            return
        bounds, near = _around(places, radii_m, self.shown.frame)
        kept = self._history.kept()
        poses = self._history.kept_poses()
        boxes = _tile_boxes([each.extent for each in kept], poses, self.shown.frame)
        low = np.array(bounds[:2]) // TILE
        high = np.array(bounds[2:]) // TILE
        some = np.flatnonzero(((boxes[:, 0] <= high) & (boxes[:, 1] >= low)).all(axis=1))
        rendering = self._rendering([kept[k] for k in some.tolist()], poses[some])
        unseen = OccupancyGrid(self.shown.config, self.shown.frame)
        while not rendering.is_complete:
            self._refusals += rendering.render_slice(unseen)
        odds = np.where(near, rendering.grid.odds(bounds), self.shown.odds(bounds))
        self.shown.set_odds(bounds, odds)
        self._rerendering = None  # it has begun without this robot's place

    def erase(self, corners: Array, stamp_ns: int) -> None:
        """Set a polygon (M, 2), m, to unknown until later scans show it.

        Only where no re-rendering is in progress. stamp_ns: of the newest scan. Raises InputError
        where too many parts are erased.
        """
        self.erasures.add(corners, stamp_ns)
        erase(self.shown, corners)

    def take_refusals(self) -> list[str]:
        """Why scans were left out since the last call, a reason for each."""
        refusals = self._refusals
        self._refusals = []
        return refusals

    def finish(self) -> CorrectedPoses | None:
        """Complete a re-rendering in progress, and return the corrected poses."""
        moved = None
        while self.is_rerendering:
            moved = self._render_slice()
        return moved

    def _store_apart(self, scan: Scan, T_map_base: Array) -> None:
        if self._history is None:
            return
        if self._apart is None:
            self._apart = PoseHistory()
        self._is_joined = False
        kept = self._stored(scan)
        self._apart.add_pose(scan.stamp_ns, T_map_base, kept, scan.frame)

    def _end_apart(self) -> None:
        """Add the scans that are apart to the map if they were joined, and drop them otherwise."""
        if self._history is not None and self._apart is not None and self._is_joined:
            self._history.extend(self._apart)
            self._render_again()
        self._apart = None

    def _set_drops_out(self, scan: Scan) -> None:
        """Render the stored scans again if what their beams without return say has changed."""
        if scan.drops_out == (scan.frame in self._dropping):
            return
        self._dropping ^= {scan.frame}
        self._render_again()

    def _set_body(self, scan: Scan) -> None:
        """Render the stored scans again if other beams than before end at the robot."""
        if scan.body_m is self._bodies.get(scan.frame):
            return
        self._bodies[scan.frame] = scan.body_m
        self._render_again()

    def _render_again(self) -> None:
        """Begin to render all stored scans, if there are any."""
        self._rerendering = None
        if self._history is not None and self._pending_ns is None:
            self._pending_ns = self.corrected_ns

    def _move_open(self, before: Array | None, after: Array | None) -> None:
        """Move the waiting scans along with the scan before them, from one pose (3,) to another."""
        if before is not None and after is not None:
            T = se2.compose(after, se2.invert(before))
            moved = [(scan, se2.compose(T, T_scan)) for scan, T_scan in self._open]
            self._open = deque(moved, maxlen=MAX_OPEN)

    def _add_scan(self, scan: Scan, T_map_base: Array) -> None:
        try:
            self._note_robots(scan)
            self.shown.add_scan(scan.without_robots(T_map_base, self._mates), T_map_base)
        except InputError as error:
            self._refusals.append(str(error))
            return
        if self._history is None:
            return
        kept = self._stored(scan)
        self._history.add_pose(scan.stamp_ns, T_map_base, kept, scan.frame)
        if self._rerendering is not None:
            self._rerendering.add_scan(kept, T_map_base)

    def _note_robots(self, scan: Scan) -> None:
        """Remember where other robots were."""
        for robot in scan.robots:
            x, y, _ = robot.T_own_base.tolist()
            place = (math.floor(x / _CORRECTED_M), math.floor(y / _CORRECTED_M))
            reach_m = robot.radius_m + _CORRECTED_M
            self._heard.setdefault(robot.name, {})[place] = np.array([x, y, reach_m])

    def _stored(self, scan: Scan) -> StoredScan:
        """The scan of a laser of which it is found out later whether it drops out."""
        scan = replace(scan, drops_out=False)
        return StoredScan.of(scan, self.shown.config, len(self.erasures))

    def _rendering(self, kept: Sequence[StoredScan], poses: Array) -> Rerendering:
        """Stored scans at poses (N, 3), to be rendered."""
        return Rerendering(
            self.shown,
            kept,
            poses,
            self._T_map_base,
            self._dropping,
            [item.corners for item in self.erasures.items],
            self._bodies,
            self._mates,
        )

    def _render_slice(self) -> CorrectedPoses | None:
        if self._history is None or self._pending_ns is None:
            return None
        if self._rerendering is None:
            kept = self._history.kept()
            poses = self._history.kept_poses()
            self._rerendering = self._rendering(kept, poses)
            # The step that closes a loop is already long: rendering starts with the next one.
            return None
        self._refusals += self._rerendering.render_slice(self.shown)
        if not self._rerendering.is_complete:
            return None
        self.shown = self._rerendering.grid
        self.corrected_ns = self._pending_ns
        self._pending_ns = None
        self._rerendering = None
        return self._history.accept_corrections()


def _kept_place(before: Array | None, T: Array) -> Array:
    """A place (3,) of a map: the former one, where it has only been corrected a little since."""
    is_same = before is not None and not se2.are_apart(before, T, _CORRECTED_M, _CORRECTED_RAD)
    return before if before is not None and is_same else T


def _around(places: Array, radii_m: Array, frame: GridFrame) -> tuple[Bounds, Mask]:
    """Cells (H, W) within a radius (N,), m, of one of some places (N, 2), and their bounds."""
    low = frame.cells_of(places - radii_m[:, None]).min(axis=0)
    high = frame.cells_of(places + radii_m[:, None]).max(axis=0) + 1
    row, col = low.tolist()
    end_row, end_col = high.tolist()
    near = np.zeros((end_row - row, end_col - col), dtype=np.bool_)
    for (at_col, at_row), radius_m in zip(frame.in_cells(places), radii_m, strict=True):
        reach = radius_m / frame.resolution
        first = np.maximum(np.floor([at_row - reach, at_col - reach]).astype(int) - low, 0)
        last = np.ceil([at_row + reach, at_col + reach]).astype(int) - low + 1
        part = near[first[0] : last[0], first[1] : last[1]]
        rows, cols = np.indices(part.shape)
        offs = (rows + first[0] + row + 0.5 - at_row, cols + first[1] + col + 0.5 - at_col)
        part |= np.hypot(*offs) < reach
    return (row, col, end_row, end_col), near
