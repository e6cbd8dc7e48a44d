"""Mission: explore an area within budgets, then return to the start if asked to.

A mission asks a strategy where to drive, and answers what the robot shall do next. It has no clock
and no ROS: time is an argument, in s.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import errors, snapshot
from thinmap_ros.core.exploration.strategy import (
    CountsSeconds,
    Decision,
    EndNode,
    FinishCode,
    Observation,
    Strategy,
)
from thinmap_ros.core.grid.edits import masked_outside
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_COUNT, Field

# Of the progress of a drive.
_STEP_M = 0.1
_DETOUR_M = 1.0
_MAX_DETOURS = 3
# Longer gaps between two updates are missing inputs, no standstill.
_MAX_GAP_S = 10.0
_SAME_M = 0.1
_SAME_RAD = 0.2

# Of the answers of an action server.
_FIRST_ANSWER_S = 5.0
_LAST_ANSWER_S = 20.0
_MAX_UNANSWERED = 3
_MAX_REJECTED = 5
_REJECTED_PAUSE_S = 2.0

_MAX_ARRIVALS = 6
STAYS = 'reached, but the target stays'
# Within the distance at which a goal counts as reached: turns in place, and corrections of a pose.
_DRIVEN_M = 0.3
_MIN_STEP_M = 0.02
_MIN_CORNERS = 3
_EXPLORED = (FinishCode.ALL_RESOLVED, FinishCode.UNREACHABLE)


def is_same_goal(a: Array, b: Array) -> bool:
    """Whether two goals (3,) are so near to each other that they are one."""
    near = math.dist(a[:2], b[:2]) <= _SAME_M
    return near and abs(wrap(float(a[2] - b[2]))) <= _SAME_RAD


@dataclass
class _Approach:
    """Smallest distance to a goal so far, m."""

    nearest_m: float = math.inf

    def is_closer(self, distance_m: float) -> bool:
        """Whether a distance is clearly smaller than all before."""
        if distance_m > self.nearest_m - _STEP_M:
            return False
        self.nearest_m = distance_m
        return True


@dataclass
class DriveProgress:
    """Time without progress of a drive to a goal (3,).

    Progress is a smaller distance to the goal than ever, straight or along the remaining path. A
    new path that is longer by a metre is a detour: the strategy decides again, and the progress on
    it is measured anew, up to three times.
    """

    goal: Array
    idle_s: float = 0.0
    _straight: _Approach = field(default_factory=_Approach)
    _path: _Approach = field(default_factory=_Approach)
    _detours: int = 0
    _last_s: float = math.nan

    def update(self, T_map_base: Array, remaining_m: float | None, now_s: float) -> bool:
        """Process the present pose (3,) and the remaining path, m; None where it is unknown.

        Returns whether the path has become a detour.
        """
        gap_s = 0.0 if math.isnan(self._last_s) else now_s - self._last_s
        self._last_s = now_s
        self.idle_s += min(max(gap_s, 0.0), _MAX_GAP_S)
        is_detour = False
        is_closer = self._straight.is_closer(math.dist(T_map_base[:2], self.goal[:2]))
        if remaining_m is not None:
            is_detour = remaining_m > self._path.nearest_m + _DETOUR_M
            if is_detour and self._detours < _MAX_DETOURS:
                self._detours += 1
                self._path = _Approach()
            is_closer |= self._path.is_closer(remaining_m)
        if is_closer:
            self.idle_s = 0.0
        return is_detour and self._path.nearest_m == remaining_m


@dataclass
class DriveRequest:
    """Goal (3,) that an action server was given at sent_s, and what it reported on it; times in s.

    The server may answer late, never, or refuse.
    answer_timeout_s: after which the request counts as lost; feedback_timeout_s: after which a
    server that has published feedback is silent. A server without any feedback is never silent.
    """

    goal: Array
    sent_s: float
    answer_timeout_s: float = _FIRST_ANSWER_S
    feedback_timeout_s: float = 3.0
    is_accepted: bool = False
    remaining_m: float | None = None
    _last_feedback_s: float | None = None

    def is_same(self, goal: Array) -> bool:
        """Whether another goal (3,) is so near that it need not be sent."""
        return is_same_goal(self.goal, goal)

    def add_feedback(self, remaining_m: float, now_s: float) -> None:
        """Register feedback; a remaining path of 0 m is not known."""
        self._last_feedback_s = now_s
        self.remaining_m = remaining_m if remaining_m > 0.0 else None

    def is_unanswered(self, now_s: float) -> bool:
        """Whether the server neither accepted nor rejected the goal in time."""
        return not self.is_accepted and now_s - self.sent_s >= self.answer_timeout_s

    def is_silent(self, now_s: float) -> bool:
        """Whether the server stopped reporting: it may have been restarted and lost the goal."""
        if self._last_feedback_s is None:
            return False
        return now_s - self._last_feedback_s >= self.feedback_timeout_s


@dataclass
class Retries:
    """How often a goal may be sent again to a server that rejects it or does not answer.

    Each time, the server has twice as long to answer.
    """

    _unanswered: int = 0
    _rejected: int = 0
    _not_before_s: float = 0.0

    @property
    def answer_timeout_s(self) -> float:
        """Time that the server has for its next answer, s."""
        return min(_FIRST_ANSWER_S * 2.0**self._unanswered, _LAST_ANSWER_S)

    def add_accepted(self) -> None:
        """Register an accepted goal."""
        self._unanswered = 0
        self._rejected = 0

    def add_unanswered(self) -> bool:
        """Register a goal without answer; returns whether it has to be given up."""
        self._unanswered = min(self._unanswered + 1, _MAX_UNANSWERED)
        return self._unanswered >= _MAX_UNANSWERED

    def add_rejected(self, now_s: float) -> bool:
        """Register a rejected goal; returns whether it has to be given up."""
        self._unanswered = 0
        self._rejected += 1
        self._not_before_s = now_s + _REJECTED_PAUSE_S
        if self._rejected < _MAX_REJECTED:
            return False
        self._rejected = 0
        return True

    def may_send(self, now_s: float) -> bool:
        """Whether the pause after a rejected goal is over; a clock that went back ends it."""
        return not 0.0 < self._not_before_s - now_s <= _REJECTED_PAUSE_S


@dataclass
class Drives:
    """What came of the drives of an exploration so far.

    has_settled: whether a target was reached, or was none any more before the robot was there;
    failure: why the last drive failed.
    """

    has_settled: bool = False
    failure: str = ''
    _target: EndNode | None = None
    _arrivals: int = 0

    def follow(self, target: EndNode | None, strategy: Strategy) -> Array | None:
        """Goal (3,) to drive to for the target of a strategy's decision; None: nowhere.

        A target that is where it was although the robot has arrived there again and again has
        failed: the strategy does not see it as reached.
        """
        last = self._target
        self._target = target
        self.has_settled |= last is not None and (target is None or target.node_id != last.node_id)
        if target is None:
            return None
        if last is None or not is_same_goal(target.goal, last.goal):
            self._arrivals = 0
        if self._arrivals < _MAX_ARRIVALS:
            return target.goal
        self.add_result(False, STAYS)
        strategy.target_failed(STAYS)
        return None

    def add_result(self, is_success: bool, reason: str) -> None:
        """Register how the drive to the present target ended."""
        self.has_settled |= is_success
        self._arrivals += is_success
        if not is_success:
            self.failure = reason
            self._target = None

    def shortcoming(self, end: Decision, distance_m: float) -> str:
        """Why an exploration that leaves something has explored nothing; else empty.

        distance_m: travelled. A strategy that resolves all end nodes from the start needs no drive.
        """
        if end.code != FinishCode.UNREACHABLE:
            return ''
        if self.failure and not (self.has_settled and distance_m > _DRIVEN_M):
            return f'no target was reached: {self.failure}'
        return '' if distance_m > _DRIVEN_M else 'the robot has not driven'


@dataclass(eq=False)
class Odometer:
    """Distance driven, from poses (3,); noise of a robot that stands still does not count.

    start: the first pose, unless another one was given.
    """

    start: Array | None = None
    distance_m: float = 0.0
    _last: Array | None = None

    def add_pose(self, T_map_base: Array) -> None:
        """Add the present pose (3,)."""
        if self._last is None:
            self.start = T_map_base if self.start is None else self.start
            self._last = T_map_base
            return
        step = float(np.hypot(*(T_map_base[:2] - self._last[:2])))
        if step >= _MIN_STEP_M:
            self.distance_m += step
            self._last = T_map_base


@dataclass(frozen=True)
class Budget:
    """Limits of an exploration; 0 is none."""

    time_s: float = 0.0
    distance_m: float = 0.0
    area_m2: float = 0.0

    def exhausted_by(self, time_s: float, distance_m: float, area_m2: float) -> str:
        """Which limit is reached, in words; empty as long as none is."""
        if 0.0 < self.time_s <= time_s:
            return f'time limit of {self.time_s:.0f} s'
        if 0.0 < self.distance_m <= distance_m:
            return f'distance limit of {self.distance_m:.1f} m'
        if 0.0 < self.area_m2 <= area_m2:
            return f'area limit of {self.area_m2:.1f} m^2'
        return ''


@dataclass(frozen=True, eq=False)
class MissionGoal:
    """What a mission shall do.

    area: corners (N, 2) of a polygon in the map frame, m; with fewer than three, everywhere.
    return_attempts: drives to the start before a return is given up.
    Raises InputError where a limit or a corner is no number, or too large.
    """

    budget: Budget = field(default_factory=Budget)
    area: Array = field(default_factory=lambda: np.empty((0, 2)))
    return_to_start: bool = False
    return_attempts: int = 3

    def __post_init__(self) -> None:
        limits = (self.budget.time_s, self.budget.distance_m, self.budget.area_m2)
        corners = self.area.reshape(-1).tolist()
        errors.require_bounded('goal: limit or corner of the area', [*limits, *corners])

    def masked(self, patch: GridPatch) -> GridPatch:
        """Map in which all outside the area is wall."""
        return patch if len(self.area) < _MIN_CORNERS else masked_outside(patch, self.area)


class MissionState(IntEnum):
    """Progress of a mission, as in thinmap_msgs/ExplorationStatus."""

    IDLE = 0
    EXPLORING = 1
    RETURNING = 2
    FINISHED = 3


class DriveTo(NamedTuple):
    """Order to drive to a pose (3,) in the map frame, unless the robot is already on its way."""

    goal: Array


class Finish(NamedTuple):
    """Order to stop, with the reason why the mission ended.

    has_explored: False where something is left and no drive came to anything; is_home: False where
    the robot could not return to the start as it was asked to.
    """

    code: FinishCode
    reason: str
    has_explored: bool = True
    is_home: bool = True

    @property
    def is_explored(self) -> bool:
        """Whether exploring ended as planned, wherever the robot is now."""
        return self.has_explored and self.code in (*_EXPLORED, FinishCode.BUDGET_EXHAUSTED)

    @property
    def is_success(self) -> bool:
        """Whether the mission ended as planned."""
        return self.is_explored and self.is_home


Action = DriveTo | Finish | None  # what the robot shall do now; None: continue


@dataclass
class InputWatchdog:
    """When the laser last showed anything and the pose was last tracked, s, and the timeouts.

    awaited: what is missing where there is nothing to explore with, in words.
    """

    last_scan_s: float = 0.0
    last_tracking_s: float = 0.0
    is_lost: bool = False
    scan_timeout_s: float = 60.0
    lost_timeout_s: float = 10.0
    awaited: str = 'scan that shows anything'

    def restart(self, now_s: float) -> None:
        """Start all timeouts."""
        self.last_scan_s = now_s
        self.last_tracking_s = now_s

    def add_scan(self, now_s: float) -> None:
        """Register a scan that is not blind."""
        self.last_scan_s = now_s

    def add_tracking(self, is_lost: bool, now_s: float) -> None:
        """Register the localizer's state.

        A silent localizer does not count as lost: restarted, it continues where it was.
        """
        if not (is_lost and self.is_lost):
            self.last_tracking_s = now_s
        self.is_lost = is_lost

    def failure(self, now_s: float) -> Finish | None:
        """Reason to give up: no scans, or no pose, for too long."""
        if now_s - self.last_scan_s > self.scan_timeout_s:
            reason = f'no {self.awaited} for {self.scan_timeout_s:.0f} s'
            return Finish(FinishCode.SENSOR_TIMEOUT, reason)
        if self.is_lost and now_s - self.last_tracking_s > self.lost_timeout_s:
            reason = f'the pose has been lost for {self.lost_timeout_s:.0f} s'
            return Finish(FinishCode.LOCALIZATION_LOST, reason)
        return None


class Mission:
    """One exploration from its start to its end.

    drives: what came of them; decision: the strategy's last one; end: why exploring ended, code
    NONE before; is_paused: while it is, nothing is decided and no timeout runs; has_returned:
    whether the robot is back at its start.
    """

    def __init__(
        self,
        goal: MissionGoal,
        strategy: Strategy,
        watchdog: InputWatchdog,
        now_s: float,
        state: MissionState = MissionState.EXPLORING,
        elapsed_s: float = 0.0,
    ) -> None:
        """elapsed_s: time since the start of a mission that is continued."""
        self.goal = goal
        self.strategy = strategy
        self.state = state
        self.odometer = Odometer()
        self.drives = Drives()
        self.decision: Decision | None = None
        self.end = Finish(FinishCode.NONE, '')
        self.is_paused = False
        self.has_returned = False
        self._watchdog = watchdog
        self._started_s = now_s
        self._before_s = elapsed_s
        self._return_failures = 0
        watchdog.restart(now_s)

    def elapsed_s(self, now_s: float) -> float:
        """Time since the start."""
        return self._before_s + now_s - self._started_s

    @property
    def is_running(self) -> bool:
        """Whether the mission explores or returns."""
        return self.state in (MissionState.EXPLORING, MissionState.RETURNING)

    def is_resumed_by(self, goal: MissionGoal) -> bool:
        """Whether a next mission continues with the strategy of this one.

        It does where this one was interrupted. In another area, other walls block the view.
        """
        return self.end.code not in _EXPLORED and np.array_equal(self.goal.area, goal.area)

    def step(self, observation: Observation) -> Action:
        """Process a scan that is in the map; the strategy decides while the mission explores."""
        self.odometer.add_pose(observation.T_map_base)
        if self.state != MissionState.EXPLORING or self.is_paused:
            return None
        patch = self.goal.masked(observation.patch)
        self.decision = self.strategy.step(
            observation.topology, patch, observation.scan, observation.T_map_base
        )
        if self.decision.finished:
            return self._finish_exploring(self._end_of(self.decision))
        goal = self.drives.follow(self.decision.target, self.strategy)
        return None if goal is None else DriveTo(goal)

    def check(self, now_s: float, is_driving: bool) -> Action:
        """Check inputs and budgets, about once a second.

        is_driving: whether the navigator reports on the goal that it was given.
        """
        if self._started_s == 0.0:  # a simulated clock stands at 0 before its first message
            self._started_s = now_s
            self._watchdog.restart(now_s)
        if self.is_paused:
            self._watchdog.restart(now_s)
            return None
        failure = self._watchdog.failure(now_s)
        if failure is not None:
            return self._finish(failure)
        if self.state == MissionState.RETURNING:
            return None if is_driving else self._drive_to_start()
        known_area_m2 = 0.0 if self.decision is None else self.decision.known_area_m2
        exhausted = self.goal.budget.exhausted_by(
            self.elapsed_s(now_s), self.odometer.distance_m, known_area_m2
        )
        if exhausted and self.state == MissionState.EXPLORING:
            return self._finish_exploring(Finish(FinishCode.BUDGET_EXHAUSTED, exhausted))
        return None

    def path_grew(self, remaining_m: float) -> None:
        """Process that the path to the last goal has become longer, to remaining_m."""
        if self.state == MissionState.EXPLORING and isinstance(self.strategy, CountsSeconds):
            self.strategy.path_grew(remaining_m)

    def drive_ended(self, success: bool, reason: str) -> Action:
        """Process the navigator's result for the goal that it was given last."""
        if self.state != MissionState.RETURNING:
            if self.state == MissionState.EXPLORING:
                self.drives.add_result(success, reason)
                if not success:
                    self.strategy.target_failed(reason)
            return None
        if success:
            self.has_returned = True
            return self._finish(self.end)
        self._return_failures += 1
        if self._return_failures < self.goal.return_attempts:
            return self._drive_to_start()
        words = f'{self.end.reason}; not home: {reason}'
        return self._finish(self.end._replace(reason=words, is_home=False))

    def cancel(self, reason: str) -> Finish:
        """End the mission before it is done."""
        return self._finish(Finish(FinishCode.CANCELLED, reason))

    def _end_of(self, decision: Decision) -> Finish:
        shortcoming = self.drives.shortcoming(decision, self.odometer.distance_m)
        reasons = filter(None, (decision.reason, shortcoming))
        return Finish(decision.code, '; '.join(reasons), has_explored=not shortcoming)

    def _finish_exploring(self, end: Finish) -> Action:
        """Return to the start if that was asked for, else finish."""
        self.end = end
        action = self._drive_to_start()
        if not self.goal.return_to_start or action is None:
            return self._finish(end)
        self.state = MissionState.RETURNING
        return action

    def _drive_to_start(self) -> DriveTo | None:
        start = self.odometer.start
        return None if start is None else DriveTo(start)

    def _finish(self, end: Finish) -> Finish:
        self.end = end
        self.state = MissionState.FINISHED
        self.is_paused = False
        return end


