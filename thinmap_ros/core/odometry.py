"""Odometry by time: the pose at a scan's stamp from samples around it."""

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_COUNT, Field


class OdometryBuffer:
    """The last few seconds of odometry, looked up by stamp.

    Stamps of real robots step back a little now and then: a sample that comes late is put in its
    place. One that is older than all that is kept means that time was set back (a bag started
    again): the buffer starts anew.
    """

    def __init__(self, span_ns: int = 10_000_000_000) -> None:
        self._span_ns = span_ns
        self._stamps: list[int] = []
        self._poses: list[Array] = []

    @property
    def latest_stamp_ns(self) -> int | None:
        """Stamp of the newest sample, or None where there is none."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp_ns: int, T_odom_base: Array) -> None:
        """Take a sample, (3,).

        Raises InputError where the pose is not finite, or nowhere on earth.
        """
        if not se2.is_bounded_pose(T_odom_base):
            pose = ', '.join(f'{value:g}' for value in T_odom_base.tolist())
            raise InputError(
                f'odometry at {stamp_ns} ns: pose {pose}: expected finite numbers, at most '
                f'{se2.MAX_COORDINATE_M:g} m'
            )
        if self._stamps and stamp_ns < self._stamps[-1] - self._span_ns:
            self._stamps = []
            self._poses = []
        index = bisect_left(self._stamps, stamp_ns)
        if index < len(self._stamps) and self._stamps[index] == stamp_ns:
            self._poses[index] = T_odom_base
            return
        self._stamps.insert(index, stamp_ns)
        self._poses.insert(index, T_odom_base)
        self._forget()

    def at(self, stamp_ns: int) -> Array | None:
        """Pose at a stamp.

        Exact on a sample, interpolated between two, None outside what is known.
        """
        index = bisect_left(self._stamps, stamp_ns)
        if index == len(self._stamps):
            return None
        if self._stamps[index] == stamp_ns:
            return self._poses[index]
        if index == 0:
            return None
        before = self._stamps[index - 1]
        after = self._stamps[index]
        share = (stamp_ns - before) / (after - before)
        return se2.interpolate(self._poses[index - 1], self._poses[index], share)

    def _forget(self) -> None:
        first = bisect_left(self._stamps, self._stamps[-1] - self._span_ns)
        # In blocks, so that a long buffer is not shifted at every sample.
        if first > 256:
            del self._stamps[:first], self._poses[:first]


_FASTEST_M_S = 3.0
_STEP_BACK_NS = 1_000_000_000
_LONGEST_GAP_NS = 120_000_000_000
_JUMP_M = 0.5  # where odometry says more than this and that speed, it was set anew
FIELDS = {
    'stamp_ns': Field(np.int64, (), 0, MAX_COUNT),
    'T_map_odom': Field(np.float64, (3,), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'T_odom_base': Field(np.float64, (3,), -MAX_COORDINATE_M, MAX_COORDINATE_M),
}


@dataclass(frozen=True, eq=False)
class OdometryAnchor:
    """Where odometry lay in the map, T_map_odom (3,), when it said T_odom_base (3,) at stamp_ns."""

    stamp_ns: int
    T_map_odom: Array
    T_odom_base: Array

    def state(self) -> dict[str, NDArray[Any]]:
        """All of it as arrays; `from_state` makes an equal one."""
        return {
            'stamp_ns': np.array(self.stamp_ns),
            'T_map_odom': self.T_map_odom,
            'T_odom_base': self.T_odom_base,
        }

    @staticmethod
    def from_state(state: Mapping[str, NDArray[Any]]) -> 'OdometryAnchor':
        """Return the pose of a `state`. Raises InputError where it is none."""
        own = snapshot.check(state, FIELDS, 'pose')
        return OdometryAnchor(int(own['stamp_ns']), own['T_map_odom'], own['T_odom_base'])

    def is_continuous_with(self, stamp_ns: int, T_odom_base: Array) -> bool:
        """Whether a later odometry pose can be of the same drive.

        It is not before, not long after, not too far away.
        """
        gap_ns = stamp_ns - self.stamp_ns
        moved = math.dist(self.T_odom_base[:2], T_odom_base[:2])
        return 0 <= gap_ns <= _LONGEST_GAP_NS and moved <= _JUMP_M + _FASTEST_M_S * gap_ns / 1e9


@dataclass(frozen=True, eq=False)
class OdometryIncrement:
    """What odometry tells of the motion since the scan before.

    T_before_base (3,), in so many seconds. bound_m: 0, or where odometry was set anew and tells
    nothing, how far the robot may have come.
    """

    T_before_base: Array
    seconds: float
    discontinuity_m: float


class OdometryIncrements:
    """Motions from scan to scan by the odometry poses at their stamps.

    What is not finite, or faster than any robot, is refused and counted in `refused`.
    """

    def __init__(self) -> None:
        self.refused = 0
        self.T_odom_base: Array = np.zeros(3)  # of the last scan
        self._is_begun = False
        self.stamp_ns: int | None = None  # of the last scan

    def next(self, stamp_ns: int, T_odom_base: Array) -> OdometryIncrement:
        """The motion up to an odometry pose (3,) at a stamp; none up to the first."""
        seconds = 0.0 if self.stamp_ns is None else (stamp_ns - self.stamp_ns) / 1e9
        self.stamp_ns = stamp_ns
        if not se2.is_finite(T_odom_base):
            self.refused += 1
            return OdometryIncrement(np.zeros(3), seconds, 0.0)
        before = self.T_odom_base if self._is_begun else T_odom_base
        self._is_begun = True
        self.T_odom_base = np.array(T_odom_base, dtype=np.float64)
        # Text logs, bags and messages differ by less, and are to lead to the same.
        moved = np.round(se2.between(before, self.T_odom_base), 9)
        discontinuity_m = _JUMP_M + _FASTEST_M_S * max(seconds, 1.0)
        if math.hypot(moved[0], moved[1]) <= discontinuity_m:
            return OdometryIncrement(moved, seconds, 0.0)
        self.refused += 1
        return OdometryIncrement(np.zeros(3), seconds, discontinuity_m)


class ScanOdometrySynchronizer:
    """Brings each scan together with the odometry pose at its stamp, in the order of the scans.

    A scan waits until odometry as new as itself has come. Used live and in replay alike, so that
    both see the same.
    """

    def __init__(self, capacity: int = 20) -> None:
        self._buffer = OdometryBuffer()
        self._waiting: deque[Scan] = deque()
        self._capacity = capacity
        self.dropped = 0

    @property
    def waiting(self) -> int:
        """Scans that wait for odometry."""
        return len(self._waiting)

    def add_odometry(self, stamp_ns: int, T_odom_base: Array) -> list[tuple[Scan, Array]]:
        """Take an odometry sample.

        Returns the scans that are ready now, each with its T_odom_base (3,).
        """
        self._buffer.add(stamp_ns, T_odom_base)
        return self._ready()

    def add_scan(self, scan: Scan) -> list[tuple[Scan, Array]]:
        """Take a scan; returns the scans that are ready now, each with its T_odom_base (3,)."""
        # A scan whose stamp lies in the future of all that come after it would keep them waiting.
        while self._waiting and self._waiting[-1].stamp_ns > scan.stamp_ns + _STEP_BACK_NS:
            self._waiting.pop()
            self.dropped += 1
        self._waiting.append(scan)
        if len(self._waiting) > self._capacity:
            self._waiting.popleft()
            self.dropped += 1
        return self._ready()

    def _ready(self) -> list[tuple[Scan, Array]]:
        ready = []
        latest = self._buffer.latest_stamp_ns
        while self._waiting and latest is not None:
            scan = self._waiting[0]
            T_odom_base = self._buffer.at(scan.stamp_ns)
            if T_odom_base is None and scan.stamp_ns > latest:
                break
            self._waiting.popleft()
            if T_odom_base is None:
                self.dropped += 1
            else:
                ready.append((scan, T_odom_base))
        return ready
