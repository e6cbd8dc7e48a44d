"""Odometry at the stamps of scans, and its increments from scan to scan."""

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
from thinmap_ros.core.laser_monitor import LaserMonitor
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_COUNT, Field
from thinmap_ros.core.stamps import SECOND_NS


class OdometryBuffer:
    """The last few seconds of odometry, looked up by stamp.

    Stamps of real robots step back a little now and then: a late sample is inserted in order. A
    sample much older than the newest one means that time was set back (a bag was restarted), or
    that the stamps before it were wrong: the buffer is cleared.
    discarded: number of samples with such stamps.
    """

    def __init__(self, span_ns: int = 10_000_000_000, max_gap_ns: int | None = None) -> None:
        """max_gap_ns: longest time that is interpolated, and that a stamp may step back.

        None: any within the span.
        """
        self.discarded = 0
        self._span_ns = span_ns
        self._max_gap_ns = max_gap_ns
        self._stamps: list[int] = []
        self._poses: list[Array] = []

    @property
    def latest_stamp_ns(self) -> int | None:
        """Stamp of the newest sample, or None where there is none."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp_ns: int, T_odom_base: Array) -> None:
        """Add a sample, (3,).

        Raises InputError if the pose is not finite, or beyond MAX_COORDINATE_M.
        """
        if not se2.is_bounded_pose(T_odom_base):
            pose = ', '.join(f'{value:g}' for value in T_odom_base.tolist())
            raise InputError(
                f'odometry at {stamp_ns} ns: pose {pose}: expected finite numbers, at most '
                f'{se2.MAX_COORDINATE_M:g} m'
            )
        if self._stamps and stamp_ns < self._stamps[-1] - (self._max_gap_ns or self._span_ns):
            self.discarded += len(self._stamps) - bisect_left(self._stamps, stamp_ns)
            self._stamps = []
            self._poses = []
        index = bisect_left(self._stamps, stamp_ns)
        if index < len(self._stamps) and self._stamps[index] == stamp_ns:
            self._poses[index] = T_odom_base
            return
        self._stamps.insert(index, stamp_ns)
        self._poses.insert(index, T_odom_base)
        self._drop_old()

    def interpolate(self, stamp_ns: int) -> Array | None:
        """Pose at a stamp.

        Exact at a sample, interpolated between two, None outside the buffer and in a long gap.
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
        if self._max_gap_ns is not None and after - before > self._max_gap_ns:
            return None
        share = (stamp_ns - before) / (after - before)
        return se2.interpolate(self._poses[index - 1], self._poses[index], share)

    def _drop_old(self) -> None:
        first = bisect_left(self._stamps, self._stamps[-1] - self._span_ns)
        # In blocks, so that a long buffer is not shifted at every sample.
        if first > 256:
            del self._stamps[:first], self._poses[:first]


# Between samples that are further apart, the robot need not have moved evenly. Odometry at 1 Hz is
# interpolated, with one lost sample.
MAX_ODOMETRY_GAP_NS = 2 * SECOND_NS

