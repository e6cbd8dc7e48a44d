"""Faults of the messages of laser, odometry, clock and wheels."""

from array import array
from collections import deque
from typing import Any

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.ros import messages

_BLIND = {'laser_nan': np.nan, 'laser_zero': 0.0, 'laser_inf': np.inf}
_DROP = 0.5
_COPIES = 4
_MEMORY = 10
_STAMPS_S = 5.0
_ONE_STAMP_S = 9.0
_LATE_S = (1.0, 5.0)
_MINUTE_S = 61.0


class LateMessages:
    """Holds messages back by stream, which keep their stamps.

    delay_ns: 0 once the fault is over; what was held back then comes at once.
    """

    def __init__(self) -> None:
        self.delay_ns = 0
        self._held: dict[str, deque[Any]] = {}

    @property
    def is_used(self) -> bool:
        """Whether messages are held back, or some still are."""
        return self.delay_ns > 0 or any(self._held.values())

    def passed(self, stream: str, message: Any) -> list[Any]:
        """Messages of a stream that are due when another arrives."""
        held = self._held.setdefault(stream, deque())
        held.append(message)
        now_ns = messages.stamp_ns(message.header.stamp)
        due = []
        while held and messages.stamp_ns(held[0].header.stamp) <= now_ns - self.delay_ns:
            due.append(held.popleft())
        return due


class StreamFaults:
    """Passes messages on, or what a fault makes of them.

    Clock, scans and odometry share an offset of time, and odometry has an offset T_new_odom (3,):
    what is left of faults that are over.
    """

    def __init__(self, offset_ns: int) -> None:
        self.offset_ns = offset_ns
        self._kind = ''
        self._rng = np.random.default_rng()
        self._T_new_odom: Array = np.zeros(3)
        self._frozen: array[float] | None = None
        self._shift_ns = 0
        self._late = LateMessages()
        self._is_due = False
        self._recent: dict[str, deque[Any]] = {
            'scan': deque(maxlen=_MEMORY),
            'odom': deque(maxlen=_MEMORY),
        }

    def begin(self, kind: str, seed: int) -> None:
        """Begin a fault; those of one moment happen at once."""
        self._kind = kind
        self._rng = np.random.default_rng(seed)
        self._is_due = True
        self._frozen = None
        if kind == 'odom_jump':
            way_m = float(self._rng.uniform(0.1, 5.0))
            angle = float(self._rng.uniform(-np.pi, np.pi))
            turn = float(self._rng.uniform(-1.5, 1.5))
            jump = se2.pose(way_m * np.cos(angle), way_m * np.sin(angle), turn)
            self._T_new_odom = se2.compose(jump, self._T_new_odom)
        elif kind == 'clock_ahead':
            self.offset_ns += int(self._rng.uniform(1.0, 20.0) * SECOND_NS)
        elif kind == 'clock_minute':
            self.offset_ns += int(_MINUTE_S * SECOND_NS)
        elif kind == 'late_data':
            self._late.delay_ns = int(self._rng.uniform(*_LATE_S) * SECOND_NS)
        elif kind == 'clock_back':
            self.offset_ns -= int(self._rng.uniform(2.0, 20.0) * SECOND_NS)
        elif kind == 'odom_stamps':
            size_s = 10.0 ** self._rng.uniform(-1.0, 1.0)
            self._shift_ns = int(self._rng.choice([1, -1]) * size_s * SECOND_NS)

    def end(self) -> None:
        """End the fault."""
        self._kind = ''
        self._late.delay_ns = 0

    @property
    def is_silent(self) -> bool:
        """Whether a sensor is silent or late, which is no loss of single messages."""
        return self._kind.startswith(('silent', 'late'))

    @property
    def blocks_wheels(self) -> bool:
        """Whether commands have no effect."""
        return self._kind == 'wheels_blocked'

    def clock(self, stamp_ns: int) -> int:
        """Time of /clock."""
        return stamp_ns + self.offset_ns

    def scan(self, message: Any) -> list[Any]:
        """Scans to publish in place of a scan."""
        self._shift(message, self.offset_ns)
        ranges = message.ranges
        if self._kind in _BLIND:
            message.ranges = array('f', len(ranges) * [_BLIND[self._kind]])
        elif self._kind == 'laser_max':
            message.ranges = array('f', len(ranges) * [message.range_max])
        elif self._kind == 'laser_frozen':
            self._frozen = self._frozen or array('f', ranges)
            message.ranges = self._frozen
        elif self._kind == 'scan_stamps':
            self._shift(message, int(_STAMPS_S * SECOND_NS))
        return self._passed('scan', message)

    def odometry(self, message: Any) -> list[Any]:
        """Odometry to publish in place of a message."""
        self._shift(message, self.offset_ns)
        pose = message.pose.pose
        T_new_base = se2.compose(self._T_new_odom, messages.pose_from_msg(pose))
        pose.position.x = float(T_new_base[0])
        pose.position.y = float(T_new_base[1])
        pose.orientation = messages.quaternion_msg(float(T_new_base[2]))
        if self._kind == 'odom_stamps':
            self._shift(message, self._shift_ns)
        elif self._kind == 'odom_one_stamp' and self._is_due:
            self._is_due = False
            self._shift(message, int(_ONE_STAMP_S * SECOND_NS))
        return self._passed('odom', message)

    def _passed(self, stream: str, message: Any) -> list[Any]:
        """The message, or none, or several copies, some of earlier messages."""
        recent = self._recent[stream]
        recent.append(message)
        if self._late.is_used:
            return self._late.passed(stream, message)
        if self._kind == f'silent_{stream}':
            return []
        if self._kind == f'drop_{stream}' and self._rng.random() < _DROP:
            return []
        if self._kind != f'repeat_{stream}':
            return [message]
        copies = int(self._rng.integers(_COPIES))
        again = [recent[int(self._rng.integers(len(recent)))] for _ in range(copies)]
        return [message, *again]

    @staticmethod
    def _shift(message: Any, shift_ns: int) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp) + shift_ns
        message.header.stamp = messages.time_msg(max(stamp_ns, 0))
