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
from scipy.spatial.distance import cdist

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.exploration.belief import (
    SAME_M,
    WORTH_SEEING_M2,
    BeliefModel,
    Evidence,
    EvidenceStore,
    Hidden,
    MissingArea,
    fringe_m2,
    missing_area,
)
from thinmap_ros.core.exploration.space import FrontierMap, search_beside
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID, EndNode, unobserved
from thinmap_ros.core.exploration.views import NO_VIEW, Sight, View, ViewFinder, sees_walls
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.planning.travel_times import Arrivals, TravelTimes
from thinmap_ros.core.se2 import Array, Cells, Mask, Place
from thinmap_ros.core.topology.graph import Node, NodeKind, TopologicalMap

SETTLED = 0.999  # probability of an end node without a frontier
# A frontier belongs to the nearest end node in sight within this distance; without
# one it is a candidate of its own.
ASSIGNMENT_RADIUS_M = 3.0


@dataclass(frozen=True)
class CandidateConfig(Config):
    """Which frontiers count, and which are worth a visit."""

    # The name of explore_lite's parameter.
    min_frontier_size: float = parameter(
        0.2,
        'Shorter frontiers are ignored (m). Raise it for shorter paths, lower it for higher '
        'coverage.',
        low=0.0,
        high=5.0,
    )
    probability_threshold: float = parameter(
        0.9,
        'An end node with at least this position probability is not visited. Raise it for higher '
        'coverage, lower it for shorter paths.',
        low=0.5,
        high=0.999,
    )


