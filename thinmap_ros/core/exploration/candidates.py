"""Candidates: frontiers that may hide unknown space, with the belief about each.

All frontiers of an end node are one candidate: from one viewpoint the robot sees them all. Unknown
space that no end node sees, such as a niche that the skeleton does not reach into, is a candidate
of its own. Specks of free cells behind a wall, from beams that noise moved across it, have
frontiers, too: they are no candidates.
"""

import math
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter, robot_radius
from thinmap_ros.core.exploration.belief.evidence import Evidence, EvidenceStore, Place
from thinmap_ros.core.exploration.belief.model import BeliefModel
from thinmap_ros.core.exploration.frontiers import Cells, FrontierMap
from thinmap_ros.core.exploration.reachable import Reachable
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID, EndNode, unobserved
from thinmap_ros.core.exploration.unknown_space import depth_behind_m, hidden_area_m2
from thinmap_ros.core.exploration.viewpoints import is_enclosed, place_beside, place_for
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stamps import SECOND_NS
from thinmap_ros.core.topology.graph import Node, NodeKind, TopologicalMap
from thinmap_ros.jit import kernel

SETTLED = 0.999  # probability of an end node without a frontier
_RIM_M = 0.5  # at the end of its range the laser sees little
_NEAR_M = 1.5
_RENEW_S = 5.0
_RENEW_S_M = 0.5  # of a candidate far away: so much per metre, as its surroundings do not change


@dataclass(frozen=True)
class CandidateConfig(Config):
    """Which frontiers count, and from where they are observed."""

    robot_radius_m: float = robot_radius()
    # The name of explore_lite's parameter.
    min_frontier_size: float = parameter(
        0.5,
        'Shorter frontiers are ignored (m). Raise it for shorter paths, lower it for higher '
        'coverage.',
        low=0.0,
        high=5.0,
    )
    frontier_assignment_radius_m: float = parameter(
        3.0,
        'A frontier belongs to the nearest visible end node within this distance (m). Raise it in '
        'halls.',
        low=0.1,
        high=50.0,
    )
    view_depth_m: float = parameter(
        2.0,
        'Depth behind a frontier that a viewpoint must be able to see (m). Raise it to drive '
        'closer to the middle of openings.',
        low=0.1,
        high=20.0,
    )


@dataclass(eq=False)
class Candidate:
    """A frontier that may hide unknown space, with the belief about it.

    cells (N, 2): of the frontier; middle (x, y), m: of these cells; end_node: of the topological
    map, to which the frontier belongs; goal (3,): viewpoint, None
    where none can be reached; hidden_m2: unknown area in line of sight; depth_m: of the unknown
    behind it; probability: that nothing worth seeing is behind; mean_area_m2: if there is;
    examined_ns: when viewpoint, hidden area and depth were determined; is_enclosed: whether its
    free cells connect to nowhere that the robot fits.
    """

    evidence: Evidence
    cells: Cells
    middle: Place
    end_node: Node | None = None
    length_m: float = 0.0
    goal: Array | None = None
    hidden_m2: float = 0.0
    depth_m: float = 0.0
    probability: float = 0.5
    mean_area_m2: float = 0.0
    examined_ns: int = -1
    is_enclosed: bool = False

    @property
    def node_id(self) -> int:
        """Id with which it is published: of its end node, or else its own."""
        return self.evidence.id if self.end_node is None else self.end_node.id

    def published(self, target_goal: Array | None) -> EndNode:
        """End node of a decision; target_goal (3,): where the robot drives if it is the target."""
        node = self.end_node
        place = self.middle if node is None else (node.x, node.y)
        end_node = unobserved(self.node_id, place, self.probability)
        goal = end_node.goal if self.goal is None else self.goal
        return end_node._replace(
            frontier_length_m=self.length_m,
            expected_area_m2=(1.0 - self.probability) * self.mean_area_m2,
            is_target=target_goal is not None,
            goal=goal if target_goal is None else target_goal,
        )


