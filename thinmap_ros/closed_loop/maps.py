"""Maps of robots: of each its own, one that all share at once, or own ones with the others'."""

from collections.abc import Sequence
from functools import reduce

import numpy as np

from thinmap_ros.closed_loop.radio import Radio, Trouble
from thinmap_ros.closed_loop.robot import SCANS_PER_GRAPH, SimulatedRobot, ground_truth_poses
from thinmap_ros.core.exploration.space import box_of_scan
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import (
    TILE_PERIOD_S,
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

_REQUEST_BYTES = 12


class Maps:
    """The maps and graphs in which robots, numbered from 0, explore: those of their pipelines."""

    def __init__(self, robots: Sequence[SimulatedRobot]) -> None:
        self.robots = robots

    def add_scan(self, robot: int, scan: Scan) -> Estimate | None:
        """Localize and map a scan of a robot, without the others in it; as its `map_scan`."""
        return self.robots[robot].map_scan(scan)

    def update(self, poses: dict[int, Array], now_s: float) -> None:
        """Update the graphs after the scans of all robots, and exchange what has changed.

        poses: by robot, those that work and know where they are.
        """

    def view(self, robot: int) -> tuple[TopologicalMap, GridPatch]:
        """The graph and the map of a robot."""
        pipeline = self.robots[robot].pipeline
        return pipeline.topology.map, pipeline.grid.known_area()

    def known_area(self) -> GridPatch:
        """The cells of all robots."""
        return reduce(completed, (robot.pipeline.grid.known_area() for robot in self.robots))


class SharedMap(Maps):
    """One map and one graph that all robots have at once; their poses are known."""

    def __init__(self, robots: Sequence[SimulatedRobot]) -> None:
        super().__init__(robots)
        self.grid = OccupancyGrid(robots[0].pipeline.config.grid)
        self.topology = TopologyBuilder(robots[0].pipeline.config.topology)
        self._updates = 0

    def add_scan(self, robot: int, scan: Scan) -> Estimate | None:
        """As Maps.add_scan."""
        own = self.robots[robot]
        estimate = ground_truth_poses(own.simulation)(scan, own.moment.T_odom_base)
        own.log_poses(scan, estimate)
        self.grid.add_scan(scan, estimate.T_map_base)
        for other in self.robots:
            if other is not own:
                other.explorer.team.add_changes(box_of_scan(scan, estimate.T_map_base))
        return estimate

    def update(self, poses: dict[int, Array], now_s: float) -> None:
        """As Maps.update."""
        if self._updates % SCANS_PER_GRAPH == 0:
            changes = self.grid.take_changes()
            if changes is not None:
                self.topology.update(changes, np.array(list(poses.values())))
        self._updates += 1

    def view(self, robot: int) -> tuple[TopologicalMap, GridPatch]:
        """As Maps.view: the same for all."""
        return self.topology.map, self.grid.known_area()

    def known_area(self) -> GridPatch:
        """As Maps.known_area."""
        return self.grid.known_area()


class _OwnMap:
    """The map of one robot with what it has received, and the graph of both."""

    def __init__(self, robot: SimulatedRobot) -> None:
        frame = robot.pipeline.grid.frame
        self.robot = robot
        self.sender = TileSender(frame)
        self.received = ReceivedTiles(frame)
        self.topology = TopologyBuilder(robot.pipeline.config.topology)
        self.patch = GridPatch(frame, np.full((1, 1), -1, dtype=np.int8))
        self._corrections = 0
        self._thinned = self.patch

    def update(self, pose: Array | None) -> None:
        """Complete the map; with the robot's pose (3,) update the graph, too."""
        pipeline = self.robot.pipeline
        patch = self.received.completed(pipeline.grid.known_area())
        is_replaced = pipeline.corrections != self._corrections
        self._corrections = pipeline.corrections
        self.patch = GridPatch(patch.frame, patch.cells, patch.is_replaced or is_replaced)
        if pose is None:
            return
        changes = changed_part(self._thinned, self.patch)
        self._thinned = self.patch
        if changes is not None:
            self.topology.update(changes, pose)


class OwnMaps(Maps):
    """A map and a graph for each robot; their lattices are one, their relative poses are known."""

    def __init__(self, robots: Sequence[SimulatedRobot], trouble: Trouble, seed: int) -> None:
        super().__init__(robots)
        self.tiles: Radio[tuple[int, bytes]] = Radio(len(robots), trouble, 0.0, seed)
        self._maps = [_OwnMap(robot) for robot in robots]
        self._trouble = trouble
        self._updates = 0
        self._sent_s = 0.0

    def update(self, poses: dict[int, Array], now_s: float) -> None:
        """As Maps.update."""
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
        """As Maps.view."""
        own = self._maps[robot]
        return own.topology.map, own.patch

    def _send(self, robot: int, now_s: float) -> None:
        """Send what has changed since the last message, or since what a receiver has asked for.

        A message without tiles shows the others which version they should have.
        """
        sender = self._maps[robot].sender
        sender.update(self.robots[robot].pipeline.grid.known_area())
        if not self._trouble.is_silent(robot, now_s):
            data = sender.next_message().encode()
            self.tiles.broadcast(robot, (robot, data), len(data), now_s)

    def _receive(self, receiver: int, sender: int, data: bytes) -> None:
        """Add tiles; where earlier ones are missing, ask for them."""
        robot = self.robots[receiver]
        received = self._maps[receiver].received
        name = self.robots[sender].name
        message = TileMessage.decode(data)
        box = received.add(name, message)
        if box is not None:
            robot.explorer.team.add_changes(box)
        known = received.version_of(name)
        if known < message.version:
            self._maps[sender].sender.repeat_after(known)
            self.tiles.sent_bytes += _REQUEST_BYTES
