"""Which end node next, and when it is finished, and why.

Only end nodes whose position probability is below a threshold are worth a visit. Which of them:

- first the one that the robot faces (section 3.2); afterwards the one with which a good tour
  through all of them begins; in mode `paper`, as there, the one with the least path cost on the
  graph;
- the target is kept until it is resolved, unless another one is better by a clear margin, so that
  nothing oscillates;
- it is dropped as soon as its probability passes the threshold on the way;
- one that cannot be reached is put aside, and tried again after a while and before the end.

Source: exploration paper sections 3.2 and 4.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import parameter
from thinmap_ros.core.exploration.blacklist import Failures
from thinmap_ros.core.exploration.candidates import (
    Candidate,
    Place,
    SurveyConfig,
    Surveyor,
    end_node_of,
)
from thinmap_ros.core.exploration.field_of_view import box_of_scan, directions_of_view
from thinmap_ros.core.exploration.strategy import Decision, finish_reason
from thinmap_ros.core.exploration.tour import tours_by_first
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.graph_search import path_lengths_to_goals
from thinmap_ros.core.planning.grid_search import PathLengthTable
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import Field
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap

_DETOUR = 3.0
_SUCCESSOR_M = 1.5
_NEAR_VISIT_M = 0.3
_NEAR_HEADING_RAD = 0.35
_STEADY_RAD = 0.6
_COARSE_M = 0.3
_FORGET_S = 20.0
_UNKNOWN_WEIGHT = 2
_FIRST_GRAPH_S = 5.0
# Through more places no tour is planned at a time: its cost grows with their number's fourth power.
_MOST_PLACES = 20
_LOOKS = 3
FIELDS = {'first_choice_made': Field(np.bool_)}


@dataclass(frozen=True)
class ExplorerConfig(SurveyConfig):
    """What is worth a visit, and how steady a choice is."""

    probability_threshold: float = parameter(
        0.9,
        'An end node with at least this position probability is not visited. Raise it for higher '
        'coverage, lower it for shorter paths.',
        low=0.5,
        high=0.999,
    )
    small_frontier_m: float = parameter(
        1.5,
        'Frontiers up to this length are assumed to hide little (m). Raise it to leave more of '
        'them for later.',
        low=0.0,
        high=50.0,
    )
    waiting_cost: float = parameter(
        0.5,
        'Tour cost per metre for which a frontier stays unvisited. Raise it to finish near '
        'frontiers first.',
        low=0.0,
        high=10.0,
    )
    small_frontier_waiting_cost: float = parameter(
        2.0,
        'Tour cost per metre for which a small frontier stays unvisited. Raise it to finish small '
        'ones in passing.',
        low=0.0,
        high=10.0,
    )
    waiting_horizon_m: float = parameter(
        15.0,
        'Tour length beyond which waiting costs nothing more (m). Lower: greedier.',
        low=0.0,
        high=1e3,
    )
    exhaustion_range_m: float = parameter(
        2.0,
        'A frontier observed from nearer than this without change is exhausted (m). Lower it if '
        'openings are given up too soon.',
        low=0.0,
        high=50.0,
    )
    turn_cost_m_rad: float = parameter(
        0.2,
        'Path length that a turn by one radian is worth (m/rad). Raise it for a robot that turns '
        'slowly.',
        low=0.0,
        high=10.0,
    )
    switch_margin_ratio: float = parameter(
        0.1,
        'Smallest saving for which the target is changed, relative to its cost. Raise it if the '
        'robot oscillates.',
        low=0.0,
        high=1.0,
    )
    switch_margin_m: float = parameter(
        2.0,
        'Smallest saving for which the target is changed (m). Raise it if the robot oscillates.',
        low=0.0,
        high=100.0,
    )
    blacklist_timeout_s: float = parameter(
        60.0,
        'Time after which an unreachable target is tried again (s). Lower it where people block '
        'doors.',
        low=0.0,
        high=1e5,
    )
    candidate_period_s: float = parameter(
        1.0,
        'Period at which frontiers are assigned and candidates are found (s). Raise it to save '
        'time.',
        low=0.0,
        high=60.0,
    )
    expected_depth_m: float = parameter(
        2.0,
        'Depth of unknown space that is assumed behind a frontier in coverage_estimate (m).',
        low=0.0,
        high=50.0,
    )


@dataclass(frozen=True)
class _Survey:
    """Candidates, when they were found, and on what.

    On what: the state of the borders and the places of the end nodes.
    """

    candidates: list[Candidate]
    stamp_ns: int
    revision: int
    ends: dict[int, Place]


@dataclass
class _Memory:
    """The target, its border's place, where it is looked at from, and how long all has been so."""

    target: int | None = None
    target_at: Place = (math.inf, math.inf)
    goal: Array = field(default_factory=lambda: np.full(3, np.inf))
    first_choice_made: bool = False
    at_goal: int = 0
    nothing_left: int = 0


