"""Scans with the odometry at their stamps."""

from collections import deque
from dataclasses import replace

from thinmap_ros.core.odometry import MAX_ODOMETRY_GAP_NS, OdometryBuffer
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.sensing.beams import LaserMonitor
from thinmap_ros.core.sensing.deskewing import SweepTiming, deskewed


class ScanOdometrySynchronizer:
    """Interpolates odometry at the stamp of each scan, in the order of the scans.

    A scan waits until newer odometry has arrived. One that the laser did not measure is blind (see
    `LaserMonitor`). Live nodes and replay use it alike, so that both process the same pairs.
    """

    def __init__(self, capacity: int = 20) -> None:
        self._buffer = OdometryBuffer(max_gap_ns=MAX_ODOMETRY_GAP_NS)
        self._laser = LaserMonitor()
        self._timing = SweepTiming()
        self._silence_s = 0.0  # since the last scan
        self._waiting: deque[Scan] = deque()
        self._capacity = capacity
        self.dropped = 0

    @property
    def discarded_odometry(self) -> int:
        """Odometry samples whose stamps were ahead of those after them."""
        return self._buffer.discarded

    @property
    def warnings(self) -> dict[str, str]:
        """What the laser or its driver do otherwise than REP 117, by kind."""
        return self._laser.warnings

    @property
    def waiting(self) -> int:
        """Scans that wait for odometry."""
        return len(self._waiting)

    def add_odometry(self, stamp_ns: int, T_odom_base: Array) -> list[tuple[Scan, Array]]:
        """Take an odometry sample.

        Returns the scans that are ready now, each with its T_odom_base (3,).
        """
        self._silence_s += self._buffer.add(stamp_ns, T_odom_base)
        return self._ready()

    def add_scan(self, scan: Scan) -> list[tuple[Scan, Array]]:
        """Add a scan; returns the scans that are ready now, each with its T_odom_base (3,)."""
        # A scan with a stamp more than a second ahead would block all later ones.
        while self._waiting and self._waiting[-1].stamp_ns > scan.stamp_ns + SECOND_NS:
            self._waiting.pop()
            self.dropped += 1
        self._timing.add(scan)
        self._waiting.append(scan)
        if len(self._waiting) > self._capacity:
            self._waiting.popleft()
            self.dropped += 1
        return self._ready()

    def finish(self) -> list[tuple[Scan, Array]]:
        """Scans at the end of a log, for whose last beams the odometry has ended."""
        ready = []
        for scan in self._waiting:
            T_odom_base = self._buffer.interpolate(scan.stamp_ns)
            if T_odom_base is not None:
                ready.append(self._complete(scan, T_odom_base))
        paired = {scan.stamp_ns for scan, _ in ready}
        self._waiting = deque(scan for scan in self._waiting if scan.stamp_ns not in paired)
        return ready

    def _ready(self) -> list[tuple[Scan, Array]]:
        ready = []
        latest = self._buffer.latest_stamp_ns
        while self._waiting and latest is not None:
            scan = self._waiting[0]
            T_odom_base = self._buffer.interpolate(scan.stamp_ns)
            if latest < self._needed_until(scan) or (
                T_odom_base is None and scan.stamp_ns > latest
            ):
                break
            self._waiting.popleft()
            if T_odom_base is None:
                self.dropped += 1
            else:
                ready.append(self._complete(scan, T_odom_base))
        return ready

    def _complete(self, scan: Scan, T_odom_base: Array) -> tuple[Scan, Array]:
        scan = replace(scan, odometry_silence_s=self._silence_s)
        self._silence_s = 0.0
        checked = self._laser.checked(scan, T_odom_base)
        return self._deskewed(checked), T_odom_base

    def _needed_until(self, scan: Scan) -> int:
        """Time until which a scan needs odometry, ns."""
        return scan.end_ns if self._timing.is_plausible(scan) else scan.stamp_ns

    def _deskewed(self, scan: Scan) -> Scan:
        """The scan with all beams at its stamp, if their times and the motion are known."""
        if scan.is_blind or not self._timing.is_plausible(scan):
            return scan
        sweep = self._buffer.between(scan.begin_ns, scan.end_ns)
        return scan if sweep is None else deskewed(scan, *sweep)
