"""Bases that move more than they are commanded: too fast, or while they are to stand."""

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from thinmap_ros.core import se2
from thinmap_ros.core.odometry import OdometryLimits
from thinmap_ros.core.planning.navigator import SENSOR_DELAY_NS, NavigatorConfig
from thinmap_ros.core.se2 import SECOND_NS, Array

# Dead time of base and network together: with 0.8 s the simulated robot still follows its paths.
_DEAD_TIME_S = 1.0
# Speed controllers overshoot by up to a fifth, wheels are up to a tenth larger than configured.
_TOLERANCE = 1.3
# A pose of the odometry at 0.5 m/s with a stamp that is wrong by 0.1 s is off by half of this, at
# both ends of a window.
_SLACK_M = 0.1
# A base at twice the usual 0.5 m/s exceeds the slack within the first, one that creeps at 0.04 m/s
# within the second.
_WINDOWS_S = (1.0, 3.0)
_STEP_S = 0.08  # several samples of a fast odometry, one of a slow one
_MIN_STEPS = 3
# Of the steps in a window, one in five may be a jump of the odometry, which does not count; a base
# that moves does so in all of them. Two jumps within the slack do not matter.
_JUMPS = 5
_JUMP_M = 0.5 * _SLACK_M
# The navigator stands in front of obstacles for a base that brakes as the controller does: half as
# hard is accepted.
_BRAKING = 0.5
# Of a robot that somebody else drives.
_ANY_SPEED_M_S = OdometryLimits.max_speed_m_s


class _Command(NamedTuple):
    """Speed that was commanded until a time, m/s, s."""

    speed_m_s: float
    until_s: float


class _Step(NamedTuple):
    """Motion between two samples: x, y (m, odometry frame), turn (rad), duration and allowed path.

    at_s: stamp of its end.
    """

    at_s: float
    dx: float
    dy: float
    turn: float
    dt_s: float
    allowed_m: float


class _Motion(NamedTuple):
    """Path (m) and turn (rad) in some time (s), and the path that was allowed (m)."""

    path_m: float
    turn: float
    seconds: float
    allowed_m: float

    def exceeds(self, lever_m: float) -> bool:
        """Whether it is more than was commanded, with turns at a lever."""
        path_m = max(self.path_m, lever_m * self.turn)
        return path_m > max(_TOLERANCE * self.allowed_m, self.allowed_m + _SLACK_M)

    def words(self, lever_m: float, is_to_stand: bool) -> str:
        """What is wrong with it."""
        is_turn = lever_m * self.turn > self.path_m
        unit, scale = ('rad/s', lever_m) if is_turn else ('m/s', 1.0)
        amount = (self.turn if is_turn else self.path_m) / self.seconds
        commanded_m_s = self.allowed_m / self.seconds / scale
        order = f'commanded at most {commanded_m_s:.2f} {unit}'
        if is_to_stand:
            order = 'and is commanded to stand'
        return f'the base {"turns" if is_turn else "moves"} at {amount:.2f} {unit}, {order}'


@dataclass(frozen=True)
class _Limits:
    """Lever of turns (m), least braking (m/s^2), and how long a command may take to act (s)."""

    lever_m: float
    braking_m_s2: float
    latency_s: float

    @staticmethod
    def of(config: NavigatorConfig) -> '_Limits':
        return _Limits(
            config.planner.robot_radius_m,
            _BRAKING * config.controller.max_acceleration_m_s2,
            max(config.reaction_time_s, _DEAD_TIME_S) + SENSOR_DELAY_NS / SECOND_NS,
        )


