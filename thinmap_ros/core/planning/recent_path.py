"""Recent path of the robot.

The robot can return along it, even if noise in the map makes a passage appear too narrow.
"""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import kernel


class RecentPath:
    """The last metres of the robot's path; reset when the pose jumps, as after a correction."""

    def __init__(self, step_m: float = 0.03, jump_m: float = 0.5, capacity: int = 1300) -> None:
        """Keep the last points, step_m apart; a longer step than jump_m is a jump."""
        self._step_m = step_m
        self._jump_m = jump_m
        self._capacity = capacity
        # Twice the capacity: points are moved to the front only when the array is full.
        self._points = np.empty((2 * capacity, 2))
        self._begin = self._end = 0

    def add_pose(self, T_map_base: Array) -> None:
        """Add a pose of the robot, (3,); poses that are not finite are ignored."""
        if not se2.is_finite(T_map_base):
            return
        here = float(T_map_base[0]), float(T_map_base[1])
        away = math.dist(here, self._points[self._end - 1]) if self._end > self._begin else math.inf
        if away > self._jump_m:
            self._begin = self._end = 0
        if away >= self._step_m:
            self._append(here)

    def cells(self, frame: GridFrame, shape: tuple[int, ...]) -> NDArray[np.int64]:
        """Cells (N, 2) of a map (H, W) on the path; consecutive cells share an edge."""
        if self._end == self._begin:
            return np.empty((0, 2), dtype=np.int64)
        return np.asarray(
            _connected_cells(
                frame.cells_of(self._points[self._begin : self._end]), shape[0], shape[1]
            )
        )

    def _append(self, here: tuple[float, float]) -> None:
        if self._end == len(self._points):
            kept = self._capacity - 1
            self._points[:kept] = self._points[self._end - kept :]
            self._begin = 0
            self._end = kept
        self._points[self._end] = here
        self._end += 1
        self._begin = max(self._begin, self._end - self._capacity)


@kernel
def _connected_cells(cells: NDArray[np.int64], rows: int, cols: int) -> NDArray[np.int64]:
    """Cells (N, 2) and the cells between them, first along the column, then along the row.

    Cells outside the map are omitted.
    """
    count = cells.shape[0]
    for k in range(1, cells.shape[0]):
        count += abs(cells[k, 0] - cells[k - 1, 0]) + abs(cells[k, 1] - cells[k - 1, 1])
    found = np.empty((count, 2), dtype=np.int64)
    row = cells[0, 0]
    col = cells[0, 1]
    used = 0
    for k in range(cells.shape[0]):
        while True:
            if 0 <= row < rows and 0 <= col < cols:
                found[used, 0] = row
                found[used, 1] = col
                used += 1
            if row != cells[k, 0]:
                row += 1 if cells[k, 0] > row else -1
            elif col != cells[k, 1]:
                col += 1 if cells[k, 1] > col else -1
            else:
                break
    return found[:used].copy()
