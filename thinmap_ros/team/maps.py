"""Maps of a team: one that all robots share at once."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from thinmap_ros.closed_loop import SCANS_PER_GRAPH, ClosedLoop, ground_truth_poses
from thinmap_ros.core.exploration.space import box_of_scan
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stage import Estimate
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.core.topology.topology import TopologyBuilder


class TeamMaps(Protocol):
    """The maps and graphs in which the robots of a team, numbered from 0, explore."""

    def add_scan(self, robot: int, scan: Scan, T_odom_base: Array) -> Estimate:
        """Localize and map a scan of a robot, without the others in it."""

    def update(self, poses: dict[int, Array], now_s: float) -> None:
        """Update the graphs after the scans of all robots, and exchange what has changed.

        poses: by robot, those that work.
        """

    def view(self, robot: int) -> tuple[TopologicalMap, GridPatch]:
        """The graph and the map of a robot."""

    def take_changes(self, robot: int) -> list[Array]:
        """Parts (2, 2), m, of its map that other robots have changed since the last call."""

    def known_area(self) -> GridPatch:
        """The cells of all robots."""


class SharedMap:
    """One map and one graph that all robots have at once; their poses are known."""

    def __init__(self, loops: Sequence[ClosedLoop], grid: OccupancyConfig) -> None:
        self.grid = OccupancyGrid(grid)
        self.topology = TopologyBuilder()
        self._loops = loops
        self._updates = 0
        self._boxes: list[list[Array]] = [[] for _ in loops]

    def add_scan(self, robot: int, scan: Scan, T_odom_base: Array) -> Estimate:
        """As TeamMaps.add_scan."""
        loop = self._loops[robot]
        estimate = ground_truth_poses(loop.simulation)(scan, T_odom_base)
        loop.log_poses(scan, estimate)
        self.grid.add_scan(scan, estimate.T_map_base)
        for other, boxes in enumerate(self._boxes):
            if other != robot:
                boxes.append(box_of_scan(scan, estimate.T_map_base))
        return estimate

    def update(self, poses: dict[int, Array], now_s: float) -> None:
        """As TeamMaps.update."""
        if self._updates % SCANS_PER_GRAPH == 0:
            changes = self.grid.take_changes()
            if changes is not None:
                self.topology.update(changes, np.array(list(poses.values())))
        self._updates += 1

    def view(self, robot: int) -> tuple[TopologicalMap, GridPatch]:
        """As TeamMaps.view: the same for all."""
        return self.topology.map, self.grid.known_area()

    def take_changes(self, robot: int) -> list[Array]:
        """As TeamMaps.take_changes."""
        boxes = self._boxes[robot]
        self._boxes[robot] = []
        return boxes

    def known_area(self) -> GridPatch:
        """As TeamMaps.known_area."""
        return self.grid.known_area()
