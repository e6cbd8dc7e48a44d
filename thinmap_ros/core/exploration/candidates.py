"""Candidates: frontiers that may hide unknown space, with the belief about each.

Specks of free cells behind a wall, from beams that noise moved across it, have frontiers, too: they
are no candidates. Where an end node of the topological map is near, the candidate is published as
that end node; an end node without a candidate is settled.
"""

import math
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter, robot_radius
from thinmap_ros.core.exploration.belief.evidence import Evidence, EvidenceStore, Place
from thinmap_ros.core.exploration.belief.model import BeliefModel
from thinmap_ros.core.exploration.frontiers import Cells, FrontierMap
from thinmap_ros.core.exploration.reachable import Reachable
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID, EndNode, unobserved
from thinmap_ros.core.exploration.unknown_space import depth_behind_m, hidden_area_m2
from thinmap_ros.core.exploration.viewpoints import is_enclosed, place_beside, place_for
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stamps import SECOND_NS
from thinmap_ros.core.topology.graph import Node, NodeKind, TopologicalMap

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
        'A frontier belongs to the nearest end node within this distance, and one that no '
        'reachable place sees is observed from within it (m). Raise it in halls.',
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
    map, if it is the nearest frontier of one; goal (3,): viewpoint, None
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
    """Finds the candidates of a growing map, each with the evidence that it had before."""

    def __init__(self, config: CandidateConfig, model: BeliefModel) -> None:
        self._config = config
        self._model = model
        self.store = EvidenceStore(FIRST_FRONTIER_ID)
        self.candidates: list[Candidate] = []
        self._found: list[Candidate] = []

    def update(
        self,
        frontiers: FrontierMap,
        reachable: Reachable,
        T_map_base: Array,
        range_max_m: float,
        stamp_ns: int,
    ) -> None:
        """Find the candidates of a map, and update the belief about each.

        T_map_base (3,): pose of the robot; range_max_m: of the laser.
        """
        before = {id(c.evidence): c for c in self._found}
        self._found = self._find(frontiers)
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

    def settled(self, topology: TopologicalMap) -> list[EndNode]:
        """End nodes of a graph without a candidate; the others are named to their candidates.

        A candidate belongs to the nearest end node around it, an end node to the nearest candidate.
        """
        nodes = [node for node in topology.nodes.values() if node.kind == NodeKind.END]
        places = np.array([(node.x, node.y) for node in nodes]).reshape(-1, 2)
        nearest: dict[int, tuple[float, Candidate]] = {}
        for candidate in self.candidates:
            candidate.end_node = None
            away = np.hypot(*(places - candidate.middle).T)
            i = int(away.argmin()) if len(away) else -1
            if i < 0 or away[i] > self._config.frontier_assignment_radius_m:
                continue
            if i not in nearest or away[i] < nearest[i][0]:
                nearest[i] = (float(away[i]), candidate)
        for i, (_, candidate) in nearest.items():
            candidate.end_node = nodes[i]
        left = [node for i, node in enumerate(nodes) if i not in nearest]
        return [unobserved(node.id, (node.x, node.y), SETTLED) for node in left]

    def _find(self, frontiers: FrontierMap) -> list[Candidate]:
        clusters = frontiers.clusters(self._config.min_frontier_size)
        middles = [frontiers.middle_of(cells) for cells in clusters]
        frame = frontiers.frame
        first = np.array([frame.origin_y, frame.origin_x]) / frame.resolution
        on_lattice = [cells + np.round(first).astype(np.int64) for cells in clusters]
        evidence = self.store.follow(middles, on_lattice, frame.resolution)
        return [
            Candidate(item, cells, middle, length_m=len(cells) * frame.resolution)
            for item, cells, middle in zip(evidence, clusters, middles, strict=True)
        ]

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
