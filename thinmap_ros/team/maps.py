"""Maps of a team: one that all robots share at once, or one of each, completed by the others'."""

from collections.abc import Sequence
from functools import reduce
from typing import Protocol

import numpy as np

from thinmap_ros.closed_loop import SCANS_PER_GRAPH, ClosedLoop, ground_truth_poses
from thinmap_ros.core.exploration.explorer import Explorer
from thinmap_ros.core.exploration.space import box_of_scan
from thinmap_ros.core.exploration.team import Team
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import (
    ReceivedTiles,
    TileMessage,
    TileSender,
    changed_part,
    completed,
)
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stage import Estimate
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.team.radio import Radio, Trouble

TILE_PERIOD_S = 5.0
_REQUEST_BYTES = 12


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


class _OwnMap:
    """The map of one robot with what it has received, and the graph of both.

    next_after: version after which it sends its tiles next.
    """

    def __init__(self, loop: ClosedLoop) -> None:
        assert isinstance(loop.strategy, Explorer)
        frame = loop.pipeline.grid.frame
        self.loop = loop
        self.team: Team = loop.strategy.team
        self.sender = TileSender(frame)
        self.received = ReceivedTiles(frame)
        self.topology = TopologyBuilder()
        self.patch = GridPatch(frame, np.full((1, 1), -1, dtype=np.int8))
        self.next_after = 0
        self.boxes: list[Array] = []
        self._corrections = 0
        self._thinned = self.patch

    def update(self, pose: Array | None) -> None:
        """Complete the map; with the robot's pose (3,) update the graph, too."""
        patch = self.received.completed(self.loop.pipeline.grid.known_area())
        is_replaced = self.loop.pipeline.corrections != self._corrections
        self._corrections = self.loop.pipeline.corrections
        self.patch = GridPatch(patch.frame, patch.cells, patch.is_replaced or is_replaced)
        if pose is None:
            return
        changes = changed_part(self._thinned, self.patch)
        self._thinned = self.patch
        if changes is not None:
            self.topology.update(changes, pose)


class OwnMaps:
    """A map and a graph for each robot; their lattices are one, their relative poses are known."""

    def __init__(self, loops: Sequence[ClosedLoop], trouble: Trouble, seed: int) -> None:
        self.tiles: Radio[tuple[int, bytes]] = Radio(len(loops), trouble, 0.0, seed)
        self._maps = [_OwnMap(loop) for loop in loops]
        self._trouble = trouble
        self._updates = 0
        self._sent_s = 0.0

    def add_scan(self, robot: int, scan: Scan, T_odom_base: Array) -> Estimate:
        """As TeamMaps.add_scan."""
        return self._maps[robot].loop.map_scan(scan, T_odom_base)

    def update(self, poses: dict[int, Array], now_s: float) -> None:
        """As TeamMaps.update."""
        if now_s - self._sent_s >= TILE_PERIOD_S:
            self._sent_s = now_s
            for robot in poses:
                self._send(robot, now_s)
        for receiver, (sender, data) in self.tiles.received(now_s):
            self._receive(receiver, sender, data)
        is_due = self._updates % SCANS_PER_GRAPH == 0
        for robot, pose in poses.items():
            self._maps[robot].update(pose if is_due else None)
        self._updates += 1

    def view(self, robot: int) -> tuple[TopologicalMap, GridPatch]:
        """As TeamMaps.view."""
        own = self._maps[robot]
        return own.topology.map, own.patch

    def take_changes(self, robot: int) -> list[Array]:
        """As TeamMaps.take_changes."""
        own = self._maps[robot]
        boxes = own.boxes
        own.boxes = []
        return boxes

    def known_area(self) -> GridPatch:
        """As TeamMaps.known_area."""
        return reduce(completed, (own.loop.pipeline.grid.known_area() for own in self._maps))

    def _send(self, robot: int, now_s: float) -> None:
        """Send what has changed since the last message, or since what a receiver has asked for.

        A message without tiles shows the others which version they should have.
        """
        own = self._maps[robot]
        own.sender.update(own.loop.pipeline.grid.known_area())
        if not self._trouble.is_silent(robot, now_s):
            data = own.sender.changes_after(own.next_after).encode()
            self.tiles.broadcast(robot, (robot, data), len(data), now_s)
            own.next_after = own.sender.version

    def _receive(self, receiver: int, sender: int, data: bytes) -> None:
        """Add tiles; where earlier ones are missing, ask for them."""
        own = self._maps[receiver]
        other = self._maps[sender]
        message = TileMessage.decode(data)
        box = own.received.add(other.team.name, message)
        if box is not None:
            own.boxes.append(box)
        known = own.received.version_of(other.team.name)
        if known < message.version:
            other.next_after = min(other.next_after, known)
            self.tiles.sent_bytes += _REQUEST_BYTES
