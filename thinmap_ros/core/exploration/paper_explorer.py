"""Exploration by the position probability of end nodes, as the paper prints it.

- Each view of an end node updates its position probability by equations (1) to (10), from 0.5 on.
- Only end nodes below the threshold are visited: first the one that the robot faces, afterwards the
  nearest one on the graph. A target is kept until its probability passes the threshold or it
  disappears.
- Finished when no end node below the threshold is left.

What the paper leaves open: which views count, and which end node continues which
(`paper_evidence`); an end node that the robot has reached without success is not visited again, nor
one that the navigator could not reach.

Source: exploration paper sections 3.2 and 4.
"""

import math

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.paper_evidence import (
    PaperConfig,
    PaperEndNode,
    PaperEndNodes,
)
from thinmap_ros.core.exploration.position_probability import bayes_update
from thinmap_ros.core.exploration.space import FrontierMap, box_of_scan, visible_places
from thinmap_ros.core.exploration.strategy import (
    Decision,
    EndNode,
    Start,
    Streak,
    decide,
    is_near,
    unobserved,
)
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.paths import path_lengths_to_nodes
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap


class PaperExplorer:
    """Visits end nodes until the position probability of each one passes the threshold."""

    def __init__(self, config: PaperConfig | None = None) -> None:
        self.config = config or PaperConfig()
        self._frontier_map = FrontierMap()
        self._followed = PaperEndNodes()
        self._end_nodes: list[PaperEndNode] = []
        self._target: PaperEndNode | None = None
        self._goal: Array | None = None
        self._is_first = True
        self._start = Start()
        self._visit = Streak()
        self._end = Streak()

    def step(
        self, topology: TopologicalMap, patch: GridPatch, scan: Scan, T_map_base: Array
    ) -> Decision:
        """Choose where to drive; see strategy.Strategy."""
        self._frontier_map.update(patch, box_of_scan(scan, T_map_base))
        nodes = [node for node in topology.nodes.values() if node.kind == NodeKind.END]
        self._end_nodes = self._followed.follow(nodes, self.config.node_reset_distance_m)
        self._add_views(scan, T_map_base)
        self._add_visit(T_map_base)
        left = [node for node in self._doubtful if not node.tries]
        self._end.add(not self._start.lasts(topology, scan.stamp_ns) and not left)
        self._choose(left, topology, T_map_base)
        return self._decision()

    def target_failed(self, reason: str) -> None:
        """Process that the present target could not be reached."""
        if self._target is not None:
            self._target.failures += 1
            self._target = None

    def _add_views(self, scan: Scan, T_map_base: Array) -> None:
        """Equations (1) to (10) for each end node of which this scan is a view."""
        if not self._end_nodes:
            return
        T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
        places = np.array([node.place for node in self._end_nodes])
        frontiers = self._frontier_map
        seen = visible_places(places, scan, T_map_laser, frontiers.free, frontiers.frame)
        for i in np.flatnonzero(seen):
            node = self._end_nodes[i]
            if node.add_view(T_map_laser, self.config):
                node.probability = bayes_update(node.probability, node.reliability)

    def _add_visit(self, T_map_base: Array) -> None:
        """An end node that the robot has reached needs no further visit."""
        target = self._target
        if target is None:
            return
        if self._visit.add(is_near(T_map_base, target.place)):
            target.visits += 1
            self._visit = Streak()

    @property
    def _doubtful(self) -> list[PaperEndNode]:
        """End nodes that are not resolved: worth a visit, or given up after one."""
        threshold = self.config.probability_threshold
        return [node for node in self._end_nodes if node.probability < threshold]

    def _choose(
        self, left: list[PaperEndNode], topology: TopologicalMap, T_map_base: Array
    ) -> None:
        if self._target not in left:
            self._target = self._next(left, topology, T_map_base) if left else None
            self._goal = None
        if self._target is None:
            return
        place = self._target.place
        if self._goal is None or not is_near(self._goal, place):  # it moves as the map grows
            heading = math.atan2(place[1] - T_map_base[1], place[0] - T_map_base[0])
            self._goal = se2.pose(*place, heading)

    def _next(
        self, left: list[PaperEndNode], topology: TopologicalMap, T_map_base: Array
    ) -> PaperEndNode:
        if self._is_first:
            self._is_first = False
            return min(left, key=lambda node: _turn(T_map_base, node.place))
        lengths = path_lengths_to_nodes(topology, float(T_map_base[0]), float(T_map_base[1]))
        return min(left, key=lambda node: lengths.get(node.node_id, math.inf))

    def _decision(self) -> Decision:
        end_nodes = [
            _published(node, self._goal if node is self._target else None)
            for node in self._end_nodes
        ]
        doubtful = self._doubtful
        given_up = (node.node_id for node in doubtful if node.tries)
        area_m2 = self._frontier_map.known_area_m2
        return decide(end_nodes, self._end.is_over, len(doubtful), given_up, area_m2)


def _published(node: PaperEndNode, target_goal: Array | None) -> EndNode:
    """End node of a decision; target_goal (3,): where the robot drives if it is the target."""
    end_node = unobserved(
        node.node_id, node.place, node.probability, target_goal, target_goal is not None
    )
    return end_node._replace(
        distance_index=node.distance_index,
        angle_index=node.angle_index,
        min_distance_m=node.min_distance_m,
        angle_span_deg=node.angle_span_deg,
    )


def _turn(T_map_base: Array, place: tuple[float, float]) -> float:
    """Size of the turn towards a place, rad."""
    bearing = math.atan2(place[1] - T_map_base[1], place[0] - T_map_base[0])
    return abs(se2.wrap(bearing - float(T_map_base[2])))
