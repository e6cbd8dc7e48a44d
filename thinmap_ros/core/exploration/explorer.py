"""Which end node next, and when it is finished, and why.

Only end nodes whose position probability is below a threshold are worth a visit. Which of them:

- first the one that the robot faces, afterwards the one with the least path cost by A* on the graph (section 3.2);
- the target is kept until it is resolved, unless another one is nearer by a clear margin, so that nothing oscillates;
- it is dropped as soon as its probability passes the threshold on the way;
- one that cannot be reached is put aside, and tried again after a while and before the end.

Unknown space that no end node has in sight (a niche, or a gap that the skeleton does not reach into) is not lost: the
middle of such a border stands in for an end node, with the nearest place that the robot can reach as its goal.
Source: exploration paper sections 3.2 and 4.
"""

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import parameter
from thinmap_ros.core.exploration.end_node_tracker import EndNodeTracker, Track, TrackerConfig
from thinmap_ros.core.exploration.open_borders import OpenBorders, directions_of_view
from thinmap_ros.core.exploration.tour import tours_by_first
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.planning.graph_search import access, costs_from
from thinmap_ros.core.planning.grid_search import WayTable
from thinmap_ros.core.planning.wavefront import nearest_true, places_in_reach
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap

Cells = NDArray[np.int64]
FIRST_STAND_IN_ID = 2_000_000_000
_DETOUR = 3.0
_CHANGED_MARGIN_M = 1.0
_SUCCESSOR_M = 1.5
_NEAR_VISIT_M = 0.3
_ESCAPE_M = 0.6
_NEAR_HEADING_RAD = 0.35
_STEADY_RAD = 0.6
_TRIES = 3
_COARSE_M, _FORGET_S = 0.2, 20.0
_PAUSE_S = 5.0
_FADE = 10.0


class FinishCode(IntEnum):
    """Why an exploration ended, as in thinmap_msgs/ExplorationStatus."""

    NONE = 0
    ALL_RESOLVED = 1
    NOTHING_REACHABLE = 4


@dataclass(frozen=True)
class ExplorerConfig(TrackerConfig):
    """What is worth a visit, and how steady a choice is."""

    threshold: float = parameter(0.9, 'an end node as probable as this needs no visit', low=0.5, high=0.999)
    robot_radius_m: float = parameter(0.25, 'radius of the robot, m', low=0.0, high=5.0)
    small_border_m: float = parameter(1.5, 'behind a shorter border not much is expected, m', low=0.0, high=50.0)
    wait_weight: float = parameter(0.5, 'cost of a metre until a target is reached, m', low=0.0, high=10.0)
    small_wait_weight: float = parameter(2.0, 'the same, for one with a small border', low=0.0, high=10.0)
    wait_m: float = parameter(15.0, 'a target farther off than this along the tour waits no more, m', low=0.0, high=1e3)
    shortest_border_m: float = parameter(0.5, 'a shorter border is a missing beam, m', low=0.0, high=5.0)
    attach_m: float = parameter(3.0, 'a border belongs to an end node in sight within this, m', low=0.1, high=50.0)
    close_look_m: float = parameter(2.0, 'unknown in plain sight this near stays unknown, m', low=0.0, high=50.0)
    turn_cost_m_rad: float = parameter(0.2, 'path length that a turn by one radian costs, m', low=0.0, high=10.0)
    switch_share: float = parameter(0.1, 'and this share of it', low=0.0, high=1.0)
    switch_m: float = parameter(2.0, 'another target must save this much of the way, m', low=0.0, high=100.0)
    retry_s: float = parameter(60.0, 'a target that failed is tried again after this time, s', low=0.0, high=1e5)
    survey_s: float = parameter(1.0, 'borders are assigned anew after this time, s', low=0.0, high=60.0)
    behind_m: float = parameter(2.0, 'depth of unknown space expected behind a border, m', low=0.0, high=50.0)


@dataclass(frozen=True)
class EndNode:
    """An end node as it stands: place x, y in m (map frame), probability and what it comes from.

    goal: pose (3,) from which to look at it; open_border_m: length of the border to the unknown that belongs to it.
    """

    node_id: int
    x: float
    y: float
    probability: float
    distance_index: float
    angle_index: float
    smallest_distance_m: float
    angle_span_deg: float
    open_border_m: float
    is_target: bool
    goal: Array


