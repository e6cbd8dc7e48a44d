"""A rectangle of map cells with its place in the world."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError, quoted, require_type
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import MAX_COORDINATE_M, Array, Cells, Mask
from thinmap_ros.core.snapshot import Field

MIN_RESOLUTION_M = 0.001
MAX_RESOLUTION_M = 10.0
FRAME_FIELD = Field(
    np.float64,
    (3,),
    (-MAX_COORDINATE_M, -MAX_COORDINATE_M, MIN_RESOLUTION_M),
    (MAX_COORDINATE_M, MAX_COORDINATE_M, MAX_RESOLUTION_M),
)  # a saved frame, see `GridFrame.as_array`

UNKNOWN = -1
# map_server's thresholds, in percent.
FREE_AT_MOST = 25
OCCUPIED_AT_LEAST = 65
_LETHAL = 100  # cost of a cell in which a robot would collide

# Of a robot that publishes no scans.
_BEAMS = 360
_RANGE_MIN_M = 0.01

Bounds = tuple[int, int, int, int]  # first row, first column, end row, end column
Margins = tuple[int, int, int, int]  # rows and columns before, rows and columns after


@dataclass(frozen=True)
class GridFrame:
    """A lattice of square cells: world point <-> cell (row, col).

    origin_x, origin_y: lower left corner of cell (0, 0), m; resolution: edge of a cell, m. Row 0
    has the lowest y, as in nav_msgs/OccupancyGrid. Raises InputError if the origin is beyond
    MAX_COORDINATE_M, or the resolution is not between MIN_RESOLUTION_M and MAX_RESOLUTION_M.
    """

    origin_x: float
    origin_y: float
    resolution: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not isinstance(value, float | int | np.number):
                raise InputError(f'{name} = {quoted(value)}: expected a number')
        if not (abs(self.origin_x) <= MAX_COORDINATE_M and abs(self.origin_y) <= MAX_COORDINATE_M):
            raise InputError(
                f'map with its origin at {self.origin_x:g}, {self.origin_y:g} m: expected numbers '
                f'from {-MAX_COORDINATE_M:g} to {MAX_COORDINATE_M:g}'
            )
        if not MIN_RESOLUTION_M <= self.resolution <= MAX_RESOLUTION_M:
            raise InputError(
                f'map of cells of {self.resolution:g} m: expected {MIN_RESOLUTION_M:g} to '
                f'{MAX_RESOLUTION_M:g} m'
            )

    def in_cells(self, points: Array) -> Array:
        """Points (N, 2), as x and y in cells from the corner of cell (0, 0)."""
        return np.asarray((points - (self.origin_x, self.origin_y)) / self.resolution)

    def cells_of(self, points: Array) -> Cells:
        """Cells (N, 2) as (row, col) that hold the points (N, 2)."""
        return np.floor(self.in_cells(np.atleast_2d(points))[:, ::-1]).astype(np.int64)

    def cell_at(self, x: float, y: float) -> tuple[int, int]:
        """The cell (row, col) that holds a point, m: as `cells_of`, in a tenth of its time."""
        row = math.floor((y - self.origin_y) / self.resolution)
        return row, math.floor((x - self.origin_x) / self.resolution)

    def centres_of(self, cells: Cells) -> Array:
        """World points (N, 2) at the centres of the cells (N, 2) given as (row, col)."""
        centres = np.empty(cells.shape)
        centres[:, 0] = (cells[:, 1] + 0.5) * self.resolution + self.origin_x
        centres[:, 1] = (cells[:, 0] + 0.5) * self.resolution + self.origin_y
        return centres

    def with_origin_at(self, rows: int, cols: int) -> 'GridFrame':
        """The same lattice with cell (rows, cols) as its new cell (0, 0)."""
        x = self.origin_x + cols * self.resolution
        y = self.origin_y + rows * self.resolution
        return GridFrame(x, y, self.resolution)

    def as_array(self) -> Array:
        """Origin x, origin y and resolution, (3,), m."""
        return np.array([self.origin_x, self.origin_y, self.resolution])


@dataclass(frozen=True, eq=False)
class GridPatch:
    """Cells (H, W) int8 as in nav_msgs/OccupancyGrid: -1 unknown, else 0..100 % occupied.

    Row 0 has the lowest y.

    A cell up to 25 % is free, from 65 % occupied; values in between count as unknown.
    is_replaced: of a map that is received again and again, whether any cell may differ from the
    last one, and not only those that the last scan can have changed.
    """

    frame: GridFrame
    cells: NDArray[np.int8]
    is_replaced: bool = False

    def __post_init__(self) -> None:
        require_type('frame', self.frame, GridFrame)
        cells = self.cells
        if not (isinstance(cells, np.ndarray) and cells.ndim == 2 and cells.dtype == np.int8):
            raise InputError(f'cells = {quoted(cells)}: expected an array (H, W) of int8')

    def __repr__(self) -> str:
        rows, cols = self.shape
        free_m2 = np.count_nonzero(self.free) * self.frame.resolution**2
        size = f'{rows} x {cols} cells of {self.frame.resolution:g} m'
        return f'GridPatch({size}, {free_m2:.1f} m2 free)'

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return (self.cells.shape[0], self.cells.shape[1])

    @cached_property
    def free(self) -> Mask:
        """Cells known to be free, (H, W)."""
        return (self.cells >= 0) & (self.cells <= FREE_AT_MOST)

    @cached_property
    def occupied(self) -> Mask:
        """Cells known to be occupied, (H, W)."""
        return self.cells >= OCCUPIED_AT_LEAST

    @cached_property
    def unknown(self) -> Mask:
        """Cells that are neither free nor occupied, (H, W)."""
        return ~(self.free | self.occupied)

    def trinary(
        self, free_at_most: float = FREE_AT_MOST, occupied_at_least: float = OCCUPIED_AT_LEAST
    ) -> NDArray[np.int8]:
        """Cells (H, W) as map_server publishes them: -1 unknown, 0 free, 100 occupied.

        Thresholds in %.
        """
        # A table is six times as fast as comparing the cells of a large map.
        values = np.arange(256, dtype=np.uint8).view(np.int8)
        table = np.full(256, UNKNOWN, dtype=np.int8)
        table[(values >= 0) & (values <= free_at_most)] = 0
        table[values >= occupied_at_least] = 100
        return np.asarray(table[self.cells.view(np.uint8)])

    def offset_of(self, other: 'GridPatch') -> tuple[int, int]:
        """Row and column of the first cell of another patch. Raises InputError off the lattice."""
        if not self.is_aligned_with(other):
            raise InputError(
                f'map window at {other.frame}: expected cells on the lattice of {self.frame}'
            )
        row, col = self._in_cells(other)
        return round(row), round(col)

    def is_aligned_with(self, other: 'GridPatch') -> bool:
        """Whether the cells of another patch are on the lattice of this one."""
        row, col = self._in_cells(other)
        is_even = abs(col - round(col)) < 0.01 and abs(row - round(row)) < 0.01
        return is_even and abs(other.frame.resolution - self.frame.resolution) <= 1e-6

    def _in_cells(self, other: 'GridPatch') -> tuple[float, float]:
        col = (other.frame.origin_x - self.frame.origin_x) / self.frame.resolution
        row = (other.frame.origin_y - self.frame.origin_y) / self.frame.resolution
        return row, col

    def overhang_of(self, other: 'GridPatch') -> Margins:
        """Rows and columns of another patch beyond this one. Raises InputError off the lattice."""
        row, col = self.offset_of(other)
        beyond_row = row + other.shape[0] - self.shape[0]
        beyond_col = col + other.shape[1] - self.shape[1]
        return max(-row, 0), max(-col, 0), max(beyond_row, 0), max(beyond_col, 0)

    def padded(self, margins: Margins) -> 'GridPatch':
        """The patch with unknown cells around it."""
        rows, cols, end_rows, end_cols = margins
        width = ((rows, end_rows), (cols, end_cols))
        cells = np.pad(self.cells, width, constant_values=UNKNOWN)
        return GridPatch(self.frame.with_origin_at(-rows, -cols), cells)

    def with_part(self, row: int, col: int, cells: NDArray[np.int8]) -> 'GridPatch':
        """The patch with cells (H, W) replaced from a row and a column on.

        Raises InputError where they do not lie inside.
        """
        rows, cols = cells.shape
        fits = row >= 0 and col >= 0
        if not fits or row + rows > self.shape[0] or col + cols > self.shape[1]:
            raise InputError(
                f'update of {rows} x {cols} cells at row {row}, column {col}: '
                f'expected it inside the map of {self.shape[0]} x {self.shape[1]} cells'
            )
        replaced = self.cells.copy()
        replaced[row : row + rows, col : col + cols] = cells
        return GridPatch(self.frame, replaced)

    def part(self, bounds: Bounds) -> 'GridPatch':
        """Part of the patch, a view of its cells."""
        row, col, end_row, end_col = bounds
        cells = self.cells[row:end_row, col:end_col]
        return GridPatch(self.frame.with_origin_at(row, col), cells)

    def changes_since(self, before: 'GridPatch') -> Bounds | None:
        """Bounds of the cells that differ from those of a patch of the same shape; None: none."""
        return bounds_of(self.cells != before.cells)

    def contains(self, points: Array) -> Mask:
        """Which of the points (N, 2) lie inside, (N,)."""
        cells = self.frame.cells_of(points)
        return np.asarray(np.all((cells >= 0) & (cells < self.shape), axis=1))


def bounds_of(chosen: Mask) -> Bounds | None:
    """Bounds of the chosen cells of an array (H, W); None where none is."""
    rows = np.flatnonzero(chosen.any(axis=1))
    if not rows.size:
        return None
    first = int(rows[0])
    end = int(rows[-1]) + 1
    cols = np.flatnonzero(chosen[first:end].any(axis=0))
    return first, int(cols[0]), end, int(cols[-1]) + 1


def union(a: Bounds | None, b: Bounds) -> Bounds:
    """Bounds of all cells in one of two rectangles, of which the first may be none."""
    if a is None:
        return b
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def occupancy_from_costs(patch: GridPatch) -> GridPatch:
    """Occupancy of a costmap, in which costs below lethal only keep the robot at a distance.

    The radius of the robot is a parameter of the exploration: inflated cells are free space.
    """
    cells = np.where(patch.cells < 0, UNKNOWN, np.where(patch.cells >= _LETHAL, _LETHAL, 0))
    return GridPatch(patch.frame, cells.astype(np.int8))


def scan_in_map(patch: GridPatch, T_map_base: Array, range_m: float, stamp_ns: int) -> Scan:
    """Scan all round that the known free space of a map shows from a pose (3,).

    Stands for the scans of a robot that publishes none. range_m: the farthest that is seen.
    """
    resolution = patch.frame.resolution
    x = (float(T_map_base[0]) - patch.frame.origin_x) / resolution
    y = (float(T_map_base[1]) - patch.frame.origin_y) / resolution
    step = 2.0 * math.pi / _BEAMS
    angles = float(T_map_base[2]) - math.pi + step * np.arange(_BEAMS, dtype=np.float64)
    opaque = (~patch.free).astype(np.uint8)
    ranges = resolution * cast_rays(opaque, x, y, angles, range_m / resolution)
    return Scan.create(stamp_ns, ranges, -math.pi, step, _RANGE_MIN_M, range_m)
