"""Where the robot can stand, where it can get from here, and how long the paths are."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.exploration.frontiers import NOTHING, FrontierMap
from thinmap_ros.core.exploration.viewpoints import SQUARE
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.planning.grid_search import (
    distance_field_from,
    downsample_mask,
    upsample_mask,
)
from thinmap_ros.core.planning.recent_path import RecentPath
from thinmap_ros.core.planning.traversability import (
    escape_cells,
    traversable_cells,
    update_traversable_cells,
)
from thinmap_ros.core.se2 import Array

Mask = NDArray[np.bool_]
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


class ReachableSpace:
    """Reachable space of a robot of a radius, updated where the map has changed."""

    def __init__(self, robot_radius_m: float) -> None:
        self._radius_m = robot_radius_m
        self._recent_path = RecentPath()
        self._standing: Mask = np.zeros((0, 0), dtype=np.bool_)
        self._free = self._standing
        nowhere = np.zeros((0, 0))
        self.now = Reachable(self._standing, self._standing, nowhere, GridFrame(0.0, 0.0, 1.0))

    def add_pose(self, T_map_base: Array) -> None:
        """Add a pose (3,): the robot can return over its recent path."""
        self._recent_path.add_pose(T_map_base)

    def update(self, frontiers: FrontierMap, T_map_base: Array) -> None:
        """Find what can be reached from a pose (3,) in the map of the frontiers."""
        self._update_standing(frontiers)
        self._free = frontiers.free
        frame = frontiers.frame
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        recent = self._recent_path.cells(frame, frontiers.free.shape)
        allowed = escape_cells(self._standing, frontiers.free, frame, xy, _ESCAPE_M, recent)
        row, col = (int(v) // SQUARE for v in frame.cells_of(np.array([xy]))[0])
        lengths = distance_field_from(downsample_mask(allowed, SQUARE), (row, col))
        cells = upsample_mask(np.isfinite(lengths), SQUARE, self._standing)
        self.now = Reachable(cells, allowed, lengths, frame)

    def path_lengths(self, T_map_base: Array, goals: Array) -> Array:
        """Path lengths (N,), m, to goals (N, 2); estimated where there is no path."""
        return _lengths_in(self.now.path_lengths, self.now.frame, T_map_base, goals)

    def path_lengths_from(self, T_map_base: Array, goals: Array) -> Array:
        """Path lengths (N,), m, to goals (N, 2) from a pose (3,) of another robot."""
        frame = self.now.frame
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        allowed = escape_cells(self._standing, self._free, frame, xy, _ESCAPE_M)
        row, col = (int(v) // SQUARE for v in frame.cells_of(np.array([xy]))[0])
        lengths = distance_field_from(downsample_mask(allowed, SQUARE), (row, col))
        return _lengths_in(lengths, frame, T_map_base, goals)

    def _update_standing(self, frontiers: FrontierMap) -> None:
        radius_m = self._radius_m
        resolution = frontiers.frame.resolution
        part = frontiers.take_changes()
        if part is None:
            self._standing = traversable_cells(frontiers.free, radius_m, resolution)
        elif part != NOTHING:
            update_traversable_cells(self._standing, frontiers.free, part, radius_m, resolution)


def _lengths_in(squares: Array, frame: GridFrame, T_map_base: Array, goals: Array) -> Array:
    """Path lengths (N,), m, to goals (N, 2) from those to all squares; see `path_lengths`."""
    rows, cols = (frame.cells_of(goals) // SQUARE).T
    height, width = squares.shape
    inside = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
    found = np.full(len(goals), np.inf)
    found[inside] = squares[rows[inside], cols[inside]] * SQUARE * frame.resolution
    return _with_estimates(found, np.hypot(*(goals - T_map_base[:2]).T))


def _with_estimates(lengths_m: Array, straight_m: Array) -> Array:
    """Path lengths, at least the straight line; a detour where there is no path."""
    known = np.where(np.isfinite(lengths_m), lengths_m, _DETOUR * straight_m)
    return np.asarray(np.maximum(known, straight_m))
