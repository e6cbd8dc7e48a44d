"""What a person changes on a map: keep-out areas, virtual walls, and parts that are erased."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import errors, se2, snapshot
from thinmap_ros.core.errors import InputError, counted
from thinmap_ros.core.grid.patch import Bounds, GridFrame, GridPatch
from thinmap_ros.core.se2 import Array, Mask
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_ID, Field, State

_WALL = np.int8(100)

_STEPS_PER_CELL = 8  # along a line

MAX_AREAS = 100
MAX_CORNERS = 200
MAX_OUTLINE_M = 1000.0
MAX_STORED_OUTLINE_M = 2.0 * MAX_OUTLINE_M  # numbers are rounded on the way
MAX_MASK_CELLS = 1 << 24  # 205 x 205 m in cells of 0.05 m
AREA_CORNERS = 3  # at least
WALL_CORNERS = 2
MAX_ERASURES = 200
_STAMP_LIMIT_NS = 2**62

FIELDS = {
    'keep_out': Field(np.int64, ('a', 3), (1, 0, 1), (MAX_ID, 1, MAX_CORNERS)),
    'keep_out_xy': Field(np.float64, ('c', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'keep_out_next_id': Field(np.int64, (), 1, MAX_ID + 1),
    'erased': Field(np.int64, ('e', 2), (0, 1), (_STAMP_LIMIT_NS, MAX_CORNERS)),
    'erased_xy': Field(np.float64, ('d', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
}


def inside(points: Array, polygon: Array) -> Mask:
    """Which points (N, 2) lie in a polygon (M, 2), by the even-odd rule, (N,)."""
    result = np.zeros(len(points), dtype=np.bool_)
    x = points[:, 0]
    y = points[:, 1]
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        crosses = (ay > y) != (by > y)
        if ay != by:
            result ^= crosses & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return result


def masked_outside(patch: GridPatch, polygon: Array) -> GridPatch:
    """Map with all cells outside a polygon (M, 2) as walls; polygon in the map frame, m."""
    centres = patch.frame.centres_of(np.argwhere(np.ones(patch.shape, dtype=np.bool_)))
    within = inside(centres, polygon).reshape(patch.shape)
    return with_walls(patch, ~within)


def with_walls(patch: GridPatch, cells: Mask) -> GridPatch:
    """Map with some cells (H, W) as walls; the map itself where there are none."""
    if not cells.any():
        return patch
    return replace(patch, cells=np.where(cells, _WALL, patch.cells))


def touched_cells(
    corners: Array, frame: GridFrame, shape: tuple[int, int], is_closed: bool = True
) -> Mask:
    """Cells (H, W) of a lattice that a polygon (M, 2), m, touches; those of its line if it is open.

    A polygon that crosses itself is filled by the even-odd rule.
    """
    at = frame.in_cells(corners)
    ends = np.roll(at, -1, axis=0) if is_closed else at[1:]
    begins = at if is_closed else at[:-1]
    cells = _filled(begins, ends, shape) if is_closed else np.zeros(shape, dtype=np.bool_)
    for begin, end in zip(begins, ends, strict=True):
        _draw_line(cells, begin, end)
    return cells


def _filled(begins: Array, ends: Array, shape: tuple[int, int]) -> Mask:
    """Cells (H, W) whose centre is in a polygon with edges from begins (M, 2) to ends (M, 2).

    Each edge toggles the cells to the right of it in the rows that it crosses.
    """
    rows, cols = shape
    toggled = np.zeros((rows, cols + 1), dtype=np.bool_)
    for (ax, ay), (bx, by) in zip(begins, ends, strict=True):
        low, high = sorted((ay, by))
        first = max(math.ceil(low - 0.5), 0)
        crossed = np.arange(first, max(min(math.ceil(high - 0.5), rows), first))
        if crossed.size:
            x = ax + (crossed + 0.5 - ay) * (bx - ax) / (by - ay)
            toggled[crossed, np.clip(np.ceil(x - 0.5), 0, cols).astype(np.int64)] ^= True
    return np.asarray(np.logical_xor.accumulate(toggled, axis=1)[:, :cols])


def _draw_line(cells: Mask, begin: Array, end: Array) -> None:
    """Set the cells (H, W) on the line between two points (2,), x and y in cells.

    They join over their edges: no way leads between two of them.
    """
    count = math.ceil(_STEPS_PER_CELL * float(np.abs(end - begin).max())) + 1
    cols, rows = np.floor(np.linspace(begin, end, count)).astype(np.int64).T
    # Where a step leads over a corner, the cell beside it, too.
    cols = np.append(cols, cols[1:])
    rows = np.append(rows, rows[:-1])
    inside = (rows >= 0) & (rows < cells.shape[0]) & (cols >= 0) & (cols < cells.shape[1])
    cells[rows[inside], cols[inside]] = True


@dataclass(frozen=True, eq=False)
class KeepOutArea:
    """A polygon, or a line that is a wall, with corners (M, 2), m, map frame.

    id: given once, and never again.
    """

    id: int
    corners: Array
    is_wall: bool = False

    def __str__(self) -> str:
        return f'{self._kind} {self.id}'

    @property
    def _kind(self) -> str:
        return 'virtual wall' if self.is_wall else 'keep-out area'

    def checked(self, max_outline_m: float = MAX_STORED_OUTLINE_M) -> 'KeepOutArea':
        """The area itself. Raises InputError as `require_corners`."""
        least = WALL_CORNERS if self.is_wall else AREA_CORNERS
        require_corners(self._kind, self.corners, least, max_outline_m)
        return self

    def contains(self, point: Array) -> bool:
        """Whether a point (2,), m, lies inside; a wall has no inside."""
        return not self.is_wall and bool(inside(point[None], self.corners)[0])


class KeepOut:
    """All areas and walls of a map, in the order in which they were added.

    A robot must not drive there, whatever the map shows. They are no part of the map, which is what
    was observed: planners lay them on it as walls.
    next_id: smallest number that none has had.
    """

    def __init__(self, areas: Sequence[KeepOutArea] = (), next_id: int = 1) -> None:
        """Raises InputError where there are too many, or an id occurs twice."""
        require_count(len(areas))
        errors.require_unique('keep-out areas', [area.id for area in areas])
        self.areas = tuple(areas)
        self.next_id = max([next_id, *(area.id + 1 for area in areas)])
        self._laid = _Laid()

    def with_area(self, corners: Array, is_wall: bool) -> 'KeepOut':
        """These and one more, with corners (M, 2), m. Raises InputError where it is none."""
        area = KeepOutArea(self.next_id, corners, is_wall).checked(MAX_OUTLINE_M)
        return self._with([area])

    def joined(self, other: 'KeepOut') -> 'KeepOut':
        """These and those of another map, which get new ids.

        Raises InputError where there are too many.
        """
        return self._with(other.areas)

    def without(self, number: int) -> 'KeepOut':
        """These but one; 0: none of them. Raises InputError where there is no such id."""
        kept = [area for area in self.areas if number not in (0, area.id)]
        if number and len(kept) == len(self.areas):
            known = ', '.join(str(area.id) for area in self.areas) or 'none'
            raise InputError(f'keep-out area {number}: expected the id of one ({known})')
        return KeepOut(kept, self.next_id)

    def _with(self, areas: Sequence[KeepOutArea]) -> 'KeepOut':
        """These and others, with the next ids."""
        end_id = self.next_id + len(areas)
        if end_id - 1 > MAX_ID:
            raise InputError(f'keep-out area {end_id - 1}: expected ids up to {MAX_ID}')
        added = [replace(area, id=self.next_id + i) for i, area in enumerate(areas)]
        return KeepOut((*self.areas, *added), end_id)

    def moved(self, before: Array, after: Array) -> 'KeepOut':
        """These, each moved along with the pose (3,) of the robot that is nearest to it.

        before, after: poses (N, 3) in a map, before and after it was corrected.
        """
        if not len(before) or not self.areas:
            return self
        areas = [
            replace(area, corners=moved_corners(area.corners, before, after)) for area in self.areas
        ]
        return KeepOut(areas, self.next_id)

    def require_open(self, points: Array) -> None:
        """Raise InputError where one of the points (N, 2), m, lies inside an area."""
        for point in points:
            for area in self.areas:
                if area.contains(point):
                    raise InputError(
                        f'{point[0]:.2f}, {point[1]:.2f} is in {area}: expected a place outside'
                    )

    def cells(self, frame: GridFrame, shape: tuple[int, int]) -> Mask:
        """Cells (H, W) of a lattice that belong to an area or wall."""
        return _cells_of(self.areas, frame, shape)

    def bounds(self, frame: GridFrame) -> Bounds | None:
        """Rectangle of all areas in cells of a lattice; None where there are none.

        Raises InputError where it would be too large for a mask.
        """
        if not self.areas:
            return None
        cells = frame.cells_of(np.vstack([area.corners for area in self.areas]))
        row, col = cells.min(axis=0).tolist()
        end_row, end_col = (cells.max(axis=0) + 1).tolist()
        if (end_row - row) * (end_col - col) > MAX_MASK_CELLS:
            raise InputError(
                f'keep-out areas over {end_row - row} x {end_col - col} cells: expected at most '
                f'{MAX_MASK_CELLS} cells'
            )
        return row, col, end_row, end_col

    def as_walls(self, patch: GridPatch) -> GridPatch:
        """Map with all areas as walls."""
        if not self.areas:
            return patch
        return with_walls(patch, self.cells(patch.frame, patch.shape))

    def laid_on(self, patch: GridPatch, T_map_base: Array) -> GridPatch:
        """Map with all areas as walls, but those in which the robot is, at (3,): it may leave.

        Where other areas count than the last time, all of the map is marked as replaced.
        """
        here = T_map_base[:2]
        areas = tuple(area for area in self.areas if not area.contains(here))
        return self._laid.on(patch, areas)


class _Laid:
    """The map with the areas that were laid on it last."""

    def __init__(self) -> None:
        self._areas: tuple[KeepOutArea, ...] | None = None
        self._patch: GridPatch | None = None
        self._result: GridPatch | None = None
        self._cells: tuple[GridFrame, Mask] | None = None

    def on(self, patch: GridPatch, areas: tuple[KeepOutArea, ...]) -> GridPatch:
        is_other = areas != self._areas
        if self._result is not None and patch is self._patch and not is_other:
            return self._result
        if is_other:
            self._cells = None
        self._areas = areas
        self._patch = patch
        self._result = self._laid(patch, areas)
        return replace(self._result, is_replaced=True) if is_other else self._result

    def _laid(self, patch: GridPatch, areas: tuple[KeepOutArea, ...]) -> GridPatch:
        if not areas:
            return patch
        known = self._cells
        if known is None or known[0] != patch.frame or known[1].shape != patch.shape:
            known = (patch.frame, _cells_of(areas, patch.frame, patch.shape))
            self._cells = known
        return with_walls(patch, known[1])


def _cells_of(areas: Sequence[KeepOutArea], frame: GridFrame, shape: tuple[int, int]) -> Mask:
    cells = np.zeros(shape, dtype=np.bool_)
    for area in areas:
        cells |= touched_cells(area.corners, frame, shape, not area.is_wall)
    return cells


def require_count(count: int) -> None:
    """Raise InputError where there are more areas than a map may have."""
    if count > MAX_AREAS:
        raise InputError(f'{count} keep-out areas: expected at most {MAX_AREAS}')


def require_erasures(count: int) -> None:
    """Raise InputError where there are more erased parts than a map may have."""
    if count > MAX_ERASURES:
        raise InputError(f'{count} erased parts: expected at most {MAX_ERASURES}')


def require_corners(
    what: str,
    corners: Array,
    least: int = AREA_CORNERS,
    max_outline_m: float = MAX_OUTLINE_M,
) -> None:
    """Raise InputError where corners (M, 2), m, are not those of a polygon of a usual size."""
    if not least <= len(corners) <= MAX_CORNERS:
        found = counted(len(corners), 'corner')
        raise InputError(f'{what} of {found}: expected {least} to {MAX_CORNERS}')
    errors.require_bounded(f'corner of a {what}', corners.ravel().tolist())
    outline_m = float(np.hypot(*(corners - np.roll(corners, 1, axis=0)).T).sum())
    if outline_m > max_outline_m:
        expected = f'expected at most {max_outline_m:g} m'
        raise InputError(f'{what} with an outline of {outline_m:.0f} m: {expected}')


def moved_corners(corners: Array, before: Array, after: Array) -> Array:
    """Corners (M, 2), m, moved rigidly as the pose (3,) nearest to their mean; poses (N, 3)."""
    away = np.hypot(*(before[:, :2] - corners.mean(axis=0)).T)
    k = int(away.argmin())
    T = se2.compose(after[k], se2.invert(before[k]))
    return se2.transform_points(T, corners)


class Erasure(NamedTuple):
    """A polygon with corners (M, 2), m, of which no scan up to a stamp shows anything."""

    corners: Array
    stamp_ns: int

    def moved(self, before: Array, after: Array) -> 'Erasure':
        """The same, moved along with the pose (3,) nearest to it; poses (N >= 1, 3)."""
        return Erasure(moved_corners(self.corners, before, after), self.stamp_ns)


@dataclass(eq=False)
class Erasures:
    """Erased parts of a map, in the order in which they were erased."""

    items: list[Erasure] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.items)

    def add(self, corners: Array, stamp_ns: int) -> None:
        """Add a polygon with corners (M, 2), m; stamp_ns: of the newest scan that is erased.

        Raises InputError where there are too many.
        """
        if len(self.items) >= MAX_ERASURES:
            raise InputError(f'map with {MAX_ERASURES} erased parts: expected no more')
        self.items.append(Erasure(corners, stamp_ns))

    def count_before(self, stamp_ns: int) -> int:
        """How many were erased before a scan of an earlier session was made."""
        return sum(item.stamp_ns < stamp_ns for item in self.items)

    def move(self, before: Array, after: Array) -> None:
        """Move each along with the pose (3,) nearest to it; poses (N, 3) around a correction."""
        if len(before):
            self.items = [item.moved(before, after) for item in self.items]


@dataclass(frozen=True, eq=False)
class MapEdits:
    """The edits of a map, as they are saved."""

    keep_out: KeepOut = field(default_factory=KeepOut)
    erasures: Erasures = field(default_factory=Erasures)

    def __bool__(self) -> bool:
        return bool(self.keep_out.areas or self.erasures.items)

    def state(self) -> State:
        """The edits as arrays by name; see `from_state`."""
        areas = self.keep_out.areas
        rows = [(area.id, int(area.is_wall), len(area.corners)) for area in areas]
        erased = [(item.stamp_ns, len(item.corners)) for item in self.erasures.items]
        return {
            'keep_out': np.array(rows, dtype=np.int64).reshape(-1, 3),
            'keep_out_xy': _stacked([area.corners for area in areas]),
            'keep_out_next_id': np.array(self.keep_out.next_id),
            'erased': np.array(erased, dtype=np.int64).reshape(-1, 2),
            'erased_xy': _stacked([item.corners for item in self.erasures.items]),
        }

    @staticmethod
    def from_state(state: State, config: object = None) -> 'MapEdits':
        """Restore edits from their `state`. Raises InputError if the state is invalid."""
        checked = snapshot.validate(state, FIELDS, 'edits')
        rows = checked['keep_out'].tolist()
        snapshot.require(len(rows) <= MAX_AREAS, 'edits: keep_out', f'at most {MAX_AREAS}')
        snapshot.require_unique(checked['keep_out'][:, 0], 'edits: keep_out')
        next_id = int(checked['keep_out_next_id'])
        snapshot.require(
            all(number < next_id for number, _, _ in rows), 'edits: keep_out', 'ids below next_id'
        )
        polygons = _split(checked['keep_out_xy'], [size for _, _, size in rows], 'keep_out')
        areas = [
            KeepOutArea(number, corners, bool(is_wall))
            for (number, is_wall, _), corners in zip(rows, polygons, strict=True)
        ]
        erased = checked['erased'].tolist()
        snapshot.require(len(erased) <= MAX_ERASURES, 'edits: erased', f'at most {MAX_ERASURES}')
        corners_of = _split(checked['erased_xy'], [size for _, size in erased], 'erased')
        items = [
            Erasure(corners, stamp) for (stamp, _), corners in zip(erased, corners_of, strict=True)
        ]
        try:
            for item in items:
                require_corners('erased part', item.corners, max_outline_m=MAX_STORED_OUTLINE_M)
            return MapEdits(KeepOut([area.checked() for area in areas], next_id), Erasures(items))
        except InputError as error:
            raise InputError(f'saved edits: {error}') from error


def split_edits(state: State) -> tuple[MapEdits, dict[str, NDArray[Any]]]:
    """Split a state into its edits, none where it has no array of them, and the other arrays.

    Raises InputError if the edits are invalid.
    """
    own = {name: array for name, array in state.items() if name in FIELDS}
    rest = {name: array for name, array in state.items() if name not in FIELDS}
    return MapEdits.from_state(own) if own else MapEdits(), rest


def _stacked(polygons: Sequence[Array]) -> Array:
    return np.vstack([np.empty((0, 2)), *polygons])


def _split(corners: Array, sizes: Sequence[int], what: str) -> list[Array]:
    """Corners (M, 2) of each polygon. Raises InputError where there are more or less."""
    snapshot.require(sum(sizes) == len(corners), f'edits: {what}_xy', f'{sum(sizes)} corners')
    return np.split(corners, np.cumsum(sizes)[:-1]) if sizes else []
