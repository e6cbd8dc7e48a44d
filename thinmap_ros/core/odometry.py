"""Odometry by time: the pose at a scan's stamp from samples around it."""

from bisect import bisect_left
from collections import deque

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array


class OdometryBuffer:
    """The last few seconds of odometry, looked up by stamp.

    Stamps of real robots step back a little now and then: a sample that comes late is put in its place. One that
    is older than all that is kept means that time was set back (a bag started again): the buffer starts anew.
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
        """Take a sample, (3,). Raises InputError where the pose is not finite."""
        if not se2.is_finite(T_odom_base):
            raise InputError(f'odometry at {stamp_ns} ns: pose {list(T_odom_base)}: expected finite numbers')
        if self._stamps and stamp_ns < self._stamps[-1] - self._span_ns:
            self._stamps, self._poses = [], []
        index = bisect_left(self._stamps, stamp_ns)
        if index < len(self._stamps) and self._stamps[index] == stamp_ns:
            self._poses[index] = T_odom_base
            return
        self._stamps.insert(index, stamp_ns)
        self._poses.insert(index, T_odom_base)
        self._forget()

    def at(self, stamp_ns: int) -> Array | None:
        """Pose at a stamp: exact on a sample, interpolated between two, None outside what is known."""
        index = bisect_left(self._stamps, stamp_ns)
        if index == len(self._stamps):
            return None
        if self._stamps[index] == stamp_ns:
            return self._poses[index]
        if index == 0:
            return None
        before, after = self._stamps[index - 1], self._stamps[index]
        share = (stamp_ns - before) / (after - before)
        return se2.interpolate(self._poses[index - 1], self._poses[index], share)

    def _forget(self) -> None:
        first = bisect_left(self._stamps, self._stamps[-1] - self._span_ns)
        # In blocks, so that a long buffer is not shifted at every sample.
        if first > 256:
            del self._stamps[:first], self._poses[:first]


class ScanPairing:
    """Brings each scan together with the odometry pose at its stamp, in the order in which the scans came.

    A scan waits until odometry as new as itself has come. Used live and in replay alike, so that both see the same.
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
        """Take an odometry sample; returns the scans that are ready now, each with its T_odom_base (3,)."""
        self._buffer.add(stamp_ns, T_odom_base)
        return self._ready()

    def add_scan(self, scan: Scan) -> list[tuple[Scan, Array]]:
        """Take a scan; returns the scans that are ready now, each with its T_odom_base (3,)."""
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