@dataclass(frozen=True)
class Decision:
    """What to do now: drive to target.goal, or nothing more.

    reason: words for the end, or for what is going on; unreachable: ids put aside because they could not be reached;
    coverage_estimate: known free area over that and the area expected behind open borders, 0 to 1.
    """

    target: EndNode | None
    finished: bool
    reason: str
    code: FinishCode
    end_nodes: list[EndNode]
    unreachable: list[int]
    coverage_estimate: float
    known_area_m2: float


@dataclass
class _Candidate:
    """A place worth a visit: the border cells that belong to it, and the pose (3,) from which to look at it."""

    track: Track
    cells: Cells
    goal: Array


@dataclass(frozen=True)
class _Survey:
    frame: GridFrame
    stamp_ns: int
    candidates: list[_Candidate]


@dataclass
class _Failure:
    at: tuple[float, float]
    stamp_ns: int
    times: int = 0


@dataclass
class _Memory:
    """What outlasts a scan: the target, places that failed, and end nodes that were visited without success."""

    target: int | None = None
    target_at: tuple[float, float] = (math.inf, math.inf)
    goal: Array = field(default_factory=lambda: np.full(3, np.inf))
    first_choice_made: bool = False
    failed: list[_Failure] = field(default_factory=list)
    visited: dict[int, tuple[float, float]] = field(default_factory=dict)
    at_goal: int = 0
    nothing_left: int = 0
    next_stand_in: int = FIRST_STAND_IN_ID


