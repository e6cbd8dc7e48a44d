"""Candidates: frontiers that may hide unknown space, with the belief about each.

All frontiers of an end node are one candidate: from one viewpoint the robot sees them all. Unknown
space that no end node sees, such as a niche that the skeleton does not reach into, is a candidate
of its own. Specks of free cells behind a wall, from beams that noise moved across it, have
frontiers, too: they are no candidates.
"""

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter, robot_radius
from thinmap_ros.core.exploration.belief import BeliefModel, Evidence, EvidenceStore
from thinmap_ros.core.exploration.space import (
    FrontierMap,
    Reachable,
    depth_behind_m,
    hidden_area_m2,
    place_for,
    search_beside,
)
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID, EndNode, unobserved
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.se2 import SECOND_NS, Array, Cell, Cells, Place
from thinmap_ros.core.topology.graph import Node, NodeKind, TopologicalMap

SETTLED = 0.999  # probability of an end node without a frontier
_RIM_M = 0.5  # at the end of its range the laser sees little
_NEAR_M = 1.5
# A frontier belongs to the nearest end node in sight within this distance; without
# one it is a candidate of its own.
ASSIGNMENT_RADIUS_M = 3.0
# Depth behind a frontier that a viewpoint must be able to see: more leads closer to the middle of
# openings.
_VIEW_DEPTH_M = 2.0
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

    @property
    def expected_area_m2(self) -> float:
        """Area that is hidden behind it, as a mean over both cases."""
        return (1.0 - self.probability) * self.mean_area_m2

    def published(self, target_goal: Array | None) -> EndNode:
        """End node of a decision; target_goal (3,): where the robot drives if it is the target."""
        node = self.end_node
        place = self.middle if node is None else (node.x, node.y)
        return unobserved(
            self.node_id,
            place,
            self.probability,
            self.goal if target_goal is None else target_goal,
            target_goal is not None,
            self.length_m,
            self.expected_area_m2,
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
        found = []
        for new in self._find(topology, frontiers):
            known = before.get(id(new.evidence))
            if known is not None and _is_as_it_was(new, known, stamp_ns, T_map_base):
                known.cells = new.cells
                known.end_node = new.end_node
                found.append(known)
            else:
                self._examine(new, frontiers, reachable, range_max_m)
                new.examined_ns = stamp_ns
                found.append(new)
        for candidate in found:
            candidate.probability = self._model.probability(
                candidate.length_m,
                candidate.hidden_m2,
                candidate.depth_m,
                candidate.evidence.visits,
            )
            candidate.mean_area_m2 = self._model.mean_area(candidate.hidden_m2)
        self._found = found
        self.candidates = [c for c in found if not c.is_enclosed]

    def _find(self, topology: TopologicalMap, frontiers: FrontierMap) -> list[Candidate]:
        nodes = [node for node in topology.nodes.values() if node.kind == NodeKind.END]
        clusters = frontiers.clusters(self._config.min_frontier_size)
        middles = [frontiers.middle_of(cells) for cells in clusters]
        owners = self._owners(frontiers, middles, nodes)
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

    def _owners(self, frontiers: FrontierMap, middles: list[Place], nodes: list[Node]) -> list[int]:
        """Index of the nearest end node that sees the middle of each frontier; -1: none."""
        points = np.array(middles).reshape(-1, 2)
        places = np.array([(node.x, node.y) for node in nodes]).reshape(-1, 2)
        at = frontiers.frame.cells_of(places)
        cells = frontiers.frame.cells_of(points)
        away_m = cdist(points, places)
        pairs = np.argwhere(away_m <= ASSIGNMENT_RADIUS_M)
        owners = [-1] * len(middles)
        for i, k in pairs[away_m[tuple(pairs.T)].argsort(kind='stable')].tolist():
            if owners[i] < 0 and line_is_clear(frontiers.free, *at[k], *cells[i]):
                owners[i] = k
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
        candidate.goal = None
        candidate.is_enclosed = False
        has_view = False
        for cell in self._views(candidate, frontiers, reachable, range_max_m):
            has_view = True
            if _drives_to(candidate, cell, frontiers):
                return
        beside, is_enclosed = self._beside(candidate, frontiers, reachable)
        if beside is None or not _drives_to(candidate, beside, frontiers):
            candidate.is_enclosed = is_enclosed and not has_view

    def _views(
        self, candidate: Candidate, frontiers: FrontierMap, reachable: Reachable, range_max_m: float
    ) -> Iterator[Cell]:
        """Cells that see behind a frontier, the best one first."""
        resolution = frontiers.frame.resolution
        views = [(range_max_m - _RIM_M, _VIEW_DEPTH_M), (_NEAR_M, 0.0)]
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
                yield cell

    def _beside(
        self, candidate: Candidate, frontiers: FrontierMap, reachable: Reachable
    ) -> tuple[Cell | None, bool]:
        """The nearest cell on the way to a frontier, None without one; whether it is enclosed."""
        steps = int(ASSIGNMENT_RADIUS_M / frontiers.frame.resolution)
        row, col = frontiers.frame.cells_of(np.array([candidate.middle]))[0]
        return search_beside(
            frontiers.free,
            candidate.cells,
            reachable.cells,
            reachable.standing,
            steps,
            (int(row), int(col)),
        )


def _drives_to(candidate: Candidate, cell: Cell, frontiers: FrontierMap) -> bool:
    """Make a cell the viewpoint, unless a visit there showed nothing; returns whether it is."""
    x, y = frontiers.frame.centres_of(np.array([cell]))[0].tolist()
    if candidate.evidence.was_seen_from((x, y)):
        return False
    candidate.goal = se2.pose(x, y, se2.bearing((x, y), candidate.middle))
    return True


def _is_as_it_was(new: Candidate, known: Candidate, stamp_ns: int, T_map_base: Array) -> bool:
    """Whether a frontier is the same, and was examined so lately that nothing has changed."""
    age_s = (stamp_ns - known.examined_ns) / SECOND_NS
    is_same = len(known.cells) == len(new.cells) and known.middle == new.middle
    away_m = math.dist(new.middle, T_map_base[:2])
    is_recent = 0.0 <= age_s < max(_RENEW_S, _RENEW_S_M * away_m)
    return is_same and is_recent and known.examined_ns >= 0
