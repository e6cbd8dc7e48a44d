"""Exploration by belief: which candidate is next, and when nothing is worth a visit.

- Only candidates are visited whose probability of hiding nothing is below a threshold, as in the
  paper. A candidate is dropped as soon as its probability passes the threshold on the way.
- Many small chances are one large one: an exploration does not end as long as all candidates above
  the threshold together are expected to hide more than 2 m2.
- The next one is that which is reached first, turns included. A tour through all of them saves
  nothing: what comes to light on the way changes it.
- The target is kept unless another one saves a clear margin, so that the robot does not oscillate.
- A target that stays as it is although the robot observes it is evidence that nothing is hidden.
- What was tried is tried again when its frontier has changed, or once before the end.
- Before the explorer gives up, the robot turns once in place if it stands beside unknown space.
- In a team the candidates are shared by an auction, and the robot chooses among its own.

Source: exploration paper sections 3.2 and 4.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import config_or_default, part
from thinmap_ros.core.exploration import belief
from thinmap_ros.core.exploration.belief import (
    MAX_VISITS,
    WORTH_SEEING_M2,
    BeliefModel,
    Evidence,
)
from thinmap_ros.core.exploration.candidates import Candidate, CandidateConfig, CandidateFinder
from thinmap_ros.core.exploration.fitted import FITTED
from thinmap_ros.core.exploration.space import FrontierMap, box_of_scan, hidden_area_m2
from thinmap_ros.core.exploration.strategy import (
    Decision,
    EndNode,
    Start,
    Streak,
    decide,
    is_at,
    is_near,
)
from thinmap_ros.core.exploration.team import SAME_PLACE_M, Claim, Team
from thinmap_ros.core.exploration.views import Sight
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.navigator import NO_PATH
from thinmap_ros.core.planning.path_follower import SpeedConfig
from thinmap_ros.core.planning.travel_times import TravelTimes
from thinmap_ros.core.planning.wavefront import WavefrontConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.topology.graph import TopologicalMap

TURN_ID = 2**32 - 1  # of the place where the robot turns; the end nodes' ids are below
# Of a turn. With two parts, both ways to the next heading would be of the same length.
_PARTS = 3
_IS_THERE_RAD = 0.35

_SAME_PLACE_M = 1.5  # a target or viewpoint that moves less is the same one
# Saving for which the target is changed, so that the robot does not oscillate.
_SWITCH_MARGIN_S = 4.0
_FIND_PERIOD_S = 1.0  # between two searches for candidates, which take time in large maps
_MAX_FAILURES = 2
_MAX_RESOLVED_M2 = 2.0  # of area that candidates may hide of which none is worth a visit
_GONE_S = 0.35
_FINAL_PAUSE_S = 40.0  # a navigator that starts, or is blocked by people, refuses goals meanwhile


class LookAround:
    """One full turn in place, before an exploration gives up, if it can show anything.

    At its start, a robot whose laser does not see all round may stand where it has not seen enough
    free space to drive to. is_in_the_dark: whether more is hidden around it than is known.
    """

    def __init__(self) -> None:
        self.is_in_the_dark = False
        self._was_tried = False
        self._goals: list[Array] = []

    def next_goal(
        self, T_map_base: Array, hidden_m2: float, known_m2: float, is_left: bool
    ) -> Array | None:
        """Where to turn from a pose (3,), as a pose (3,); None: no more, or no use.

        hidden_m2: unknown area in line of sight of the robot, were it to look there; known_m2: of
        the map; is_left: whether end nodes are left.
        """
        self.is_in_the_dark = hidden_m2 > known_m2
        is_of_use = self.is_in_the_dark or (is_left and hidden_m2 >= WORTH_SEEING_M2)
        if is_of_use and not self._was_tried:
            x, y, theta = T_map_base.tolist()
            part = 2.0 * math.pi / _PARTS
            self._goals = [se2.pose(x, y, theta + k * part) for k in range(1, _PARTS + 1)]
        self._was_tried = True
        heading = float(T_map_base[2])
        while self._goals and abs(se2.wrap(float(self._goals[0][2]) - heading)) <= _IS_THERE_RAD:
            self._goals.pop(0)
        return self._goals[0] if self._goals else None

    def stop(self) -> None:
        """End a turn: it has shown where to drive, or is not possible."""
        self._goals = []


def turn_target(goal: Array) -> Candidate:
    """The place (3,) where the robot turns, as a target: it has no frontier of its own."""
    place = float(goal[0]), float(goal[1])
    nothing = np.zeros((0, 2), dtype=np.int64)
    return Candidate(Evidence(TURN_ID, place), nothing, place, goal=goal)


@dataclass(frozen=True)
class ExplorerConfig(CandidateConfig):
    """What is worth a visit, and how long it takes to get there.

    planner, controller: of the navigator that drives to the targets.
    """

    planner: WavefrontConfig = part(WavefrontConfig)
    controller: SpeedConfig = part(SpeedConfig)


@dataclass
class _Target:
    """Where the robot drives: the candidate, the goal (3,), and the scans made there.

    is_turn: whether the goal is a part of a turn in place; known_area_m2: when the goal was set;
    seconds: until the robot is there, as found last, 0 where that is not known; reported_s: by the
    path that the navigator drives, where that has become longer since the last decision, else 0.
    """

    candidate: Candidate | None = None
    goal: Array | None = None
    visit: Streak = field(default_factory=Streak)
    is_turn: bool = False
    known_area_m2: float = 0.0
    seconds: float = 0.0
    reported_s: float = 0.0


class Explorer:
    """Chooses targets, scan by scan, until no candidate is worth a visit."""

    def __init__(
        self,
        config: ExplorerConfig | None = None,
        model: BeliefModel = FITTED,
        team: Team | None = None,
    ) -> None:
        """team: the robots that explore together; None: this one alone."""
        self.config = config_or_default(config, ExplorerConfig)
        self.team = team or Team()
        self.frontier_map = FrontierMap()
        self._finder = CandidateFinder(self.config, model)
        self._travel = TravelTimes(self.config.planner, self.config.controller)
        self._sight = Sight()
        self._target = _Target()
        self._look = LookAround()
        self._published: list[EndNode] = []  # of the candidates, as none of them is the target
        self._now_ns = 0  # stamp of this scan
        self._found_ns = -(10**18)  # and of the last search for candidates
        self._frame = self.frontier_map.frame
        self._start = Start()
        self._end = Streak()

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
        checked = snapshot.validate(belief.completed(state), belief.FIELDS, 'exploration')
        explorer._finder.store.restore(checked)
        return explorer

    def step(
        self, topology: TopologicalMap, patch: GridPatch, scan: Scan, T_map_base: Array
    ) -> Decision:
        """Choose where to drive, from the graph, the map and a scan made at a pose (3,).

        patch: the whole map, on one lattice from step to step. Deterministic; call it once a scan.
        """
        self._now_ns = scan.stamp_ns
        self._travel.add_pose(T_map_base)
        self._sight.add_scan(scan)
        self.frontier_map.update(patch, box_of_scan(scan, T_map_base), *self.team.take_changes())
        self._add_visit(T_map_base)
        if self._is_due():
            self._found_ns = scan.stamp_ns
            self.team.apply_settled(self._finder.store.items, SAME_PLACE_M, scan.stamp_ns)
            self._frame = self.frontier_map.frame
            frontiers = self.frontier_map
            self._travel.update(frontiers.free, frontiers.passable, frontiers.frame, T_map_base)
            self._finder.update(topology, frontiers, self._travel, self._sight)
            self._published = [candidate.published(None) for candidate in self.candidates]
            self._choose(topology, T_map_base)
        return self._decision()

    def target_failed(self, reason: str) -> None:
        """Process that the present target could not be reached."""
        candidate = self._target.candidate
        if self._target.is_turn:
            self._look.stop()
        elif candidate is not None:
            candidate.evidence.failures += 1
            candidate.evidence.failed_ns = self._now_ns
            # A robot or a person in the way is no property of the place.
            if reason.startswith(NO_PATH):
                self.team.add_settled(candidate.evidence)
        self._target = _Target()

    def path_grew(self, remaining_m: float) -> None:
        """Decide again: the path to the present target has become longer, to remaining_m."""
        self._target.reported_s = remaining_m / self._travel.speed_m_s
        self._found_ns = -(10**18)

    def claim(self, stamp_ns: int, T_map_base: Array) -> Claim:
        """What to send the other robots of the team, at a pose (3,)."""
        target = self._target
        is_claimed = target.candidate is not None and not target.is_turn
        place = target.candidate.middle if target.candidate is not None and is_claimed else None
        team = self.team
        return Claim(team.name, stamp_ns, T_map_base, place, target.seconds, team.settled)

    def frontiers(self) -> list[Array]:
        """Cells of each candidate, (N, 2), m, map frame."""
        return [self._frame.centres_of(c.cells) for c in self.candidates]

    def _add_visit(self, T_map_base: Array) -> None:
        """A target that stays although the robot is there and observes it hides nothing, probably.

        Unless the visit has shown something: what it shows is often a part of what is hidden. It is
        observed from somewhere else the next time, and is reachable, whatever failed before.
        """
        target = self._target
        if target.candidate is None or target.goal is None or target.is_turn:
            return
        if target.visit.add(is_at(T_map_base, target.goal)):
            self._target = _Target()
            if self.frontier_map.known_area_m2 >= target.known_area_m2 + WORTH_SEEING_M2:
                return
            target.candidate.evidence.add_visit((float(target.goal[0]), float(target.goal[1])))
            self.team.add_settled(target.candidate.evidence)

    def _is_due(self) -> bool:
        """Whether candidates are found again: once in a while, and when the target is gone."""
        age_s = (self._now_ns - self._found_ns) / SECOND_NS
        if self._frame != self.frontier_map.frame or age_s >= _FIND_PERIOD_S:
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
        starts = self._start.lasts(topology, self._now_ns)
        if not worth:
            self._target = _Target()
            may_end = self.frontier_map.free_cells > 0 and not starts
            if not (may_end and self._turns_in_place(T_map_base)):
                self._end.add(may_end)
            return
        self._end = Streak()
        self._look.stop()
        own = self.claim(self._now_ns, T_map_base)
        ready = self.team.share(self._ready(worth), own, self._travel, _SWITCH_MARGIN_S)
        if ready:
            self._drive_to(self._best(ready), T_map_base)
        else:
            self._target = _Target()

    def _best(self, ready: list[Candidate]) -> Candidate:
        """The target, unless another candidate saves the margin; else that which is reached first.

        The margin is twice as large for each time that one of the two was left, so that the robot
        never oscillates without end: neither by what a turn costs, nor with one that comes and
        goes.
        """
        kept = self._kept(ready)
        if kept is not None:
            kept.seconds = max(kept.seconds, self._target.reported_s)
        best = min(ready, key=lambda candidate: candidate.seconds)
        if kept is None or kept is best:
            return best
        known_area_m2 = self.frontier_map.known_area_m2
        times_left = max(each.evidence.times_left(known_area_m2) for each in (kept, best))
        margin_s = _SWITCH_MARGIN_S * 2.0**times_left
        if best.seconds >= kept.seconds - margin_s:
            return kept
        kept.evidence.leave(known_area_m2)
        return best

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

    @property
    def _doubtful(self) -> list[Candidate]:
        """Candidates that are not resolved: worth a visit, or given up.

        They are below the threshold. Where none is, but all together are expected to hide more than
        _MAX_RESOLVED_M2, those that hide most are not resolved either.
        """
        threshold = self.config.probability_threshold
        below = [candidate for candidate in self.candidates if candidate.probability < threshold]
        if below:
            return below
        by_area = sorted(self.candidates, key=lambda candidate: candidate.expected_area_m2)
        sums_m2 = accumulate(candidate.expected_area_m2 for candidate in by_area)
        return [c for c, m2 in zip(by_area, sums_m2, strict=True) if m2 > _MAX_RESOLVED_M2]

    def _ready(self, worth: list[Candidate]) -> list[Candidate]:
        """Candidates to which no drive failed; if there are none, all others after a pause.

        A frontier that has changed since is another candidate.
        """
        untried = [c for c in worth if not c.evidence.failures]
        since_ns = self._now_ns - _FINAL_PAUSE_S * SECOND_NS
        return untried or [c for c in worth if c.evidence.failed_ns < since_ns]

    def _kept(self, candidates: Iterable[Candidate]) -> Candidate | None:
        """The candidate that continues the target, or what came to light instead of it."""
        target = self._target.candidate
        if target is None:
            return None
        same = [c for c in candidates if c.evidence is target.evidence]
        near = same or [c for c in candidates if _moved_m(c, target) <= _SAME_PLACE_M]
        return min(near, key=lambda c: _moved_m(c, target), default=None)

    def _drive_to(self, candidate: Candidate, T_map_base: Array) -> None:
        """Make a candidate the target; the goal stays while its frontier and the path to it do."""
        if candidate.goal is None:
            return
        before = self._target
        if before.goal is not None and self._goal_stays(candidate, candidate.goal, T_map_base):
            seconds = float(self._travel.seconds_to(before.goal[None])[0])
            if seconds <= candidate.seconds + _SWITCH_MARGIN_S:
                self._target = replace(
                    before, candidate=candidate, is_turn=False, seconds=seconds, reported_s=0.0
                )
                return
        known_m2 = self.frontier_map.known_area_m2
        self._target = _Target(
            candidate, candidate.goal, before.visit, False, known_m2, candidate.seconds
        )

    def _goal_stays(self, candidate: Candidate, goal: Array, T_map_base: Array) -> bool:
        """Whether the goal stays although another viewpoint of the same frontier is nearer now.

        It does on the way, and as long as the frontier is unchanged: of two viewpoints that take
        turns with the place of the robot, none would ever be reached.
        """
        target = self._target
        if target.goal is None or target.candidate is None:
            return False
        moved_m = _moved_m(candidate, target.candidate)
        gap_m = math.dist(goal[:2], target.goal[:2])
        is_same = max(moved_m, gap_m) <= _SAME_PLACE_M
        return is_same and (moved_m == 0.0 or not is_near(T_map_base, target.goal))

    def _decision(self) -> Decision:
        target = self._target
        end_nodes = [*self._finder.settled, *self._published]
        if target.is_turn and target.candidate is not None:
            end_nodes.append(target.candidate.published(target.goal))
        for i, candidate in enumerate(self.candidates, len(self._finder.settled)):
            if candidate is target.candidate:
                end_nodes[i] = candidate.published(target.goal)
        doubtful = self._doubtful
        return decide(
            end_nodes,
            self._end.is_over,
            len(doubtful) or int(self._look.is_in_the_dark),
            (c.node_id for c in doubtful if c.evidence.failures or _is_given_up(c)),
            self.frontier_map.known_area_m2,
            self._finder.missing,
        )


def _is_given_up(candidate: Candidate) -> bool:
    """Whether there is no way to a candidate, or it was tried as often as it is worth.

    A drive that failed is made again only for an area worth seeing.
    """
    tried = candidate.evidence
    is_small = candidate.expected_area_m2 < WORTH_SEEING_M2
    max_failures = 1 if is_small else _MAX_FAILURES
    is_tried = tried.visits >= MAX_VISITS or tried.failures >= max_failures
    return candidate.goal is None or is_tried


def _moved_m(candidate: Candidate, target: Candidate) -> float:
    """Distance from the middle of a target to that of a candidate."""
    return math.dist(candidate.middle, target.middle)
