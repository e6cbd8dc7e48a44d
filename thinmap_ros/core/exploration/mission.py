"""Mission: explore an area within budgets, then return to the start if asked to.

A mission asks a strategy where to drive, and answers what the robot shall do next. It has no clock
and no ROS: time is an argument, in s.
"""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from thinmap_ros.core import errors
from thinmap_ros.core.exploration.live.drives import Drives
from thinmap_ros.core.exploration.observations import Observation
from thinmap_ros.core.exploration.strategy import Decision, FinishCode, Strategy
from thinmap_ros.core.grid.edits import masked_outside
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array

_MIN_STEP_M = 0.02
_MIN_CORNERS = 3
_EXPLORED = (FinishCode.ALL_RESOLVED, FinishCode.UNREACHABLE)


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


Action = DriveTo | Finish | None
"""What the robot shall do now; None: continue."""


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


@dataclass
class _MissionClock:
    """Time since the start of a mission, s, that began at started_s, before_s after its start."""

    started_s: float
    before_s: float

    def start(self, now_s: float) -> bool:
        """Start with the first message of a simulated clock, which stands at 0 before it.

        Returns whether that is so.
        """
        is_first = self.started_s == 0.0
        if is_first:
            self.started_s = now_s
        return is_first

    def elapsed_s(self, now_s: float) -> float:
        return self.before_s + now_s - self.started_s


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
        self._clock = _MissionClock(now_s, elapsed_s)
        self._return_failures = 0
        watchdog.restart(now_s)

    def elapsed_s(self, now_s: float) -> float:
        """Time since the start."""
        return self._clock.elapsed_s(now_s)

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
        if self._clock.start(now_s):
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
        if shortcoming:
            return Finish(decision.code, f'{decision.reason}; {shortcoming}', False)
        return Finish(decision.code, decision.reason)

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