class Explorer:
    """Chooses targets scan by scan until every end node is reliable."""

    def __init__(self, config: ExplorerConfig | None = None) -> None:
        self.config = config or ExplorerConfig()
        self.tracker = EndNodeTracker(self.config)
        self.borders = OpenBorders(self.config.shortest_border_m)
        self._stand_ins = EndNodeTracker(self.config)
        self._reached = self.borders.mask
        self._ways = WayTable(_COARSE_M, _FORGET_S)
        self._memory = _Memory()
        self._stamp_ns, self._began_ns = 0, 2**63
        self._last_survey = _Survey(self.borders.frame, 0, [])

    def step(self, topology: TopologicalMap, patch: GridPatch, scan: Scan, T_map_base: Array) -> Decision:
        """Take in the graph, the map and a scan made at a pose (3,); say where to go.

        patch: the whole map, on one lattice from step to step. Deterministic; call it once a scan.
        """
        self._stamp_ns = scan.stamp_ns
        self._began_ns = min(self._began_ns, self._stamp_ns)
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        self.borders.update(patch, xy, scan.range_max_m + 0.5)
        self.borders.examine(xy, self.config.close_look_m, directions_of_view(scan, T_map_base))
        candidates = self._candidates(topology, T_map_base)
        open_ids = {c.track.node_id for c in candidates}
        self.tracker.look(scan, T_map_base, self.borders.free, patch.frame, open_ids)
        self._stand_ins.look(scan, T_map_base, self.borders.free, patch.frame, open_ids)
        worth = self._worth_a_visit(candidates)
        self._give_up_what_was_examined(worth, T_map_base)
        target = self._choose(topology, worth, T_map_base)
        return self._decision(target, worth, candidates, patch)

    def fail_target(self, reason: str) -> None:
        """Hear that the present target could not be reached; it is put aside for a while."""
        target = self._memory.target
        track = None if target is None else self._track(target)
        if target is None or track is None:
            return
        failure = self._failure_of(track)
        if failure is None:
            failure = _Failure((track.x, track.y), self._stamp_ns)
            self._memory.failed.append(failure)
        failure.times, failure.stamp_ns = failure.times + 1, self._stamp_ns
        self._memory.target = None

    # What there is to choose from.

    def _candidates(self, topology: TopologicalMap, T_map_base: Array) -> list[_Candidate]:
        """A survey of all borders now and then, and when the target is gone; in between what is left of the last."""
        ends = {n.id: (n.x, n.y) for n in topology.nodes.values() if n.kind == NodeKind.END}
        self._rename(self.tracker.follow(ends))
        last = self._last_survey
        if last.frame == self.borders.frame and self._stamp_ns - last.stamp_ns < self.config.survey_s * 1e9:
            left = [c for c in map(self._still_open, last.candidates) if c is not None]
            if any(c.track.node_id == self._memory.target for c in left):
                return left
        self._last_survey = _Survey(self.borders.frame, self._stamp_ns, self._survey(T_map_base))
        return self._last_survey.candidates

    def _still_open(self, candidate: _Candidate) -> _Candidate | None:
        if self._track(candidate.track.node_id) is not candidate.track:
            return None
        cells = candidate.cells[self.borders.mask[candidate.cells[:, 0], candidate.cells[:, 1]]]
        long_enough = len(cells) * self.borders.frame.resolution >= self.config.shortest_border_m - 1e-6
        if not (long_enough or self.config.mode == 'paper'):
            return None
        return _Candidate(candidate.track, cells, candidate.goal)

    def _survey(self, T_map_base: Array) -> list[_Candidate]:
        """End nodes with their borders, and stand-ins for the borders that no end node sees."""
        cells, numbers, _ = self.borders.stretches()
        self._reached = reached = self._reachable(T_map_base)
        owners = self._without_scraps(self._owners(cells, reached), numbers)
        candidates = []
        for node_id, track in self.tracker.tracks.items():
            own = cells[owners == node_id]
            if len(own) or (self.config.mode == 'paper' and node_id not in self._memory.visited):
                candidates.append(_Candidate(track, own, self._goal_at(track, own, T_map_base)))
        return candidates + self._stand_in(cells[owners < 0], numbers[owners < 0], reached, T_map_base)

    def _rename(self, renamed: dict[int, int]) -> None:
        """What is remembered of a node goes with it when it gets another id."""
        memory = self._memory
        memory.target = renamed.get(memory.target or 0, memory.target)
        memory.visited = {renamed.get(i, i): place for i, place in memory.visited.items()}

    def _owners(self, cells: Cells, reached: NDArray[np.bool_]) -> Cells:
        """Id of the end node to which each border cell belongs, or -1.

        Not one that was visited in vain, nor one to which the robot cannot get: the graph remembers a passage that the
        map, as it is now, no longer shows.
        """
        memory = self._memory
        for node_id, place in list(memory.visited.items()):
            track = self.tracker.tracks.get(node_id)
            if track is None or math.dist(place, (track.x, track.y)) > self.config.moved_m:
                del memory.visited[node_id]
        ids = np.array([i for i in self.tracker.tracks if self._can_own(i, reached)], dtype=np.int64)
        if ids.size == 0 or len(cells) == 0:
            return np.full(len(cells), -1, dtype=np.int64)
        places = np.array([(self.tracker.tracks[int(i)].x, self.tracker.tracks[int(i)].y) for i in ids])
        index = self.borders.owners(cells, self.borders.frame.cells_of(places), self.config.attach_m)
        return np.where(index < 0, -1, ids[index])

    def _without_scraps(self, owners: Cells, numbers: Cells) -> Cells:
        """Owners (N,) of border cells, such that no owner holds less of a stretch than would count as a border.

        Such a scrap goes to whoever holds most of the stretch: it would be a target that is none at the next scan.
        """
        fewest = round(self.config.shortest_border_m / self.borders.frame.resolution)
        owners = owners.copy()
        for number in np.unique(numbers):
            where = np.flatnonzero(numbers == number)
            ids, inverse, counts = np.unique(owners[where], return_inverse=True, return_counts=True)
            scraps = counts[inverse] < fewest
            owners[where[scraps]] = ids[counts.argmax()]
        return owners

    def _can_own(self, node_id: int, reached: NDArray[np.bool_]) -> bool:
        if node_id in self._memory.visited:
            return False
        track = self.tracker.tracks[node_id]
        row, col = (int(v) for v in self.borders.frame.cells_of(np.array([[track.x, track.y]]))[0])
        return nearest_true(reached, (row, col), _NEAR_VISIT_M / self.borders.frame.resolution) is not None

    def _stand_in(
        self, cells: Cells, numbers: Cells, reached: NDArray[np.bool_], T_map_base: Array
    ) -> list[_Candidate]:
        """One candidate for each stretch of border left over that can be looked at from somewhere."""
        found: list[tuple[Cells, Array]] = []
        if len(cells) and self.config.mode == 'open_border':
            xy = (float(T_map_base[0]), float(T_map_base[1]))
            for number in np.unique(numbers):
                stretch = cells[numbers == number]
                place = self.borders.place_to_look(stretch, reached, self.config.attach_m, xy)
                if place is not None:
                    found.append((stretch, place))
        middles = [self._middle(stretch) for stretch, _ in found]
        ids = self._ids_of_stand_ins(middles)
        self._stand_ins.follow(dict(zip(ids, middles, strict=True)))
        return [
            _Candidate(self._stand_ins.tracks[i], stretch, _facing(goal, middle))
            for i, middle, (stretch, goal) in zip(ids, middles, found, strict=True)
        ]

    def _reachable(self, T_map_base: Array) -> NDArray[np.bool_]:
        """Cells on which the robot can stand and to which it can get."""
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        return places_in_reach(self.borders.free, self.borders.frame, xy, self.config.robot_radius_m, _ESCAPE_M)

    def _ids_of_stand_ins(self, middles: list[tuple[float, float]]) -> list[int]:
        """Each keeps the id of the nearest earlier one within a metre; no id is given twice."""
        free = dict(self._stand_ins.tracks)
        ids = []
        for middle in middles:
            near = min(free.values(), key=lambda t: math.dist(middle, (t.x, t.y)), default=None)
            if near is not None and math.dist(middle, (near.x, near.y)) <= _CHANGED_MARGIN_M:
                ids.append(near.node_id)
                del free[near.node_id]
            else:
                ids.append(self._memory.next_stand_in)
                self._memory.next_stand_in += 1
        return ids

    def _middle(self, stretch: Cells) -> tuple[float, float]:
        """The cell of a stretch nearest to its centre of gravity, in m."""
        cell = stretch[np.square(stretch - stretch.mean(axis=0)).sum(axis=1).argmin()]
        x, y = self.borders.frame.centres_of(cell[None])[0]
        return float(x), float(y)

    def _goal_at(self, track: Track, own: Cells, T_map_base: Array) -> Array:
        """At the end node, looking at the border that belongs to it; without one, on in the direction of approach."""
        if len(own):
            return _facing(np.array([track.x, track.y]), self._middle(own))
        return se2.pose(track.x, track.y, math.atan2(track.y - T_map_base[1], track.x - T_map_base[0]))

    # What is worth a visit, and which visit.

    def _track(self, node_id: int) -> Track | None:
        return self.tracker.tracks.get(node_id) or self._stand_ins.tracks.get(node_id)

    def _worth_a_visit(self, candidates: list[_Candidate]) -> dict[int, _Candidate]:
        return {c.track.node_id: c for c in candidates if c.track.probability < self.config.threshold}

    def _give_up_what_was_examined(self, worth: dict[int, _Candidate], T_map_base: Array) -> None:
        """A target that stays open although the robot stands there and looks at it has nothing more to show.

        An end node then owns no border any more, and what is left of it gets a stand-in with a place nearer to it; the
        border of a stand-in is exhausted.
        """
        memory = self._memory
        candidate = worth.get(memory.target) if memory.target is not None else None
        if candidate is None or not _is_at(T_map_base, memory.goal):
            memory.at_goal = 0
            return
        memory.at_goal += 1
        if memory.at_goal < 3:
            return
        memory.at_goal = 0
        node_id = candidate.track.node_id
        if node_id >= FIRST_STAND_IN_ID:
            self.borders.exhaust(candidate.cells, (float(T_map_base[0]), float(T_map_base[1])))
        else:
            memory.visited[node_id] = (candidate.track.x, candidate.track.y)
        del worth[node_id]
        memory.target = None

    def _choose(self, topology: TopologicalMap, worth: dict[int, _Candidate], T_map_base: Array) -> int | None:
        memory = self._memory
        open_to_try = self._to_try(worth)
        waits = any(failure.times < _TRIES for failure in map(self._failure_of_candidate, worth.values()) if failure)
        # The first scans are not a graph yet.
        waits |= not topology.nodes and self._stamp_ns - self._began_ns < _PAUSE_S * 1e9
        memory.nothing_left = 0 if open_to_try or waits else memory.nothing_left + 1
        if not open_to_try:
            memory.target = None
            return None
        if memory.target in open_to_try and self._last_survey.stamp_ns != self._stamp_ns:
            return self._go_for(open_to_try[memory.target], T_map_base)  # costs are weighed anew once a survey
        costs = (self._tours if self.config.mode == 'open_border' else self._costs)(topology, open_to_try, T_map_base)
        if not memory.first_choice_made:
            memory.first_choice_made = True
            faced = min(open_to_try, key=lambda i: _turn_to(T_map_base, open_to_try[i].goal))
            return self._go_for(open_to_try[faced], T_map_base)
        best = min(costs, key=lambda i: costs[i])
        if memory.target not in costs:
            memory.target = self._successor(open_to_try)
        if memory.target is None or costs[best] < costs[memory.target] - self._margin(costs[memory.target]):
            memory.target = best
        return self._go_for(open_to_try[memory.target], T_map_base)

    def _margin(self, cost: float) -> float:
        """What another target must save, m: plans change with every scan, and whoever turns back gains nothing."""
        return max(self.config.switch_m, self.config.switch_share * cost)

    def _to_try(self, worth: dict[int, _Candidate]) -> dict[int, _Candidate]:
        """Candidates at whose places nothing failed, or a while ago; else, before the end, those that failed least.

        The latter after a pause: a door may be free by then. What failed too often is tried no more, unless so much
        else is left to do that the failure fades from memory.
        """
        failures = {i: self._failure_of_candidate(candidate) for i, candidate in worth.items()}

        def left(pause_s: float) -> dict[int, _Candidate]:
            now, open_to_try = self._stamp_ns, {}
            for i, failure in failures.items():
                if failure is None or (failure.times < _TRIES and now - failure.stamp_ns > pause_s * 1e9):
                    open_to_try[i] = worth[i]
            return open_to_try

        first = left(self.config.retry_s)
        if not first:
            return left(_PAUSE_S)
        fade_ns = _FADE * self.config.retry_s * 1e9
        self._memory.failed = [f for f in self._memory.failed if self._stamp_ns - f.stamp_ns < fade_ns]
        return first

    def _failure_of_candidate(self, candidate: _Candidate) -> _Failure | None:
        return self._failure_of(candidate.track)

    def _failure_of(self, track: Track) -> _Failure | None:
        """What failed at about the place of a track; ids of nodes come and go, places stay."""
        near = min(self._memory.failed, key=lambda f: math.dist(f.at, (track.x, track.y)), default=None)
        return near if near and math.dist(near.at, (track.x, track.y)) <= _CHANGED_MARGIN_M else None

    def _go_for(self, chosen: _Candidate, T_map_base: Array) -> int:
        """Make a candidate the target; until the robot is there its goal stays, if it is still about the same border.

        Borders change hands between nodes from one survey to the next, and the place to look at them from with that.
        """
        memory = self._memory
        at = self._border_of(chosen)
        same = max(math.dist(at, memory.target_at), math.dist(chosen.goal[:2], memory.goal[:2])) <= _SUCCESSOR_M
        on_the_way = same and math.dist(T_map_base[:2], memory.goal[:2]) > _NEAR_VISIT_M
        memory.target, memory.target_at = chosen.track.node_id, at
        if not (on_the_way or _about_same(chosen.goal, memory.goal)):
            memory.goal = chosen.goal
        return chosen.track.node_id

    def _border_of(self, candidate: _Candidate) -> tuple[float, float]:
        """Where the border of a candidate is, m; where the node itself is if it has none."""
        if len(candidate.cells) == 0:
            return candidate.track.x, candidate.track.y
        return self._middle(candidate.cells)

    def _successor(self, worth: dict[int, _Candidate]) -> int | None:
        """Where the target vanished: whose border is now nearest to the one that the target stood for."""
        at = self._memory.target_at
        away = {i: math.dist(at, self._border_of(candidate)) for i, candidate in worth.items()}
        near = min(away, key=lambda i: away[i])
        return near if away[near] <= _SUCCESSOR_M else None

    def _costs(self, topology: TopologicalMap, worth: dict[int, _Candidate], T_map_base: Array) -> dict[int, float]:
        """Path cost to each candidate's goal, m: along the graph, and the first turn."""
        x, y = float(T_map_base[0]), float(T_map_base[1])
        to_nodes = costs_from(topology, x, y)
        costs = {}
        for node_id, candidate in worth.items():
            goal = (float(candidate.goal[0]), float(candidate.goal[1]))
            straight = math.dist(goal, (x, y))
            way = to_nodes.get(node_id) if node_id in topology.nodes else self._way_to(topology, goal, to_nodes)
            if self._in_sight((x, y), goal):
                way = straight
            turn = _turn_to(T_map_base, candidate.goal) if straight > _NEAR_VISIT_M else 0.0
            costs[node_id] = (_DETOUR * straight if way is None else way) + self.config.turn_cost_m_rad * turn
        return costs

    def _tours(self, topology: TopologicalMap, worth: dict[int, _Candidate], T_map_base: Array) -> dict[int, float]:
        """Length of the tour through all that is left, m, by what comes first; a turn on the spot counts as well."""
        ids = list(worth)
        points = np.array([*(worth[i].goal[:2] for i in ids), T_map_base[:2]])
        table = self._ways.update(self._reached, self._last_survey.frame, points, self._stamp_ns)
        straight = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
        table = np.maximum(np.where(np.isfinite(table), table, _DETOUR * straight), straight)
        turns = np.array([_turn_to(T_map_base, worth[i].goal) for i in ids]) * (straight[-1, :-1] > _NEAR_VISIT_M)
        first = table[-1, :-1] + self.config.turn_cost_m_rad * turns
        lengths = np.array([len(worth[i].cells) * self.borders.frame.resolution for i in ids])
        small = lengths < self.config.small_border_m
        weights = np.where(small, self.config.small_wait_weight, self.config.wait_weight)
        return dict(zip(ids, tours_by_first(first, table[:-1, :-1], weights, self.config.wait_m).tolist(), strict=True))

    def _way_to(self, topology: TopologicalMap, goal: tuple[float, float], to_nodes: dict[int, float]) -> float | None:
        joins = access(topology, *goal)
        if joins is None:
            return None
        ways = [to_nodes[i] + rest for i, rest in joins.to_node_m.items() if i in to_nodes]
        return min(ways, default=None)

    def _in_sight(self, a: tuple[float, float], b: tuple[float, float]) -> bool:
        cells = self.borders.frame.cells_of(np.array([a, b]))
        return bool(line_is_clear(self.borders.free, *(int(v) for v in cells.ravel())))

    # What is told.

    def _decision(
        self, target: int | None, worth: dict[int, _Candidate], candidates: list[_Candidate], patch: GridPatch
    ) -> Decision:
        by_id = {c.track.node_id: c for c in candidates}
        resolution = patch.frame.resolution
        tracks = [*self.tracker.tracks.values(), *self._stand_ins.tracks.values()]
        goals = {} if target is None else {target: self._memory.goal}
        end_nodes = [_end_node(t, by_id.get(t.node_id), goals.get(t.node_id), resolution) for t in tracks]
        unreachable = sorted(i for i, candidate in worth.items() if self._failure_of_candidate(candidate))
        finished = self._memory.nothing_left >= 3
        code, reason = _verdict(finished, unreachable, len(worth))
        known = float(np.count_nonzero(self.borders.free)) * resolution**2
        expected = sum(len(c.cells) for c in worth.values()) * resolution * self.config.behind_m
        chosen = next((e for e in end_nodes if e.is_target), None)
        estimate = known / (known + expected) if known > 0.0 else 0.0
        return Decision(chosen, finished, reason, code, end_nodes, unreachable, estimate, known)


