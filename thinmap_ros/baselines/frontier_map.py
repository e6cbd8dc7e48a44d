"""Frontiers for the baseline strategies: clusters, viewpoints and path lengths."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.explorer import ExplorerConfig
from thinmap_ros.core.exploration.field_of_view import box_of_scan, directions_of_view
from thinmap_ros.core.exploration.frontiers import OpenBorders
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.grid_search import downsample_mask, path_lengths_from
from thinmap_ros.core.planning.recent_path import RecentPath
from thinmap_ros.core.planning.traversability import (
    escape_cells,
    reachable_cells,
    traversable_cells,
)
from thinmap_ros.core.planning.wavefront import WavefrontConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]
_COARSE = 2
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


class FrontierMap:
    """The frontiers of a growing map, without those that persist after close observation."""

    def __init__(self, allow_backtracking: bool = False) -> None:
        """allow_backtracking: the recent path counts as traversable, however narrow it appears."""
        self.borders = OpenBorders(_EXPLORER.min_frontier_size)
        self._recent_path = RecentPath() if allow_backtracking else None
        self.patch: GridPatch | None = None
        self._reachable: Mask = np.zeros((0, 0), dtype=np.bool_)

    def update(self, patch: GridPatch, scan: Scan, T_map_base: Array) -> None:
        """Update the frontiers after a scan made at a pose (3,)."""
        self.patch = patch
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        if self._recent_path is not None:
            self._recent_path.add_pose(T_map_base)
        self.borders.update(patch, box_of_scan(scan, T_map_base))
        self.borders.examine(xy, _EXPLORER.exhaustion_range_m, directions_of_view(scan, T_map_base))

    def is_open(self, frontier: Frontier) -> bool:
        """Whether enough of a frontier remains; its cells must be of the present frame."""
        left = np.count_nonzero(self.borders.mask[frontier.cells[:, 0], frontier.cells[:, 1]])
        return bool(left * self.borders.frame.resolution >= _EXPLORER.min_frontier_size - 1e-6)

    def find(self, T_map_base: Array) -> list[Frontier]:
        """All frontiers with a viewpoint that is reachable from a pose (3,)."""
        frame = self.borders.frame
        cells, numbers, _ = self.borders.stretches()
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        standing = traversable_cells(self.borders.free, _EXPLORER.robot_radius_m, frame.resolution)
        reach = self._reach_from(standing, xy)
        if len(cells) == 0:
            return []
        reached = reach & standing
        self._reachable = downsample_mask(reach, _COARSE)
        stretches = [cells[numbers == number] for number in np.unique(numbers)]
        places = [
            self.borders.place_to_look(stretch, reached, _EXPLORER.frontier_assignment_radius_m, xy)
            for stretch in stretches
        ]
        found = [(s, p) for s, p in zip(stretches, places, strict=True) if p is not None]
        ways = self.path_lengths_from(
            np.array(T_map_base[:2]), np.array([p for _, p in found]).reshape(-1, 2)
        )
        return [
            Frontier(s, self._centroid(s), p, float(way))
            for (s, p), way in zip(found, ways, strict=True)
            if math.isfinite(way)
        ]

    def _reach_from(self, standing: Mask, xy: tuple[float, float]) -> Mask:
        """Cells (H, W) that are reachable from a point (m)."""
        free = self.borders.free
        frame = self.borders.frame
        row, col = (int(v) for v in frame.cells_of(np.array([xy]))[0])
        if not (0 <= row < free.shape[0] and 0 <= col < free.shape[1]):
            return np.zeros_like(standing)
        if self._recent_path is None:
            ways = escape_cells(standing, free, frame, xy, _PLANNER.start_escape_distance_m)
            return reachable_cells(ways, (row, col)) & standing
        trail = self._recent_path.cells(frame, free.shape)
        return reachable_cells(
            escape_cells(standing, free, frame, xy, _PLANNER.start_escape_distance_m, trail),
            (row, col),
        )

    def path_lengths_from(self, xy: Array, places: Array) -> Array:
        """Path lengths, m, from a point (2,) to viewpoints (N, 2) of `find`, (N,)."""
        frame = self.borders.frame
        cells = frame.cells_of(np.vstack([xy[None], places])) // _COARSE
        start = (int(cells[0, 0]), int(cells[0, 1]))
        return path_lengths_from(self._reachable, start, cells[1:]) * frame.resolution * _COARSE

    def _centroid(self, cells: Cells) -> Array:
        cell = cells[np.square(cells - cells.mean(axis=0)).sum(axis=1).argmin()]
        return np.asarray(self.borders.frame.centres_of(cell[None])[0])