class Explorer:
    """Chooses targets scan by scan until every end node is reliable."""

    def __init__(self, config: ExplorerConfig | None = None) -> None:
        self.config = config or ExplorerConfig()
        self.surveyor = Surveyor(self.config)
        self._failures = Failures(self.config.blacklist_timeout_s)
        self._ways = PathLengthTable(_COARSE_M, _FORGET_S, _UNKNOWN_WEIGHT)
        self._memory = _Memory()
        self._stamp_ns = 0
        self._began_ns = 2**63
        self._range_m = 0.0
        self._last = _Survey([], 0, -1, {})

    def state(self) -> dict[str, NDArray[Any]]:
        """What the exploration has learned, as arrays by name.

        These are probabilities, and which borders show nothing more.
        What could not be reached is left out: it is worth another try.
        """
        return self.surveyor.state() | {
            'first_choice_made': np.array(self._memory.first_choice_made)
        }

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: ExplorerConfig | None = None
    ) -> 'Explorer':
        """Explorer that goes on from another's `state`, with the map and graph that belong to it.

        Raises InputError where it is no such state.
        """
        explorer = Explorer(config)
        own = {key: array for key, array in state.items() if key in FIELDS}
        checked = snapshot.validate(own, FIELDS, 'exploration')
        explorer.surveyor.restore({key: state[key] for key in state if key not in FIELDS})
        explorer._memory.first_choice_made = bool(checked['first_choice_made'])
        return explorer

    def step(
        self, topology: TopologicalMap, patch: GridPatch, scan: Scan, T_map_base: Array
    ) -> Decision:
        """Take in the graph, the map and a scan made at a pose (3,); say where to go.

        patch: the whole map, on one lattice from step to step. Deterministic; call it once a scan.
        """
        self._stamp_ns = scan.stamp_ns
        self._range_m = scan.range_max_m
        self._began_ns = min(self._began_ns, self._stamp_ns)
        surveyor = self.surveyor
        borders = self.surveyor.borders
        surveyor.trail.add_pose(T_map_base)
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        borders.update(patch, box_of_scan(scan, T_map_base))
        borders.examine(xy, self.config.exhaustion_range_m, directions_of_view(scan, T_map_base))
        candidates = self._candidates(topology, T_map_base, scan.range_max_m)
        open_ids = {c.track.node_id for c in candidates}
        for tracker in (surveyor.tracker, surveyor.stand_ins):
            tracker.look(scan, T_map_base, borders.free, borders.frame, open_ids)
        worth = {
            c.track.node_id: c
            for c in candidates
            if c.track.probability < self.config.probability_threshold
        }
        self._give_up_what_was_examined(worth, T_map_base)
        target = self._choose(topology, worth, T_map_base)
        return self._decision(target, worth, candidates)

    def target_failed(self, reason: str) -> None:
        """Hear that the present target could not be reached; it is put aside for a while."""
        target = self._memory.target
        track = None if target is None else self.surveyor.track(target)
        if track is not None:
            self._failures.add((track.x, track.y), self._stamp_ns)
            self._memory.target = None

    def frontiers(self) -> list[Array]:
        """Cells of each frontier of the last survey that is worth a visit, (N, 2), m, map frame."""
        frame = self.surveyor.borders.frame
        return [frame.centres_of(c.cells) for c in self._last.candidates if len(c.cells)]

    def _candidates(
        self, topology: TopologicalMap, T_map_base: Array, range_m: float
    ) -> list[Candidate]:
        """A survey of all borders now and then, and when the target is gone.

        In between, what is left of the last.
        """
        surveyor = self.surveyor
        borders = self.surveyor.borders
        memory = self._memory
        last = self._last
        end = NodeKind.END
        ends = {n.id: (n.x, n.y) for n in topology.nodes.values() if n.kind == end}
        renamed = surveyor.follow(ends)
        memory.target = renamed.get(memory.target or 0, memory.target)
        same = last.revision == borders.revision and last.ends == ends
        recent = same or self._stamp_ns - last.stamp_ns < self.config.candidate_period_s * 1e9
        if surveyor.frame == borders.frame and recent:
            left = last.candidates
            if not same:
                left = [c for c in map(surveyor.still_open, left) if c is not None]
            if any(c.track.node_id == memory.target for c in left):
                return left
        candidates = surveyor.survey(T_map_base, range_m)
        self._last = _Survey(candidates, self._stamp_ns, borders.revision, ends)
        return candidates

    def _give_up_what_was_examined(self, worth: dict[int, Candidate], T_map_base: Array) -> None:
        """A target that stays open although the robot is there and looks shows nothing more."""
        memory = self._memory
        candidate = worth.get(memory.target) if memory.target is not None else None
        if candidate is None or not _is_at(T_map_base, memory.goal):
            memory.at_goal = 0
            return
        memory.at_goal += 1
        if memory.at_goal >= _LOOKS:
            memory.at_goal = 0
            self.surveyor.examined(candidate, T_map_base)
            del worth[candidate.track.node_id]
            memory.target = None

    # Which of them is the target.

    def _choose(
        self, topology: TopologicalMap, worth: dict[int, Candidate], T_map_base: Array
    ) -> int | None:
        memory = self._memory
        ids = self._failures.to_try({i: c.place for i, c in worth.items()}, self._stamp_ns)
        open_to_try = {i: c for i, c in worth.items() if i in ids}
        waits = any(self._failures.may_try_again(c.place) for c in worth.values())
        # The first scans are not a map yet, and not a graph.
        waits |= self.surveyor.borders.known_cells == 0
        waits |= not topology.nodes and self._stamp_ns - self._began_ns < _FIRST_GRAPH_S * 1e9
        memory.nothing_left = 0 if open_to_try or waits else memory.nothing_left + 1
        if not open_to_try:
            memory.target = None
            return None
        if memory.target in open_to_try and self._last.stamp_ns != self._stamp_ns:
            # Costs are weighed anew once a survey.
            return self._go_for(open_to_try[memory.target], T_map_base)
        if not memory.first_choice_made:
            memory.first_choice_made = True
            faced = min(open_to_try, key=lambda i: _turn_to(T_map_base, open_to_try[i].goal))
            return self._go_for(open_to_try[faced], T_map_base)
        costs = self._costs(topology, open_to_try, T_map_base)
        if memory.target not in costs:
            memory.target = self._successor(open_to_try)
            if memory.target is not None and memory.target not in costs:
                costs = self._costs(topology, open_to_try, T_map_base)  # it is none of the nearest
        best = min(costs, key=lambda i: costs[i])
        kept = memory.target
        if kept is None or costs[best] < costs[kept] - self._margin(costs[kept]):
            memory.target = kept = best
        return self._go_for(open_to_try[kept], T_map_base)

    def _margin(self, cost: float) -> float:
        """What another target must save, m.

        Plans change with every scan, and whoever turns back gains nothing.
        """
        return max(self.config.switch_margin_m, self.config.switch_margin_ratio * cost)

    def _go_for(self, chosen: Candidate, T_map_base: Array) -> int:
        """Make a candidate the target.

        Until the robot is there its goal stays, if it is still about the same border.
        Borders change hands between nodes from one survey to the next, and the place to look at
        them from with that.
        """
        memory = self._memory
        at = self.surveyor.border_of(chosen)
        same = math.dist(at, memory.target_at) <= _SUCCESSOR_M and (
            math.dist(chosen.goal[:2], memory.goal[:2]) <= _SUCCESSOR_M
            or self.surveyor.still_shows(chosen, memory.goal, self._range_m)
        )
        on_the_way = same and math.dist(T_map_base[:2], memory.goal[:2]) > _NEAR_VISIT_M
        memory.target = chosen.track.node_id
        memory.target_at = at
        if not (on_the_way or _about_same(chosen.goal, memory.goal)):
            memory.goal = chosen.goal
        return chosen.track.node_id

    def _successor(self, worth: dict[int, Candidate]) -> int | None:
        """Where the target vanished, whose border is now nearest to the one that it stood for."""
        at = self._memory.target_at
        away = {
            i: math.dist(at, self.surveyor.border_of(candidate)) for i, candidate in worth.items()
        }
        near = min(away, key=lambda i: away[i])
        return near if away[near] <= _SUCCESSOR_M else None

    def _costs(
        self, topology: TopologicalMap, worth: dict[int, Candidate], T_map_base: Array
    ) -> dict[int, float]:
        """What is compared of the candidates, m: see the modes above.

        A turn on the spot counts as well.
        """
        turn_cost = {
            i: self.config.turn_cost_m_rad * _first_turn(T_map_base, c.goal)
            for i, c in worth.items()
        }
        if self.config.mode == 'frontier':
            return self._tours(worth, turn_cost, T_map_base)
        ways = path_lengths_to_goals(topology, T_map_base, {i: c.goal for i, c in worth.items()})
        straight = {i: math.dist(c.goal[:2], T_map_base[:2]) for i, c in worth.items()}
        return {i: turn_cost[i] + ways.get(i, _DETOUR * straight[i]) for i in worth}

    def _tours(
        self, worth: dict[int, Candidate], turn_cost: dict[int, float], T_map_base: Array
    ) -> dict[int, float]:
        """Cost of the tour through what is left, m, by what comes first.

        Of much, through the target and what is near only.

        From one to the next the way may lead through the unknown, if nothing is known to stand
        there: whoever goes into it here may well come out there, and what would then be left behind
        is better done now.
        """
        surveyor = self.surveyor
        goals = np.array([candidate.goal[:2] for candidate in worth.values()])
        away = np.hypot(*(goals - T_map_base[:2]).T)
        ways = np.array([surveyor.way_m(candidate.goal) for candidate in worth.values()])
        ways = np.maximum(np.where(np.isfinite(ways), ways, _DETOUR * away), away)
        # A stable sort, so that of equally near ones the older stays.
        pairs = zip(worth, ways, strict=True)
        near = dict(sorted(pairs, key=lambda pair: (pair[0] != self._memory.target, pair[1])))
        ids = list(near)[:_MOST_PLACES]
        points = np.array([worth[i].goal[:2] for i in ids])
        straight = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
        table = self._ways.update(
            surveyor.reached, surveyor.maybe, surveyor.frame, points, self._stamp_ns
        )
        between = np.maximum(np.where(np.isfinite(table), table, _DETOUR * straight), straight)
        first = np.array([near[i] + turn_cost[i] for i in ids])
        lengths = np.array([len(worth[i].cells) * surveyor.frame.resolution for i in ids])
        small = lengths < self.config.small_frontier_m
        weights = np.where(small, self.config.small_frontier_waiting_cost, self.config.waiting_cost)
        costs = tours_by_first(first, between, weights, self.config.waiting_horizon_m)
        return dict(zip(ids, costs.tolist(), strict=True))

    # What is told.

    def _decision(
        self, target: int | None, worth: dict[int, Candidate], candidates: list[Candidate]
    ) -> Decision:
        surveyor = self.surveyor
        resolution = self.surveyor.borders.frame.resolution
        by_id = {c.track.node_id: c for c in candidates}
        goals = {} if target is None else {target: self._memory.goal}
        tracks = [*surveyor.tracker.tracks.values(), *surveyor.stand_ins.tracks.values()]
        end_nodes = [
            end_node_of(t, by_id.get(t.node_id), goals.get(t.node_id), resolution) for t in tracks
        ]
        unreachable = sorted(
            i for i, candidate in worth.items() if self._failures.has(candidate.place)
        )
        finished = self._memory.nothing_left >= _LOOKS
        code, reason = finish_reason(finished, unreachable, len(worth))
        known = surveyor.borders.known_cells * resolution**2
        expected = (
            sum(len(c.cells) for c in worth.values()) * resolution * self.config.expected_depth_m
        )
        chosen = next((e for e in end_nodes if e.is_target), None)
        estimate = known / (known + expected) if known > 0.0 else 0.0
        return Decision(chosen, finished, reason, code, end_nodes, unreachable, estimate, known)


def _turn_to(T_map_base: Array, goal: Array) -> float:
    """Size of the turn towards a goal's place, rad."""
    bearing = math.atan2(goal[1] - T_map_base[1], goal[0] - T_map_base[0])
    return abs(se2.wrap(bearing - float(T_map_base[2])))


def _first_turn(T_map_base: Array, goal: Array) -> float:
    """Size of the turn with which the way to a goal begins, rad; 0 where the robot is there."""
    away_m = math.dist(goal[:2], T_map_base[:2])
    return _turn_to(T_map_base, goal) if away_m > _NEAR_VISIT_M else 0.0


def _is_at(T_map_base: Array, goal: Array) -> bool:
    near = math.dist(T_map_base[:2], goal[:2]) <= _NEAR_VISIT_M
    return near and abs(se2.wrap(float(goal[2] - T_map_base[2]))) <= _NEAR_HEADING_RAD


def _about_same(a: Array, b: Array) -> bool:
    """Whether two goals are near enough to each other not to send the robot anew."""
    near = math.dist(a[:2], b[:2]) <= _NEAR_VISIT_M
    return near and abs(se2.wrap(float(a[2] - b[2]))) <= _STEADY_RAD