FIELDS = {
    'budget': Field(np.float64, (3,), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'area': Field(np.float64, ('n', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'return_to_start': Field(np.bool_),
    'phase': Field(np.int64, (), min(MissionState), max(MissionState)),
    'end_code': Field(np.int64, (), min(FinishCode), max(FinishCode)),
    'end_reason': Field(np.uint8, ('t',)),  # UTF-8
    'elapsed_s': Field(np.float64, (), 0.0, MAX_COUNT),
    'start': Field(np.float64, ('s', 3), -MAX_COORDINATE_M, MAX_COORDINATE_M),  # none, or one
    'distance_m': Field(np.float64, (), 0.0, MAX_COUNT),
    'is_paused': Field(np.bool_),
    'has_returned': Field(np.bool_),
    'has_explored': Field(np.bool_),
    'has_settled': Field(np.bool_),
}


def mission_state(mission: Mission, now_s: float) -> dict[str, NDArray[Any]]:
    """Goal and progress of a mission as arrays by name, without its strategy.

    For an explorer that is killed and started again: `resumed_mission` continues it.
    """
    budget = mission.goal.budget
    start = mission.odometer.start
    return {
        'budget': np.array([budget.time_s, budget.distance_m, budget.area_m2]),
        'area': mission.goal.area.reshape(-1, 2),
        'return_to_start': np.array(mission.goal.return_to_start),
        'phase': np.array(int(mission.state)),
        'end_code': np.array(int(mission.end.code)),
        'end_reason': np.frombuffer(mission.end.reason.encode(), dtype=np.uint8),
        'elapsed_s': np.array(max(mission.elapsed_s(now_s), 0.0)),
        'start': np.empty((0, 3)) if start is None else start.reshape(1, 3),
        'distance_m': np.array(mission.odometer.distance_m),
        'is_paused': np.array(mission.is_paused),
        'has_returned': np.array(mission.has_returned),
        'has_explored': np.array(mission.end.has_explored),
        'has_settled': np.array(mission.drives.has_settled),
    }


def resumed_mission(
    state: Mapping[str, NDArray[Any]], strategy: Strategy, watchdog: InputWatchdog, now_s: float
) -> Mission:
    """Mission that continues another's `mission_state`, with a strategy.

    Raises InputError where it is no such state.
    """
    own = snapshot.validate(state, FIELDS, 'mission')
    goal = MissionGoal(Budget(*own['budget'].tolist()), own['area'], bool(own['return_to_start']))
    phase = MissionState(int(own['phase']))
    mission = Mission(goal, strategy, watchdog, now_s, phase, float(own['elapsed_s']))
    reason = own['end_reason'].tobytes().decode(errors='replace')
    has_explored = bool(own['has_explored'])
    mission.end = Finish(FinishCode(int(own['end_code'])), reason, has_explored)
    mission.drives.has_settled = bool(own['has_settled'])
    mission.odometer.start = own['start'][0] if len(own['start']) else None
    mission.odometer.distance_m = float(own['distance_m'])
    mission.is_paused = bool(own['is_paused'])
    mission.has_returned = bool(own['has_returned'])
    return mission
