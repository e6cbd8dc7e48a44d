"""Keep-out areas and virtual walls: where a robot must not drive, whatever the map shows.

They are no part of the map, which is what was observed. Planners lay them on it as walls.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from thinmap_ros.core import errors, se2
from thinmap_ros.core.errors import InputError, counted
from thinmap_ros.core.grid.patch import Bounds, GridFrame, GridPatch
from thinmap_ros.core.grid.polygon import Mask, inside, touched_cells, with_walls
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import MAX_ID

MAX_AREAS = 100
MAX_CORNERS = 200
MAX_OUTLINE_M = 1000.0
MAX_STORED_OUTLINE_M = 2.0 * MAX_OUTLINE_M  # numbers are rounded on the way
MAX_MASK_CELLS = 1 << 24  # 205 x 205 m in cells of 0.05 m
AREA_CORNERS = 3  # at least
WALL_CORNERS = 2


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
