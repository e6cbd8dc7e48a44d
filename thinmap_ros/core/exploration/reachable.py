"""Where the robot can stand, where it can get from here, and how long the paths are."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.exploration.frontiers import NOTHING, FrontierMap
from thinmap_ros.core.exploration.viewpoints import SQUARE
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.planning.grid_search import (
    distance_field_from,
    downsample_mask,
    escape_cells,
    reachable_cells,
    traversable_cells,
    update_traversable_cells,
)
from thinmap_ros.core.planning.obstacles import RecentPath
from thinmap_ros.core.se2 import Array

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
_ESCAPE_M = 0.6
_DETOUR = 3.0  # of the straight line, where no path is known


class Reachable(NamedTuple):
    """Reachable cells (H, W), and the path length, in squares, to each of their squares.

    standing (H, W): cells where the robot fits, reachable or not.
    """

    cells: Mask
    standing: Mask
    path_lengths: Array
    frame: GridFrame

    def lengths_to(self, T_map_base: Array, goals: Array) -> Array:
        """Path lengths (N,), m, to goals (N, 2) from where the robot is, at (3,).

        At least the straight line; a detour where there is no path.
        """
        rows, cols = (self.frame.cells_of(goals) // SQUARE).T
        height, width = self.path_lengths.shape
        inside = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
        squares = np.full(len(goals), np.inf)
        squares[inside] = self.path_lengths[rows[inside], cols[inside]]
        straight_m = np.hypot(*(goals - T_map_base[:2]).T)
        known = np.isfinite(squares)
        lengths_m = np.where(known, squares * SQUARE * self.frame.resolution, _DETOUR * straight_m)
        return np.asarray(np.maximum(lengths_m, straight_m))


class ReachableSpace:
    """Reachable space of a robot of a radius, updated where the map has changed."""

    def __init__(self, robot_radius_m: float) -> None:
        self._radius_m = robot_radius_m
        self._recent_path = RecentPath()
        self._standing: Mask = np.zeros((0, 0), dtype=np.bool_)
        self._passable = self._standing
        nowhere = np.zeros((0, 0))
        self.now = Reachable(self._standing, self._standing, nowhere, GridFrame(0.0, 0.0, 1.0))

    def add_pose(self, T_map_base: Array) -> None:
        """Add a pose (3,): the robot can return over its recent path."""
        self._recent_path.add_pose(T_map_base)

    def update(self, frontiers: FrontierMap, T_map_base: Array) -> None:
        """Find what can be reached from a pose (3,) in the map of the frontiers."""
        self._update_standing(frontiers)
        self._passable = frontiers.passable
        recent = self._recent_path.cells(frontiers.frame, frontiers.free.shape)
        self.now = self._reach(T_map_base, frontiers.frame, recent)

    def path_lengths(self, T_map_base: Array, goals: Array) -> Array:
        """Path lengths (N,), m, to goals (N, 2); estimated where there is no path."""
        return self.now.lengths_to(T_map_base, goals)

    def path_lengths_from(self, T_map_base: Array, goals: Array) -> Array:
        """Path lengths (N,), m, to goals (N, 2) from a pose (3,) of another robot."""
        return self._reach(T_map_base, self.now.frame).lengths_to(T_map_base, goals)

    def _reach(self, T_map_base: Array, frame: GridFrame, recent: Cells | None = None) -> Reachable:
        """What can be reached from a pose (3,); recent (N, 2): cells where the robot was."""
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        allowed = escape_cells(self._standing, self._passable, frame, xy, _ESCAPE_M, recent)
        row, col = (int(v) for v in frame.cells_of(np.array([xy]))[0])
        # Cells say whether there is a way, as the navigator does; squares, which join what a narrow
        # gap separates, say how long it is.
        reached = reachable_cells(allowed, (row, col))
        lengths = distance_field_from(
            downsample_mask(reached, SQUARE), (row // SQUARE, col // SQUARE)
        )
        return Reachable(reached & self._standing, allowed, lengths, frame)

    def _update_standing(self, frontiers: FrontierMap) -> None:
        radius_m = self._radius_m
        resolution = frontiers.frame.resolution
        part = frontiers.take_changes()
        if part is None:
            self._standing = traversable_cells(frontiers.free, radius_m, resolution)
        elif part != NOTHING:
            update_traversable_cells(self._standing, frontiers.free, part, radius_m, resolution)
