"""Transform between world points and the cells of a grid."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.se2 import MAX_COORDINATE_M, Array

MIN_RESOLUTION_M = 0.001
MAX_RESOLUTION_M = 10.0


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

    def cells_of(self, points: Array) -> NDArray[np.int64]:
        """Cells (N, 2) as (row, col) that hold the points (N, 2)."""
        return np.floor(self.in_cells(np.atleast_2d(points))[:, ::-1]).astype(np.int64)

    def centres_of(self, cells: NDArray[np.int64]) -> Array:
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