class BaseSupervisor:
    """Compares the odometry with the commands: the path of the outermost point of the robot.

    A speed counts as commanded for the time that a command may take to act, and then falls as a
    base brakes. A robot that moves less than commanded is no case of this: see `StuckDetector`.

    fault: what is wrong; '' for nothing. is_creeping: whether the base moves and is to stand; this
    ends when it stands. is_fast: whether it has driven too fast; this ends at `release`.
    """

    def __init__(self, config: NavigatorConfig) -> None:
        self.fault = ''
        self.is_creeping = False
        self.is_fast = False
        self._limits = _Limits.of(config)
        self._speed_m_s: float | None = None  # commanded last; None: nothing yet
        self._is_unheard = False
        self._earlier: deque[_Command] = deque()
        self._last: tuple[float, Array] | None = None
        self._steps: deque[_Step] = deque()

    def set_config(self, config: NavigatorConfig) -> None:
        """Continue with other limits."""
        self._limits = _Limits.of(config)

    def release(self) -> None:
        """Forget the fault, and the motion so far: somebody has seen to it."""
        self.fault = ''
        self.is_creeping = False
        self.is_fast = False
        self._steps.clear()

    def add_command(self, now_s: float, v: float, w: float) -> None:
        """Add a command, v m/s, w rad/s, at a time that does not jump."""
        speed_m_s = abs(v) + self._limits.lever_m * abs(w)
        if self._speed_m_s == speed_m_s:
            return
        if self._speed_m_s:
            self._earlier.append(_Command(self._speed_m_s, now_s))
        self._speed_m_s = speed_m_s

    def set_unheard(self, now_s: float, is_unheard: bool) -> None:
        """Whether somebody else may command the base now: any speed is allowed.

        At the end of that, the speed that it has then.
        """
        if self._is_unheard and not is_unheard and self._steps:
            since_s = self._steps[-1].at_s - _WINDOWS_S[0]
            recent = [step for step in self._steps if step.at_s > since_s]
            fastest = max(self._step_m(step) / step.dt_s for step in recent)
            self._earlier.append(_Command(min(fastest, _ANY_SPEED_M_S), now_s))
        self._is_unheard = is_unheard

    def add_odometry(self, now_s: float, stamp_ns: int, T_odom_base: Array) -> None:
        """Add a sample, T_odom_base (3,), that is received now; compare."""
        stamp_s = stamp_ns / SECOND_NS
        if self._last is None or abs(stamp_s - self._last[0]) > _WINDOWS_S[-1]:
            self._last = (stamp_s, T_odom_base)
            self._steps.clear()
        last_s, before = self._last
        if stamp_s - last_s < _STEP_S or self._speed_m_s is None:
            return
        self._last = (stamp_s, T_odom_base)
        dx, dy, turn = (T_odom_base - before).tolist()
        dt_s = stamp_s - last_s
        allowed_m = dt_s * self._commanded(now_s)
        self._steps.append(_Step(stamp_s, dx, dy, se2.wrap(turn), dt_s, allowed_m))
        while self._steps[0].at_s <= stamp_s - _WINDOWS_S[-1]:
            self._steps.popleft()
        self._compare(stamp_s)
        if self._stands(stamp_s):
            # What was commanded so long ago does not act any more.
            self._forget(now_s - self._limits.latency_s)

    def _commanded(self, now_s: float) -> float:
        """Highest speed that may still be due to a command, m/s."""
        assert self._speed_m_s is not None
        if self._is_unheard:
            return _ANY_SPEED_M_S
        braking = self._limits.braking_m_s2
        acts_s = now_s - self._limits.latency_s
        fastest = max((each.speed_m_s for each in self._earlier), default=0.0)
        self._forget(acts_s - fastest / braking)
        speeds = [
            each.speed_m_s - braking * max(acts_s - each.until_s, 0.0) for each in self._earlier
        ]
        return max([self._speed_m_s, *speeds])

    def _forget(self, before_s: float) -> None:
        while self._earlier and self._earlier[0].until_s < before_s:
            self._earlier.popleft()

    def _compare(self, stamp_s: float) -> None:
        lever_m = self._limits.lever_m
        is_to_stand = self._speed_m_s == 0.0
        motions = [self._motion(stamp_s - window_s) for window_s in _WINDOWS_S]
        excess = next((motion for motion in motions if motion.exceeds(lever_m)), None)
        if excess is not None:
            self.is_creeping = is_to_stand
        elif self._stands(stamp_s):
            self.is_creeping = False
        if self.is_fast:
            return
        if excess is not None:
            self.is_fast = not is_to_stand
            self.fault = excess.words(lever_m, is_to_stand)
        elif not self.is_creeping:
            self.fault = ''

    def _motion(self, since_s: float) -> _Motion:
        """Motion in the steps since a stamp, without the largest ones; none in too few steps."""
        steps = [step for step in self._steps if step.at_s > since_s]
        if len(steps) < _MIN_STEPS:
            return _Motion(0.0, 0.0, 0.0, 0.0)
        steps.sort(key=self._step_m)
        most = math.ceil(len(steps) / _JUMPS)
        kept = steps[:-most] + [step for step in steps[-most:] if self._step_m(step) < _JUMP_M]
        return _Motion(
            math.hypot(sum(step.dx for step in kept), sum(step.dy for step in kept)),
            abs(sum(step.turn for step in kept)),
            sum(step.dt_s for step in kept),
            sum(step.allowed_m for step in kept),
        )

    def _step_m(self, step: _Step) -> float:
        return max(math.hypot(step.dx, step.dy), self._limits.lever_m * abs(step.turn))

    def _stands(self, stamp_s: float) -> bool:
        """Whether the robot has not moved in the first window, but for noise."""
        motion = self._motion(stamp_s - _WINDOWS_S[0])
        path_m = max(motion.path_m, self._limits.lever_m * motion.turn)
        return motion.seconds > 0.0 and path_m < _SLACK_M / _WINDOWS_S[-1]
