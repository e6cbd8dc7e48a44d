"""Exploration by the position probability of end nodes, as the paper prints it.

The equations come first, one by one: how likely an end node is to stay where it is once all is
explored. Source: exploration paper sections 3.2, equations (1) to (10), and 4.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.distance import cdist

from thinmap_ros.core import se2
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
from thinmap_ros.core.se2 import Array, Place
from thinmap_ros.core.topology.graph import Node, NodeKind, TopologicalMap

NEAR_M = 0.5
PRIOR = 0.5
_SUREST = 1.0 - 1e-6


def distance_index(r: float) -> float:
    """D: 1.0 at r = 0.5 m, 0.5 at 4.5 m, less farther off, where a look speaks against the node.

    Source: exploration paper equations (1) and (2).
    """
    return 4.0 / (max(r, NEAR_M) + 3.5)


def angle_index(span_deg: float) -> float:
    """A: 0 where all looks came from one side, 1 from 90 degrees on.

    Source: exploration paper equation (4).
    """
    return min(span_deg / 90.0, 1.0)


def reliability(r: float, span_deg: float) -> float:
    """R: the better of the distance index at r (m) and the angle index of a span (degrees).

    Source: exploration paper equation (5).
    """
    return max(distance_index(r), angle_index(span_deg))


def bayes_update(p: float, reliability: float) -> float:
    """Position probability after a look of a reliability R: R p / (R p + (1 - R)(1 - p)).

    R = p(X | reliable) and 1 - R = p(X | unreliable). The result stays a millionth away from 0 and
    1, because nothing could ever change a certainty again.
    Source: exploration paper equations (6) to (10).
    """
    for_it = reliability * p
    against = (1.0 - reliability) * (1.0 - p)
    posterior = for_it / (for_it + against) if for_it + against > 0.0 else p
    return min(max(posterior, 1.0 - _SUREST), _SUREST)


@dataclass(frozen=True)
class PaperConfig:
    """What the paper leaves open: which views count, and how long evidence stays with a place.

    A view counts only if, since the last one that counted, the place as seen from the laser has
    moved or turned far enough. The place lies in the laser's range and field of view, and all cells
    between are free. A place too far from where its evidence began loses its evidence: it was about
    another place. Evidence continues that of the nearest place before.
    probability_threshold: end nodes with at least this position probability are not visited;
    observation_distance_m, observation_angle_deg: motion of the robot, and change of the bearing,
    after which an end node counts as observed again; node_reset_distance_m: an end node that moves
    farther loses its evidence.
    """

    probability_threshold: float = 0.9
    observation_distance_m: float = 0.5
    observation_angle_deg: float = 15.0
    node_reset_distance_m: float = 0.5


@dataclass(eq=False)
class PaperEndNode:
    """An end node of the graph with its position probability, and the evidence for it.

    place (x, y), m; began_at: where its evidence began; views: distance, m, and bearing, rad, of
    each view that counted; angle_span_deg: largest difference between two of these bearings, the
    shorter way round, a_max of equation (3);
    visits, failures: how often the robot was there, and could not get there.
    """

    node_id: int
    place: Place
    began_at: Place
    probability: float = PRIOR
    views: list[tuple[float, float]] = field(default_factory=list)
    angle_span_deg: float = 0.0
    visits: int = 0
    failures: int = 0

    @property
    def tries(self) -> int:
        """How often the robot was there, or could not get there."""
        return self.visits + self.failures

    @property
    def min_distance_m(self) -> float:
        """Distance of the nearest view, r of equation (2); inf before the first."""
        return min((distance for distance, _ in self.views), default=math.inf)

    @property
    def distance_index(self) -> float:
        """D of equation (1); 0 before the first view."""
        return distance_index(self.min_distance_m) if self.views else 0.0

    @property
    def angle_index(self) -> float:
        """A of equation (4)."""
        return angle_index(self.angle_span_deg)

    @property
    def reliability(self) -> float:
        """R of equation (5); 0 before the first view."""
        return reliability(self.min_distance_m, self.angle_span_deg) if self.views else 0.0

    def add_view(self, laser: Array, config: PaperConfig) -> bool:
        """Add a view from a laser at (x, y, ...), m; returns whether it counts."""
        dx = self.place[0] - float(laser[0])
        dy = self.place[1] - float(laser[1])
        distance_m = math.hypot(dx, dy)
        bearing = math.atan2(dy, dx)
        if self.views:
            last_m, last = self.views[-1]
            moved_m = math.dist((dx, dy), (last_m * math.cos(last), last_m * math.sin(last)))
            turned = abs(se2.wrap(bearing - last))
            if moved_m < config.observation_distance_m and turned < math.radians(
                config.observation_angle_deg
            ):
                return False
        turns = (abs(math.degrees(se2.wrap(bearing - other))) for _, other in self.views)
        self.angle_span_deg = max(self.angle_span_deg, *turns, 0.0)
        self.views.append((distance_m, bearing))
        return True

    def move_to(self, place: Place, reset_distance_m: float) -> None:
        """Follow the place; evidence about a place too far away is forgotten."""
        self.place = place
        if math.dist(place, self.began_at) > reset_distance_m:
            self.began_at = place
            self.probability = PRIOR
            self.views = []
            self.angle_span_deg = 0.0
            self.visits = 0


class PaperEndNodes:
    """End nodes of the present graph, and earlier ones that were tried."""

    def __init__(self) -> None:
        self.items: list[PaperEndNode] = []

    def follow(self, nodes: Sequence[Node], reset_distance_m: float) -> list[PaperEndNode]:
        """Each end node now; it continues the nearest earlier one within reset_distance_m."""
        earlier = self.items
        places = [(node.x, node.y) for node in nodes]
        indices = _continued(
            np.array([item.place for item in earlier]).reshape(-1, 2),
            np.array(places, dtype=np.float64).reshape(-1, 2),
            reset_distance_m,
        )
        found = []
        for node, place, index in zip(nodes, places, indices, strict=True):
            if index < 0:
                found.append(PaperEndNode(node.id, place, place))
                continue
            earlier[index].node_id = node.id
            earlier[index].move_to(place, reset_distance_m)
            found.append(earlier[index])
        continued = set(indices)
        left = [item for i, item in enumerate(earlier) if i not in continued and item.tries]
        for item in left:
            item.probability = PRIOR
        self.items = found + left
        return found


def _continued(earlier: Array, places: Array, radius_m: float) -> list[int]:
    """Index of the earlier place (N, 2), m, that each place (M, 2), m, continues; -1: none.

    It is the nearest one within a radius; each is continued once, by the first place.
    """
    away_m = np.pad(cdist(places, earlier), ((0, 0), (0, 1)), constant_values=radius_m)
    indices = []
    for own in away_m:
        nearest = int(own.argmin())
        is_new = nearest == len(earlier)
        indices.append(-1 if is_new else nearest)
        away_m[:, nearest] = radius_m if is_new else np.inf
    return indices


class PaperExplorer:
    """Visits end nodes until the position probability of each one passes the threshold.

    Each view of an end node updates its position probability, from 0.5 on. Only end nodes below the
    threshold are visited: first the one that the robot faces, afterwards the nearest one on the
    graph. A target is kept until its probability passes the threshold or it disappears. What the
    paper leaves open, besides `PaperConfig`: an end node that the robot has reached without success
    is not visited again, nor one that the navigator could not reach.
    """

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
        """Choose where to drive; see `Strategy`."""
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
            self._goal = se2.pose(*place, se2.bearing(T_map_base, place))

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


def _turn(T_map_base: Array, place: Place) -> float:
    """Size of the turn towards a place, rad."""
    return abs(se2.wrap(se2.bearing(T_map_base, place) - float(T_map_base[2])))
