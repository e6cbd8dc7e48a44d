"""Exploration by belief: which candidate is next, and when nothing is worth a visit.

- Only candidates are visited whose probability of hiding nothing is below a threshold, as in the
  paper. A candidate is dropped as soon as its probability passes the threshold on the way.
- The next one is that with the shortest path, the turn at its beginning included. A tour through
  all of them saves nothing: what comes to light on the way changes it.
- The target is kept unless another one saves a clear margin, so that the robot does not oscillate.
- A target that stays as it is although the robot observes it is evidence that nothing is hidden.
- What was tried is tried again when its frontier has changed, or once before the end.
- Before the explorer gives up, the robot turns once in place if it stands beside unknown space.
- In a team the candidates are shared by an auction, and the robot chooses among its own.

Source: exploration paper sections 3.2 and 4.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import parameter
from thinmap_ros.core.exploration.belief import evidence
from thinmap_ros.core.exploration.belief.fitted import FITTED
from thinmap_ros.core.exploration.belief.model import WORTH_SEEING_M2, BeliefModel
from thinmap_ros.core.exploration.candidates import Candidate, CandidateConfig, CandidateFinder
from thinmap_ros.core.exploration.frontiers import FrontierMap, Place
from thinmap_ros.core.exploration.look_around import LookAround, turn_target
from thinmap_ros.core.exploration.reachable import ReachableSpace
from thinmap_ros.core.exploration.strategy import Decision, finish_reason
from thinmap_ros.core.exploration.team.claims import SAME_PLACE_M, Claim
from thinmap_ros.core.exploration.team.team import Team
from thinmap_ros.core.exploration.unknown_space import hidden_area_m2
from thinmap_ros.core.exploration.visibility import box_of_scan
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.navigator import NO_PATH
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stamps import SECOND_NS
from thinmap_ros.core.topology.graph import TopologicalMap

_NEAR_M = 0.3
_NEAR_RAD = 0.35
_SAME_PLACE_M = 1.5  # a target whose middle moves less is the same one
_MAX_VISITS = 3  # until a candidate is given up
_MAX_FAILURES = 2
_SCANS = 3  # at the goal, or with nothing left
_GONE_S = 0.35
_START_S = 5.0  # the first scans are no graph yet
_FINAL_PAUSE_S = 40.0  # a navigator that starts, or is blocked by people, refuses goals meanwhile
_MAX_DOUBLINGS = 30


@dataclass(frozen=True)
class ExplorerConfig(CandidateConfig):
    """What is worth a visit, and how the next target is chosen."""

    probability_threshold: float = parameter(
        0.9,
        'An end node with at least this position probability is not visited. Raise it for higher '
        'coverage, lower it for shorter paths.',
        low=0.5,
        high=0.999,
    )
    turn_cost_m_rad: float = parameter(
        0.2,
        'Path length that a turn by one radian is worth (m/rad). Raise it for a robot that turns '
        'slowly.',
        low=0.0,
        high=10.0,
    )
    switch_margin_m: float = parameter(
        2.0,
        'Smallest saving for which the target is changed (m). Raise it if the robot oscillates.',
        low=0.0,
        high=100.0,
    )
    candidate_period_s: float = parameter(
        1.0,
        'Period at which frontiers are assigned and candidates are found (s). Raise it to save '
        'time.',
        low=0.0,
        high=60.0,
    )


@dataclass
class _Target:
    """Where the robot drives: the candidate, the goal (3,), and scans made at the goal.

    is_turn: whether the goal is a part of a turn in place.
    """

    candidate: Candidate | None = None
    middle: Place = (math.inf, math.inf)
    goal: Array | None = None
    scans_at_goal: int = 0
    is_turn: bool = False


@dataclass
class _LeftTargets:
    """How often targets were left for cheaper ones since the robot last saw something new.

    known_area_m2: largest area that was known then; times: by id of the evidence.
    """

    known_area_m2: float = 0.0
    times: Counter[int] = field(default_factory=Counter)

    def update(self, known_area_m2: float) -> None:
        """Forget all if something worth seeing was seen."""
        if known_area_m2 >= self.known_area_m2 + WORTH_SEEING_M2:
            self.known_area_m2 = known_area_m2
            self.times.clear()

    def add(self, evidence_id: int) -> None:
        """Count that a target was left."""
        self.times[evidence_id] += 1

    def factor(self, evidence_id: int) -> float:
        """Factor of the saving for which a target is taken: 2 for each time that it was left."""
        return 2.0 ** min(self.times[evidence_id], _MAX_DOUBLINGS)


@dataclass
class _Clock:
    """Stamps, ns: of the first scan, of this one, and of the last search for candidates."""

    began_ns: int = -1
    now_ns: int = 0
    found_ns: int = -(10**18)


class Explorer:
    """Chooses targets, scan by scan, until no candidate is worth a visit."""

    def __init__(
        self,
        config: ExplorerConfig | None = None,
        model: BeliefModel = FITTED,
        team: Team | None = None,
    ) -> None:
        """team: the robots that explore together; None: this one alone."""
        self.config = config or ExplorerConfig()
        self.team = team or Team()
        self.frontier_map = FrontierMap()
        self._finder = CandidateFinder(self.config, model)
        self._space = ReachableSpace(self.config.robot_radius_m)
        self._target = _Target()
        self._left = _LeftTargets()
        self._look = LookAround()
        self._clock = _Clock()
        self._frame = self.frontier_map.frame
        self._scans_without_target = 0

    @property
    def candidates(self) -> list[Candidate]:
        """Candidates as they were found last."""
        return self._finder.candidates

    def state(self) -> dict[str, NDArray[Any]]:
        """What the exploration has learned, as arrays by name."""
        return self._finder.store.state()

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: ExplorerConfig | None = None
    ) -> 'Explorer':
        """Explorer that continues from another's `state`, with the map and graph that belong to it.

        Raises InputError where it is no such state.
        """
        explorer = Explorer(config)
        checked = snapshot.validate(state, evidence.FIELDS, 'exploration')
        explorer._finder.store.restore(checked)
        return explorer

    def step(
        self, topology: TopologicalMap, patch: GridPatch, scan: Scan, T_map_base: Array
    ) -> Decision:
        """Choose where to drive, from the graph, the map and a scan made at a pose (3,).

        patch: the whole map, on one lattice from step to step. Deterministic; call it once a scan.
        """
        clock = self._clock
        clock.now_ns = scan.stamp_ns
        clock.began_ns = scan.stamp_ns if clock.began_ns < 0 else clock.began_ns
        self._space.add_pose(T_map_base)
        self.frontier_map.update(patch, box_of_scan(scan, T_map_base), *self.team.take_changes())
        self._add_visit(T_map_base)
        if self._is_due():
            clock.found_ns = scan.stamp_ns
            self.team.apply_settled(self._finder.store.items, SAME_PLACE_M, scan.stamp_ns)
            self._frame = self.frontier_map.frame
            self._space.update(self.frontier_map, T_map_base)
            self._finder.update(
                topology,
                self.frontier_map,
                self._space.now,
                T_map_base,
                scan.range_max_m,
                scan.stamp_ns,
            )
            self._choose(topology, T_map_base)
        return self._decision()

    def target_failed(self, reason: str) -> None:
        """Process that the present target could not be reached."""
        candidate = self._target.candidate
        if self._target.is_turn:
            self._look.stop()
        elif candidate is not None:
            candidate.evidence.failures += 1
            candidate.evidence.failed_ns = self._clock.now_ns
            # A robot or a person in the way is no property of the place.
            if reason.startswith(NO_PATH):
                self.team.add_settled(candidate.evidence)
        if candidate is not None:
            self._drop_target()
            self._target.goal = None

    def claim(self, stamp_ns: int, T_map_base: Array, remaining_m: float = 0.0) -> Claim:
        """What to send the other robots of the team, at a pose (3,); remaining_m: of the path."""
        candidate = self._target.candidate
        place = None if candidate is None or self._target.is_turn else candidate.middle
        team = self.team
        return Claim(team.name, stamp_ns, T_map_base, place, remaining_m, team.settled)

    def frontiers(self) -> list[Array]:
        """Cells of each candidate, (N, 2), m, map frame."""
        return [self._frame.centres_of(c.cells) for c in self.candidates]

    # Evidence.

    def _add_visit(self, T_map_base: Array) -> None:
        """A target that stays although the robot is there and observes it hides nothing, probably.

        It is observed from somewhere else the next time, and is reachable, whatever failed before.
        """
        target = self._target
        if target.candidate is None or target.goal is None or target.is_turn:
            return
        is_there = _is_at(T_map_base, target.goal)
        target.scans_at_goal = target.scans_at_goal + 1 if is_there else 0
        if target.scans_at_goal >= _SCANS:
            target.candidate.evidence.visits += 1
            target.candidate.evidence.failures = 0
            self.team.add_settled(target.candidate.evidence)
            target.candidate.examined_ns = -1
            self._drop_target()
            target.goal = None

    # The target.

    def _is_due(self) -> bool:
        """Whether candidates are found again: once in a while, and when the target is gone."""
        age_s = (self._clock.now_ns - self._clock.found_ns) / SECOND_NS
        if self._frame != self.frontier_map.frame or age_s >= self.config.candidate_period_s:
            return True
        return age_s > _GONE_S and not self._target_remains()

    def _target_remains(self) -> bool:
        candidate = self._target.candidate
        if candidate is None:
            return False
        left = self.frontier_map.remaining(candidate.cells)
        return self.frontier_map.is_long(left, self.config.min_frontier_size)

    def _choose(self, topology: TopologicalMap, T_map_base: Array) -> None:
        """Choose the target among the candidates."""
        worth = [c for c in self._doubtful if not _is_given_up(c)]
        waits = not topology.nodes and self._clock.now_ns - self._clock.began_ns < (
            _START_S * SECOND_NS
        )
        if not worth:
            self._drop_target()
            is_over = self.frontier_map.free_cells > 0 and not waits
            if not (is_over and self._turns_in_place(T_map_base)):
                self._scans_without_target += is_over
            return
        self._scans_without_target = 0
        self._look.stop()
        own = self.claim(self._clock.now_ns, T_map_base)
        ready = self.team.share(
            self._ready(worth), own, self._space.path_lengths_from, self.config.switch_margin_m
        )
        if not ready:
            self._drop_target()
            return
        self._left.update(self.frontier_map.known_area_m2)
        costs = self._costs(ready, T_map_base)
        best = min(costs, key=lambda candidate: costs[candidate])
        kept = self._kept(list(costs))
        if kept is not None and kept is not best:
            if costs[best] >= costs[kept] - self._switch_margin_m(best):
                best = kept
            else:
                self._left.add(kept.evidence.id)
        self._drive_to(best, T_map_base)

    def _turns_in_place(self, T_map_base: Array) -> bool:
        """Begin to turn, or turn on, if that can show anything; returns whether it can."""
        frontiers = self.frontier_map
        xy = (float(T_map_base[0]), float(T_map_base[1]))
        hidden_m2 = hidden_area_m2(frontiers, xy)
        is_left = bool(self._doubtful)
        goal = self._look.next_goal(T_map_base, hidden_m2, frontiers.known_area_m2, is_left)
        if goal is None:
            return False
        self._target = _Target(turn_target(goal), goal=goal, is_turn=True)
        return True

    def _switch_margin_m(self, candidate: Candidate) -> float:
        """Saving for which the target is changed, larger for one that was left.

        The robot never oscillates without end, whatever the costs are.
        """
        return self.config.switch_margin_m * self._left.factor(candidate.evidence.id)

    @property
    def _doubtful(self) -> list[Candidate]:
        """Candidates that are not resolved: worth a visit, or given up."""
        threshold = self.config.probability_threshold
        return [candidate for candidate in self.candidates if candidate.probability < threshold]

    def _ready(self, worth: list[Candidate]) -> list[Candidate]:
        """Candidates to which no drive failed; if there are none, all others after a pause.

        A frontier that has changed since is another candidate.
        """
        untried = [c for c in worth if not c.evidence.failures]
        since_ns = self._clock.now_ns - _FINAL_PAUSE_S * SECOND_NS
        return untried or [c for c in worth if c.evidence.failed_ns < since_ns]

    def _kept(self, candidates: list[Candidate]) -> Candidate | None:
        """The target, or the candidate to which its frontier belongs now."""
        target = self._target
        if target.candidate is not None:
            for candidate in candidates:
                if candidate.evidence is target.candidate.evidence:
                    return candidate
        near = min(candidates, key=lambda candidate: math.dist(candidate.middle, target.middle))
        return near if math.dist(near.middle, target.middle) <= _SAME_PLACE_M else None

    def _drive_to(self, candidate: Candidate, T_map_base: Array) -> None:
        """Make a candidate the target; the goal stays while its frontier does."""
        target = self._target
        goal = candidate.goal
        if goal is None:
            return
        if not self._goal_stays(candidate, goal, T_map_base):
            target.goal = goal
        target.candidate = candidate
        target.middle = candidate.middle
        target.is_turn = False

    def _goal_stays(self, candidate: Candidate, goal: Array, T_map_base: Array) -> bool:
        """Whether the goal stays although another viewpoint of the same frontier is nearer now.

        It does on the way, and as long as the frontier is unchanged: of two viewpoints that take
        turns with the place of the robot, none would ever be reached.
        """
        target = self._target
        if target.goal is None:
            return False
        moved_m = math.dist(candidate.middle, target.middle)
        gap_m = math.dist(goal[:2], target.goal[:2])
        is_on_the_way = math.dist(T_map_base[:2], target.goal[:2]) > _NEAR_M
        return max(moved_m, gap_m) <= _SAME_PLACE_M and (is_on_the_way or moved_m == 0.0)

    def _drop_target(self) -> None:
        self._target.candidate = None
        self._target.scans_at_goal = 0
        self._target.is_turn = False

    def _costs(self, candidates: list[Candidate], T_map_base: Array) -> dict[Candidate, float]:
        """Cost, m, of driving to each candidate: the path, and the turn with which it begins."""
        goals = np.array([candidate.goal for candidate in candidates])
        lengths = self._space.path_lengths(T_map_base, goals[:, :2])
        costs = lengths + self.config.turn_cost_m_rad * _turns(T_map_base, goals)
        return dict(zip(candidates, costs.tolist(), strict=True))

    # The decision.

    def _decision(self) -> Decision:
        target = self._target
        places = self.candidates
        if target.is_turn and target.candidate is not None:
            places = [*places, target.candidate]
        published = [c.published(target.goal if c is target.candidate else None) for c in places]
        chosen = next((end_node for end_node in published if end_node.is_target), None)
        doubtful = self._doubtful
        aside = sorted(c.node_id for c in doubtful if c.evidence.failures or _is_given_up(c))
        finished = self._scans_without_target >= _SCANS
        left = len(doubtful) or int(self._look.is_in_the_dark)
        code, reason = finish_reason(finished, left)
        return Decision(
            chosen,
            finished,
            reason,
            code,
            self._finder.settled + published,
            aside,
            self.frontier_map.known_area_m2,
            left,
            [(c.probability, c.mean_area_m2) for c in self.candidates],
        )


def _is_given_up(candidate: Candidate) -> bool:
    """Whether there is no way to a candidate, or it was tried as often as it is worth."""
    tried = candidate.evidence
    is_tried = tried.visits >= _MAX_VISITS or tried.failures >= _MAX_FAILURES
    return candidate.goal is None or is_tried


def _turns(T_map_base: Array, goals: Array) -> Array:
    """Size of the turns (N,), rad, with which the paths to goals (N, 3) begin; 0 at the goal."""
    offsets = goals[:, :2] - T_map_base[:2]
    turns = np.abs(se2.wrap(np.arctan2(offsets[:, 1], offsets[:, 0]) - T_map_base[2]))
    return np.where(np.hypot(*offsets.T) > _NEAR_M, turns, 0.0)


def _is_at(T_map_base: Array, goal: Array) -> bool:
    near = math.dist(T_map_base[:2], goal[:2]) <= _NEAR_M
    return near and abs(se2.wrap(float(goal[2] - T_map_base[2]))) <= _NEAR_RAD