def _verdict(finished: bool, unreachable: list[int], left: int) -> tuple[FinishCode, str]:
    if not finished:
        return FinishCode.NONE, f'{left} end nodes left'
    if not unreachable:
        return FinishCode.ALL_RESOLVED, 'all end nodes resolved'
    return FinishCode.NOTHING_REACHABLE, f'{len(unreachable)} end nodes left, none of them reachable'


def _end_node(track: Track, candidate: _Candidate | None, target_goal: Array | None, resolution: float) -> EndNode:
    goal = se2.pose(track.x, track.y, 0.0) if candidate is None else candidate.goal
    return EndNode(
        node_id=track.node_id,
        x=track.x,
        y=track.y,
        probability=track.probability,
        distance_index=track.distance_index,
        angle_index=track.angle_index,
        smallest_distance_m=track.smallest_distance_m,
        angle_span_deg=track.angle_span_deg,
        open_border_m=0.0 if candidate is None else len(candidate.cells) * resolution,
        is_target=target_goal is not None,
        goal=goal if target_goal is None else target_goal,
    )


def _facing(place: Array, towards: tuple[float, float]) -> Array:
    return se2.pose(place[0], place[1], math.atan2(towards[1] - place[1], towards[0] - place[0]))


def _turn_to(T_map_base: Array, goal: Array) -> float:
    """Size of the turn towards a goal's place, rad."""
    return abs(se2.wrap(math.atan2(goal[1] - T_map_base[1], goal[0] - T_map_base[0]) - float(T_map_base[2])))


def _is_at(T_map_base: Array, goal: Array) -> bool:
    near = math.dist(T_map_base[:2], goal[:2]) <= _NEAR_VISIT_M
    return near and abs(se2.wrap(float(goal[2] - T_map_base[2]))) <= _NEAR_HEADING_RAD


def _about_same(a: Array, b: Array) -> bool:
    """Whether two goals are near enough to each other not to send the robot anew."""
    return math.dist(a[:2], b[:2]) <= _NEAR_VISIT_M and abs(se2.wrap(float(a[2] - b[2]))) <= _STEADY_RAD