class CandidateFinder:
    """Finds the candidates of a growing map, each with the evidence that it had before.

    settled: end nodes without a frontier.
    """

    def __init__(self, config: CandidateConfig, model: BeliefModel) -> None:
        self._config = config
        self._model = model
        self.store = EvidenceStore(FIRST_FRONTIER_ID)
        self.candidates: list[Candidate] = []
        self.settled: list[EndNode] = []
        self._found: list[Candidate] = []

    def update(
        self,
        topology: TopologicalMap,
        frontiers: FrontierMap,
        reachable: Reachable,
        T_map_base: Array,
        range_max_m: float,
        stamp_ns: int,
    ) -> None:
        """Find the candidates of a graph and a map, and update the belief about each.

        T_map_base (3,): pose of the robot; range_max_m: of the laser.
        """
        before = {id(c.evidence): c for c in self._found}
        self._found = self._find(topology, frontiers)
        for candidate in self._found:
            known = before.get(id(candidate.evidence))
            if known is None or not _may_keep(candidate, known, stamp_ns, T_map_base):
                self._examine(candidate, frontiers, reachable, range_max_m)
                candidate.examined_ns = stamp_ns
            candidate.probability = self._model.probability(
                candidate.length_m,
                candidate.hidden_m2,
                candidate.depth_m,
                candidate.evidence.visits,
            )
            candidate.mean_area_m2 = self._model.mean_area(candidate.hidden_m2)
        self.candidates = [c for c in self._found if not c.is_enclosed]

    def _find(self, topology: TopologicalMap, frontiers: FrontierMap) -> list[Candidate]:
        nodes = [node for node in topology.nodes.values() if node.kind == NodeKind.END]
        clusters = frontiers.clusters(self._config.min_frontier_size)
        owners = self._owners(frontiers, clusters, nodes)
        self.settled = [
            unobserved(node.id, (node.x, node.y), SETTLED)
            for i, node in enumerate(nodes)
            if i not in owners
        ]
        owned: dict[tuple[int, int], list[Cells]] = defaultdict(list)
        for i, (cells, owner) in enumerate(zip(clusters, owners, strict=True)):
            owned[owner, i if owner < 0 else 0].append(cells)
        found = [np.vstack(parts) for parts in owned.values()]
        end_nodes = [nodes[owner] if owner >= 0 else None for owner, _ in owned]
        middles = [frontiers.middle_of(cells) for cells in found]
        frame = frontiers.frame
        first = np.array([frame.origin_y, frame.origin_x]) / frame.resolution
        on_lattice = [cells + np.round(first).astype(np.int64) for cells in found]
        evidence = self.store.follow(middles, on_lattice, frame.resolution)
        return [
            Candidate(item, cells, middle, node, len(cells) * frame.resolution)
            for item, cells, middle, node in zip(evidence, found, middles, end_nodes, strict=True)
        ]

    def _owners(
        self, frontiers: FrontierMap, clusters: list[Cells], nodes: list[Node]
    ) -> list[int]:
        """Index of the nearest end node that sees the middle of each frontier; -1: none."""
        middles = np.array([frontiers.middle_of(cells) for cells in clusters]).reshape(-1, 2)
        places = np.array([(node.x, node.y) for node in nodes]).reshape(-1, 2)
        frame = frontiers.frame
        owners: list[int] = _nearest_in_sight(
            frontiers.free,
            middles,
            places,
            frame.cells_of(middles),
            frame.cells_of(places),
            self._config.frontier_assignment_radius_m,
        ).tolist()
        return owners

    def _examine(
        self, candidate: Candidate, frontiers: FrontierMap, reachable: Reachable, range_max_m: float
    ) -> None:
        """Determine the hidden area and the viewpoint.

        The viewpoint is as far away as the laser allows, unless a visit there showed nothing. Where
        no reachable place sees the frontier, it is the nearest one on the way: from there a passage
        that looks too narrow may turn out to be wide enough.
        """
        candidate.hidden_m2 = hidden_area_m2(frontiers, candidate.middle)
        candidate.depth_m = depth_behind_m(frontiers, candidate.cells)
        cell = self._viewpoint(candidate, frontiers, reachable, range_max_m)
        candidate.goal = None
        if cell is None:
            candidate.is_enclosed = is_enclosed(frontiers.free, reachable.standing, candidate.cells)
        else:
            x, y = frontiers.frame.centres_of(np.array([cell]))[0]
            candidate.goal = _facing((float(x), float(y)), candidate.middle)

    def _viewpoint(
        self, candidate: Candidate, frontiers: FrontierMap, reachable: Reachable, range_max_m: float
    ) -> tuple[int, int] | None:
        """Cell (row, col) from which to observe a candidate; None: there is none."""
        resolution = frontiers.frame.resolution
        views = [(range_max_m - _RIM_M, self._config.view_depth_m), (_NEAR_M, 0.0)]
        for reach_m, depth_m in views[min(candidate.evidence.visits, 1) :]:
            cell = place_for(
                frontiers.free,
                frontiers.passable,
                candidate.cells,
                reachable.cells,
                reachable.path_lengths,
                round(depth_m / resolution),
                reach_m / resolution,
            )
            if cell is not None:
                return cell
        steps = int(self._config.frontier_assignment_radius_m / resolution)
        row, col = frontiers.frame.cells_of(np.array([candidate.middle]))[0]
        towards = (int(row), int(col))
        return place_beside(frontiers.free, candidate.cells, reachable.cells, steps, towards)


@kernel
def _nearest_in_sight(
    free: NDArray[np.bool_],
    points: Array,
    nodes: Array,
    point_cells: Cells,
    node_cells: Cells,
    radius_m: float,
) -> NDArray[np.int64]:
    """Index of the nearest node (N, 2), m, within a radius of each point (M, 2), m; -1: none.

    All cells between are free. point_cells (M, 2), node_cells (N, 2): the cells of both.
    """
    nearest = np.full(points.shape[0], -1, dtype=np.int64)
    for i in range(points.shape[0]):
        best_m = np.inf
        for k in range(nodes.shape[0]):
            away_m = math.hypot(nodes[k, 0] - points[i, 0], nodes[k, 1] - points[i, 1])
            if away_m > radius_m or away_m >= best_m:
                continue
            row, col = node_cells[k]
            if line_is_clear(free, row, col, point_cells[i, 0], point_cells[i, 1]):
                best_m = away_m
                nearest[i] = k
    return nearest


def _may_keep(candidate: Candidate, known: Candidate, stamp_ns: int, T_map_base: Array) -> bool:
    """Adopt viewpoint and hidden area of the last time, if the frontier is still the same."""
    same = len(known.cells) == len(candidate.cells) and known.middle == candidate.middle
    away_m = math.dist(candidate.middle, T_map_base[:2])
    renew_s = max(_RENEW_S, _RENEW_S_M * away_m)
    recent = 0 <= stamp_ns - known.examined_ns < renew_s * SECOND_NS
    if not (same and recent and known.examined_ns >= 0):
        return False
    candidate.goal = known.goal
    candidate.hidden_m2 = known.hidden_m2
    candidate.depth_m = known.depth_m
    candidate.examined_ns = known.examined_ns
    candidate.is_enclosed = known.is_enclosed
    return True


def _facing(place: Place, towards: Place) -> Array:
    """Pose (3,) at a place, with another one ahead."""
    return se2.pose(*place, math.atan2(towards[1] - place[1], towards[0] - place[0]))
