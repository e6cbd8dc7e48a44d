"""Frontiers for the baseline strategies: clusters, viewpoints and path lengths."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.candidates import ASSIGNMENT_RADIUS_M
from thinmap_ros.core.exploration.explorer import ExplorerConfig
from thinmap_ros.core.exploration.space import FrontierMap, box_of_scan, search_beside
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.grid_search import (
    downsample_mask,
    escape_cells,
    path_lengths_from,
    reachable_cells,
    traversable_cells,
)
from thinmap_ros.core.planning.obstacles import RecentPath
from thinmap_ros.core.planning.wavefront import START_ESCAPE_M, WavefrontConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]
_COARSE = 2
_PART_M = 1.0
# The same robot and the same frontiers as for the exploration of the paper.
_EXPLORER = ExplorerConfig()
_PLANNER = WavefrontConfig()


@dataclass(frozen=True, eq=False)
class Frontier:
    """A frontier cluster: its cells (N, 2), centroid (2,) and viewpoint (2,), m.

    path_length_m: length of the path from the robot to the viewpoint.
    """

    cells: Cells
    centroid: Array
    viewpoint: Array
    path_length_m: float

    @property
    def goal(self) -> Array:
        """The viewpoint, facing the centroid, (3,)."""
        dx, dy = self.centroid - self.viewpoint
        return se2.pose(self.viewpoint[0], self.viewpoint[1], math.atan2(dy, dx))


class FrontierFinder:
    """The frontiers of a growing map, without those that persist after close observation."""

    def __init__(self, allow_backtracking: bool = False) -> None:
        """allow_backtracking: the recent path counts as traversable, however narrow it appears."""
        self.map = FrontierMap()
        self._recent_path = RecentPath() if allow_backtracking else None
        self.patch: GridPatch | None = None
        self._given_up: set[tuple[int, int]] = set()
        self._reachable: Mask = np.zeros((0, 0), dtype=np.bool_)

    def update(self, patch: GridPatch, scan: Scan, T_map_base: Array) -> None:
        """Update the frontiers after a scan made at a pose (3,)."""
        self.patch = patch
        if self._recent_path is not None:
            self._recent_path.add_pose(T_map_base)
        self.map.update(patch, box_of_scan(scan, T_map_base))

    def is_open(self, frontier: Frontier) -> bool:
        """Whether enough of a frontier remains; its cells must be of the present frame."""
        return self.map.is_long(self.map.remaining(frontier.cells), _EXPLORER.min_frontier_size)

    def find(self, T_map_base: Array) -> list[Frontier]:
        """All frontiers with a viewpoint that is reachable from a pose (3,)."""
        frame = self.map.frame
        clusters = self._clusters()
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        standing = traversable_cells(self.map.free, _EXPLORER.robot_radius_m, frame.resolution)
        reach = self._reach_from(standing, xy)
        if not clusters:
            return []
        self._reachable = downsample_mask(reach, _COARSE)
        places = [self._place_at(cells, reach & standing, xy) for cells in clusters]
        found = [(c, p) for c, p in zip(clusters, places, strict=True) if p is not None]
        ways = self.path_lengths_from(
            np.array(T_map_base[:2]), np.array([p for _, p in found]).reshape(-1, 2)
        )
        return [
            Frontier(c, np.array(self.map.middle_of(c)), p, float(way))
            for (c, p), way in zip(found, ways, strict=True)
            if math.isfinite(way)
        ]

    def give_up(self, frontier: Frontier, xy: Array) -> None:
        """Ignore the part of a frontier nearest to a point (2,), from which it was observed."""
        away_m = np.hypot(*(self.map.frame.centres_of(frontier.cells) - xy).T)
        near = away_m <= away_m.min() + _PART_M
        self._given_up.update(self._lattice_cells(frontier.cells[near]))

    def _clusters(self) -> list[Cells]:
        """Frontier cells of each cluster, without those that were given up."""
        min_length_m = _EXPLORER.min_frontier_size
        clusters = []
        for cells in self.map.clusters(min_length_m):
            keys = self._lattice_cells(cells)
            left = cells[[key not in self._given_up for key in keys]]
            if self.map.is_long(len(left), min_length_m):
                clusters.append(left)
        return clusters

    def _lattice_cells(self, cells: Cells) -> list[tuple[int, int]]:
        """Indices of cells (N, 2) that stay when the map grows."""
        frame = self.map.frame
        first = np.round(np.array([frame.origin_y, frame.origin_x]) / frame.resolution)
        return [(int(row), int(col)) for row, col in cells + first]

    def _reach_from(self, standing: Mask, xy: tuple[float, float]) -> Mask:
        """Cells (H, W) that are reachable from a point (m)."""
        free = self.map.free
        frame = self.map.frame
        row, col = (int(v) for v in frame.cells_of(np.array([xy]))[0])
        if not (0 <= row < free.shape[0] and 0 <= col < free.shape[1]):
            return np.zeros_like(standing)
        if self._recent_path is None:
            ways = escape_cells(standing, free, frame, xy, START_ESCAPE_M)
            return reachable_cells(ways, (row, col)) & standing
        trail = self._recent_path.cells(frame, free.shape)
        return reachable_cells(
            escape_cells(standing, free, frame, xy, START_ESCAPE_M, trail),
            (row, col),
        )

    def path_lengths_from(self, xy: Array, places: Array) -> Array:
        """Path lengths, m, from a point (2,) to viewpoints (N, 2) of `find`, (N,)."""
        frame = self.map.frame
        cells = frame.cells_of(np.vstack([xy[None], places])) // _COARSE
        start = (int(cells[0, 0]), int(cells[0, 1]))
        return path_lengths_from(self._reachable, start, cells[1:]) * frame.resolution * _COARSE

    def _place_at(self, cells: Cells, allowed: Mask, xy: tuple[float, float]) -> Array | None:
        """Centre (2,), m, of the allowed cell at a frontier (N, 2) nearest to a point, m."""
        frame = self.map.frame
        row, col = (int(v) for v in frame.cells_of(np.array([xy]))[0])
        max_steps = int(ASSIGNMENT_RADIUS_M / frame.resolution)
        cell, _ = search_beside(self.map.free, cells, allowed, allowed, max_steps, (row, col))
        return None if cell is None else np.asarray(frame.centres_of(np.array([cell]))[0])