@dataclass(eq=False)
class Candidate:
    """A frontier that may hide unknown space, with the belief about it.

    cells (N, 2): of the frontier; middle (x, y), m: of these cells; end_node: of the topological
    map, to which the frontier belongs; goal (3,): viewpoint, None
    where none can be reached, or none is needed; seconds: until the robot is there; view: from
    where what it hides is seen; probability: that nothing worth seeing is behind; area_m2: if there
    is.
    """

    evidence: Evidence
    cells: Cells
    middle: Place
    end_node: Node | None = None
    length_m: float = 0.0
    goal: Array | None = None
    seconds: float = math.inf
    view: View = NO_VIEW
    probability: float = 0.5
    area_m2: float = 0.0

    @property
    def node_id(self) -> int:
        """Id with which it is published: of its end node, or else its own."""
        return self.evidence.id if self.end_node is None else self.end_node.id

    @property
    def expected_area_m2(self) -> float:
        """Area that is hidden behind it, as a mean over both cases."""
        return (1.0 - self.probability) * self.area_m2

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

    settled: end nodes without a frontier; missing: free area that the map does not show, behind all
    frontiers, also those that are too short to be candidates.
    """

    def __init__(self, config: CandidateConfig, model: BeliefModel) -> None:
        self._config = config
        self._model = model
        self._views = ViewFinder()
        self.store = EvidenceStore(FIRST_FRONTIER_ID)
        self.candidates: list[Candidate] = []
        self.settled: list[EndNode] = []
        self.missing = MissingArea(0.0, 0.0)

    def update(
        self, topology: TopologicalMap, frontiers: FrontierMap, travel: TravelTimes, sight: Sight
    ) -> None:
        """Find the candidates of a graph and a map, and update the belief about each."""
        clusters = frontiers.clusters(0.0)
        min_length_m = self._config.min_frontier_size
        found = self._find(
            topology, frontiers, [c for c in clusters if frontiers.is_long(len(c), min_length_m)]
        )
        short = [c for c in clusters if not frontiers.is_long(len(c), min_length_m)]
        cells = [*(candidate.cells for candidate in found), *short]
        are_last = [c.evidence.is_last_visit for c in found] + [False] * len(short)
        views = self._views.update(frontiers, travel, cells, sight, are_last)
        for candidate, view in zip(found, views[: len(found)], strict=True):
            self._believe(candidate, view)
        fragments = [
            Candidate(
                Evidence(0, middle), cells, middle, None, len(cells) * frontiers.frame.resolution
            )
            for cells, middle in zip(short, map(frontiers.middle_of, short), strict=True)
        ]
        for fragment, view in zip(fragments, views[len(found) :], strict=True):
            self._believe(fragment, view)
        self.candidates = [c for c in found if not c.view.is_enclosed]
        threshold = self._config.probability_threshold
        below = [c for c in self.candidates if c.probability < threshold]
        self._choose_viewpoints(below or self.candidates, frontiers, travel, sight)
        resolution = frontiers.frame.resolution
        self.missing = missing_area(
            [
                Hidden(c.probability, fringe_m2(c.length_m, resolution), c.area_m2)
                for c in (*found, *fragments)
            ]
        )

    def _choose_viewpoints(
        self, chosen: list[Candidate], frontiers: FrontierMap, travel: TravelTimes, sight: Sight
    ) -> None:
        """Choose from where to observe each candidate.

        A robot without a wall in range goes to where one is, if it can: in a hall that is wider
        than the laser sees, the odometry alone else tells its place all the way.
        """
        places = [candidate.view.cells for candidate in chosen]
        arrivals = travel.arrivals(np.concatenate([NO_VIEW.cells, *places]))
        is_blind = not sees_walls(frontiers, np.array([travel.start]), sight).any()
        end = 0
        for candidate, cells in zip(chosen, places, strict=True):
            part = slice(end, end + len(cells))
            end = part.stop
            own = Arrivals(arrivals.seconds[part], arrivals.headings[part])
            wanted = sees_walls(frontiers, cells, sight) if is_blind else np.ones(len(cells), bool)
            _choose_viewpoint(candidate, frontiers, travel, own, sight.slack_rad, wanted)

    def _find(
        self, topology: TopologicalMap, frontiers: FrontierMap, clusters: list[Cells]
    ) -> list[Candidate]:
        nodes = [node for node in topology.nodes.values() if node.kind == NodeKind.END]
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
        found = [parts[0] if len(parts) == 1 else np.vstack(parts) for parts in owned.values()]
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

    def _believe(self, candidate: Candidate, view: View) -> None:
        """Determine how likely a candidate hides nothing, and how much if it hides something.

        At most what the best place would see, but no less than counts as something: places that
        the map does not show yet may see into a gap into which none sees now.
        """
        candidate.view = view
        candidate.probability = self._model.probability(
            candidate.length_m, view.hidden_m2, view.depth_m, candidate.evidence.visits
        )
        area_m2 = min(view.most_m2, self._model.mean_area(view.hidden_m2))
        candidate.area_m2 = max(area_m2, WORTH_SEEING_M2)


def _choose_viewpoint(
    candidate: Candidate,
    frontiers: FrontierMap,
    travel: TravelTimes,
    arrivals: Arrivals,
    slack_rad: float,
    wanted: Mask,
) -> None:
    """Choose the place that sees most of a frontier for each second that it costs.

    Not one from where a visit showed nothing; for the last visit, it is the one that sees most at
    all. Without such a place, it is the nearest one beside the frontier: from there a passage that
    looks too narrow may turn out to be wide enough.
    arrivals: at the places of its view; slack_rad: angle by which the robot need not turn to what
    it observes; wanted (N,): places that come before the others, but not for the last visit.
    """
    view = candidate.view
    centres = frontiers.frame.centres_of(view.cells)
    is_new = np.isfinite(arrivals.seconds)
    for place in candidate.evidence.seen_from:
        is_new &= np.hypot(*(centres - place).T) > SAME_M
    if not is_new.any():
        _choose_beside(candidate, frontiers, travel)
        return
    if not candidate.evidence.is_last_visit and (is_new & wanted).any():
        is_new &= wanted
    off = se2.wrap(view.directions - arrivals.headings)
    turns = off - np.clip(off, -slack_rad, slack_rad)
    seconds = arrivals.seconds + travel.turn_s(turns)
    worth = view.areas_m2 if candidate.evidence.is_last_visit else view.areas_m2 / seconds
    best = int(np.argmax(np.where(is_new, worth, 0.0)))
    heading = float(arrivals.headings[best] + turns[best])
    x, y = centres[best].tolist()
    candidate.goal = se2.pose(x, y, heading)
    candidate.seconds = float(seconds[best])


def _choose_beside(candidate: Candidate, frontiers: FrontierMap, travel: TravelTimes) -> None:
    """Choose the nearest place beside a frontier, unless a visit there showed nothing."""
    row, col = frontiers.frame.cells_of(np.array([candidate.middle]))[0].tolist()
    steps = int(ASSIGNMENT_RADIUS_M / frontiers.frame.resolution)
    cell = search_beside(frontiers.free, candidate.cells, travel.reachable, steps, (row, col))
    if cell is not None:
        x, y = frontiers.frame.centres_of(np.array([cell]))[0].tolist()
        if not candidate.evidence.was_seen_from((x, y)):
            candidate.goal = se2.pose(x, y, se2.bearing((x, y), candidate.middle))
            candidate.seconds = float(travel.seconds_to(candidate.goal[None])[0])
