"""Candidates: end nodes with the frontiers that belong to them, and frontiers of their own.

A frontier belongs to the nearest end node within `frontier_assignment_radius_m` that has its middle
in line of sight. Unknown space that no end node sees, such as a niche that the skeleton does not
reach into, is a candidate of its own. An end node without a frontier is one that is settled. Specks
of free cells behind a wall, from beams that noise moved across it, have frontiers, too: they are no
candidates.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import parameter, robot_radius
from thinmap_ros.core.exploration.belief.evidence import (
    Evidence,
    EvidenceConfig,
    EvidenceStore,
    Place,
)
from thinmap_ros.core.exploration.belief.model import HIDDEN_REACH_M, BeliefModel
from thinmap_ros.core.exploration.frontiers import Cells, FrontierMap
from thinmap_ros.core.exploration.reachable import Reachable
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID, EndNode
from thinmap_ros.core.exploration.viewpoints import is_enclosed, place_beside, place_for
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stamps import SECOND_NS
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap
from thinmap_ros.jit import kernel

_RIM_M = 0.5  # at the end of its range the laser sees little
_NEAR_M = 1.5
_RENEW_S = 5.0
_RENEW_S_M = 0.5  # of a candidate far away: so much per metre, as its surroundings do not change
_NO_CELLS: Cells = np.zeros((0, 2), dtype=np.int64)


@dataclass(frozen=True)
class CandidateConfig(EvidenceConfig):
    """Which frontiers count, to which end node they belong, and from where they are observed."""

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
    """A place that may hide unknown space, with the belief about it.

    node_id: of its end node in the topological map, or evidence.id; place (x, y), m: the end node,
    or the middle of the frontier; cells (N, 2): of its frontier, none where all around an end node
    is known; middle (x, y), m: of these cells; goal (3,): viewpoint, None where none can be
    reached; hidden_m2: unknown area in line of sight; probability: that nothing worth seeing is
    behind; mean_area_m2: if there is; examined_ns: when viewpoint and hidden area were determined;
    is_enclosed: whether its free cells connect to nowhere that the robot fits; end_node: as it is
    published; judged_by: number of views and visits that the belief includes.
    """

    node_id: int
    place: Place
    cells: Cells
    middle: Place
    evidence: Evidence
    length_m: float = 0.0
    goal: Array | None = None
    hidden_m2: float = 0.0
    probability: float = 0.5
    mean_area_m2: float = 0.0
    examined_ns: int = -1
    is_enclosed: bool = False
    end_node: EndNode | None = None
    judged_by: tuple[int, int] = (-1, -1)

    @property
    def is_end_node(self) -> bool:
        """Whether it is an end node of the topological map."""
        return self.node_id < FIRST_FRONTIER_ID

    @property
    def expected_area_m2(self) -> float:
        """Area that is expected behind it."""
        return (1.0 - self.probability) * self.mean_area_m2

    def as_end_node(self, target_goal: Array | None) -> EndNode:
        """End node of a decision; target_goal (3,): where the robot drives if it is the target."""
        if self.end_node is None:
            end_node = end_node_of(self.node_id, self.evidence, self.probability)
            self.end_node = end_node._replace(
                frontier_length_m=self.length_m,
                expected_area_m2=self.expected_area_m2,
                goal=end_node.goal if self.goal is None else self.goal,
            )
        if target_goal is None:
            return self.end_node
        return self.end_node._replace(is_target=True, goal=target_goal)

    def adopt_belief(self, known: 'Candidate') -> bool:
        """Adopt the belief of the last time, if it has the same evidence about the same place.

        Call it where frontier and hidden area are the same.
        """
        if known.judged_by != self._evidence_count or known.node_id != self.node_id:
            return False
        if known.place != self.place:
            return False
        self.probability = known.probability
        self.mean_area_m2 = known.mean_area_m2
        self.end_node = known.end_node
        self.judged_by = known.judged_by
        return True

    def judge(self, model: BeliefModel) -> None:
        """Update the belief by the evidence."""
        self.probability = model.probability(self.evidence, self.length_m, self.hidden_m2)
        self.mean_area_m2 = model.mean_area(self.length_m, self.hidden_m2)
        self.end_node = None
        self.judged_by = self._evidence_count

    @property
    def _evidence_count(self) -> tuple[int, int]:
        return len(self.evidence.views), self.evidence.visits


def end_node_of(node_id: int, evidence: Evidence, probability: float) -> EndNode:
    """End node of a decision from its evidence: without a frontier, and not the target."""
    return EndNode(
        node_id=node_id,
        x=evidence.place[0],
        y=evidence.place[1],
        probability=probability,
        distance_index=evidence.distance_index,
        angle_index=evidence.angle_index,
        min_distance_m=evidence.min_distance_m,
        angle_span_deg=evidence.angle_span_deg,
        frontier_length_m=0.0,
        expected_area_m2=0.0,
        is_target=False,
        goal=np.array([*evidence.place, 0.0]),
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
            candidate.length_m = len(candidate.cells) * frontiers.frame.resolution
            known = before.get(id(candidate.evidence))
            is_same = known is not None and _may_keep(candidate, known, stamp_ns, T_map_base)
            if len(candidate.cells) and not is_same:
                self._examine(candidate, frontiers, reachable, range_max_m)
                candidate.examined_ns = stamp_ns
            if known is None or not (is_same and candidate.adopt_belief(known)):
                self.judge(candidate)
        self.candidates = [c for c in self._found if not c.is_enclosed]

    def judge(self, candidate: Candidate) -> None:
        """Update the belief about a candidate."""
        candidate.judge(self._model)

    def _find(self, topology: TopologicalMap, frontiers: FrontierMap) -> list[Candidate]:
        nodes = [node for node in topology.nodes.values() if node.kind == NodeKind.END]
        places = np.array([(node.x, node.y) for node in nodes]).reshape(-1, 2)
        owned: list[list[Cells]] = [[] for _ in nodes]
        own: list[Cells] = []
        clusters = frontiers.clusters(self._config.min_frontier_size)
        for cells, owner in zip(clusters, self._owners(frontiers, clusters, places), strict=True):
            (own if owner < 0 else owned[owner]).append(cells)
        found = [np.vstack(parts) if parts else _NO_CELLS for parts in owned] + own
        at = [(node.x, node.y) for node in nodes] + [frontiers.middle_of(cells) for cells in own]
        evidence = self.store.follow(at, self._config.node_reset_distance_m)
        ids = [node.id for node in nodes] + [item.id for item in evidence[len(nodes) :]]
        return [
            Candidate(i, place, cells, frontiers.middle_of(cells) if len(cells) else place, item)
            for i, place, cells, item in zip(ids, at, found, evidence, strict=True)
        ]

    def _owners(self, frontiers: FrontierMap, clusters: list[Cells], nodes: Array) -> list[int]:
        """Index of the nearest end node (N, 2), m, that sees each frontier's middle; -1: none."""
        middles = np.array([frontiers.middle_of(cells) for cells in clusters]).reshape(-1, 2)
        frame = frontiers.frame
        owners: list[int] = _nearest_in_sight(
            frontiers.free,
            middles,
            nodes,
            frame.cells_of(middles),
            frame.cells_of(nodes),
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
        candidate.hidden_m2 = frontiers.hidden_area_m2(candidate.middle, HIDDEN_REACH_M)
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
    if not len(candidate.cells):
        return not len(known.cells)
    same = len(known.cells) == len(candidate.cells) and known.middle == candidate.middle
    away_m = math.dist(candidate.middle, T_map_base[:2])
    renew_s = max(_RENEW_S, _RENEW_S_M * away_m)
    recent = 0 <= stamp_ns - known.examined_ns < renew_s * SECOND_NS
    if not (same and recent and known.examined_ns >= 0):
        return False
    candidate.goal = known.goal
    candidate.hidden_m2 = known.hidden_m2
    candidate.examined_ns = known.examined_ns
    candidate.is_enclosed = known.is_enclosed
    return True


def _facing(place: Place, towards: Place) -> Array:
    """Pose (3,) at a place, with another one ahead."""
    return se2.pose(*place, math.atan2(towards[1] - place[1], towards[0] - place[0]))