FIELDS = {
    'stamp_ns': Field(np.int64, (), 0, MAX_COUNT),
    'T_map_odom': Field(np.float64, (3,), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'T_odom_base': Field(np.float64, (3,), -MAX_COORDINATE_M, MAX_COORDINATE_M),
}


@dataclass(frozen=True)
class OdometryLimits:
    """Motion that odometry can report of one drive; a larger one is a discontinuity."""

    jump_m: float = 0.5
    max_speed_m_s: float = 3.0
    max_gap_ns: int = 120_000_000_000

    def distance_m(self, seconds: float) -> float:
        """Largest distance between two samples so many seconds apart, m.

        After a longer gap than `max_gap_ns` it is not larger: nobody has seen that drive.
        """
        return self.jump_m + self.max_speed_m_s * min(seconds, self.max_gap_ns / SECOND_NS)


_LIMITS = OdometryLimits()


@dataclass(frozen=True, eq=False)
class OdometryAnchor:
    """T_map_odom (3,), with the odometry pose T_odom_base (3,) and the stamp that it holds for."""

    stamp_ns: int
    T_map_odom: Array
    T_odom_base: Array

    def state(self) -> dict[str, NDArray[Any]]:
        """Its values as arrays; `from_state` restores them."""
        return {
            'stamp_ns': np.array(self.stamp_ns),
            'T_map_odom': self.T_map_odom,
            'T_odom_base': self.T_odom_base,
        }

    @staticmethod
    def from_state(state: Mapping[str, NDArray[Any]]) -> 'OdometryAnchor':
        """Restore an anchor from its `state`. Raises InputError if the state is invalid."""
        own = snapshot.validate(state, FIELDS, 'pose')
        return OdometryAnchor(int(own['stamp_ns']), own['T_map_odom'], own['T_odom_base'])

    def is_continuous_with(self, stamp_ns: int, T_odom_base: Array) -> bool:
        """Whether an odometry pose can belong to the same drive.

        It is not earlier, not much later, and not too far away.
        """
        gap_ns = stamp_ns - self.stamp_ns
        moved = math.dist(self.T_odom_base[:2], T_odom_base[:2])
        return 0 <= gap_ns <= _LIMITS.max_gap_ns and moved <= _LIMITS.distance_m(gap_ns / 1e9)


@dataclass(frozen=True, eq=False)
class OdometryIncrement:
    """Motion since the previous scan, by odometry.

    T_before_base (3,), within `seconds`. discontinuity_m: 0; after an odometry discontinuity, where
    the increment is unknown, the distance (m) that the robot may have travelled.
    """

    T_before_base: Array
    seconds: float
    discontinuity_m: float


class OdometryIncrements:
    """Motion from scan to scan, from the odometry poses at their stamps.

    Increments that are not finite, or faster than any robot, are counted in `rejected`.
    """

    def __init__(self) -> None:
        self.rejected = 0
        self.T_odom_base: Array = np.zeros(3)  # of the last scan
        self._is_begun = False
        self.stamp_ns: int | None = None  # of the last scan

    def add(self, stamp_ns: int, T_odom_base: Array) -> OdometryIncrement:
        """Increment up to an odometry pose (3,) at a stamp; zero for the first one."""
        seconds = 0.0 if self.stamp_ns is None else (stamp_ns - self.stamp_ns) / 1e9
        self.stamp_ns = stamp_ns
        if not se2.is_finite(T_odom_base):
            self.rejected += 1
            return OdometryIncrement(np.zeros(3), seconds, 0.0)
        before = self.T_odom_base if self._is_begun else T_odom_base
        self._is_begun = True
        self.T_odom_base = np.array(T_odom_base, dtype=np.float64)
        # Rounded, so that text logs, bags and messages give identical results.
        moved = np.round(se2.between(before, self.T_odom_base), 9)
        discontinuity_m = _LIMITS.distance_m(max(seconds, 1.0))
        if math.hypot(moved[0], moved[1]) <= discontinuity_m:
            return OdometryIncrement(moved, seconds, 0.0)
        self.rejected += 1
        return OdometryIncrement(np.zeros(3), seconds, discontinuity_m)


class ScanOdometrySynchronizer:
    """Interpolates odometry at the stamp of each scan, in the order of the scans.

    A scan waits until newer odometry has arrived. One that the laser did not measure is blind (see
    `LaserMonitor`). Live nodes and replay use it alike, so that both process the same pairs.
    """

    def __init__(self, capacity: int = 20) -> None:
        self._buffer = OdometryBuffer(max_gap_ns=MAX_ODOMETRY_GAP_NS)
        self._laser = LaserMonitor()
        self._waiting: deque[Scan] = deque()
        self._capacity = capacity
        self.dropped = 0

    @property
    def discarded_odometry(self) -> int:
        """Odometry samples whose stamps were ahead of those after them."""
        return self._buffer.discarded

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
        """Add a scan; returns the scans that are ready now, each with its T_odom_base (3,)."""
        # A scan with a stamp more than a second ahead would block all later ones.
        while self._waiting and self._waiting[-1].stamp_ns > scan.stamp_ns + SECOND_NS:
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
            T_odom_base = self._buffer.interpolate(scan.stamp_ns)
            if T_odom_base is None and scan.stamp_ns > latest:
                break
            self._waiting.popleft()
            if T_odom_base is None:
                self.dropped += 1
            else:
                ready.append((self._laser.checked(scan, T_odom_base), T_odom_base))
        return ready
