"""Scans with the odometry at their stamps, without the motion during them; late measurements."""

import math
from collections import deque
from dataclasses import dataclass, field, replace
from statistics import median

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.odometry import MAX_ODOMETRY_GAP_NS, OdometryBuffer
from thinmap_ros.core.scan import Scan, of_lasers
from thinmap_ros.core.se2 import SECOND_NS, Array, Mask
from thinmap_ros.core.sensing.beams import LaserMonitor
from thinmap_ros.jit import inlined, kernel

# Largest relative difference between the stated and the measured time of a revolution.
_TOLERANCE = 0.2
_USUAL_SCANS = 15
# Neighbouring beams are on one surface where the range changes by at most this often the distance
# between them: up to an angle of incidence of 70 degrees.
_MAX_SLOPE = 3.0
# A beam stands for its own direction and for half of the way to its neighbours.
_NEAR = 0.75

# Of streams of measurements.
_USUAL_INTERVALS = 5
_GAP_INTERVALS = 3.0  # a longer silence is no low rate
# Two clocks of machines that are not synchronized drift apart by up to 1e-4.
_DRIFT = 2e-4
# A message may overtake another one. Several before the newest stamp: the clock was set back.
_SET_BACK = 2
# Stamps of one source grow. Two that do not, within so long: the diagnostics look once a second.
_MIXED = 2
_MIXED_NS = 2 * SECOND_NS


class SweepTiming:
    """Decides whether the times of the beams that a driver states can be true.

    Simulators state 0, and some drivers state nonsense. The time of a revolution that follows from
    them must be the period of the scans, as the driver states it or as the stamps show it. It
    cannot be longer than the measured one.
    """

    def __init__(self) -> None:
        self._periods_s: deque[float] = deque(maxlen=_USUAL_SCANS)
        self._stamp_ns: int | None = None

    def add(self, scan: Scan) -> None:
        """Add the next scan of the laser."""
        if self._stamp_ns is not None and scan.stamp_ns > self._stamp_ns:
            self._periods_s.append((scan.stamp_ns - self._stamp_ns) / SECOND_NS)
        self._stamp_ns = scan.stamp_ns

    def is_plausible(self, scan: Scan) -> bool:
        """Whether the stated times of the beams can be true."""
        step = abs(scan.angle_increment_rad)
        if scan.beam_period_s == 0.0 or step == 0.0:
            return False
        revolution_s = abs(scan.beam_period_s) * 2.0 * math.pi / step
        measured_s = float(np.median(self._periods_s)) if self._periods_s else 0.0
        if measured_s > 0.0 and revolution_s > (1.0 + _TOLERANCE) * measured_s:
            return False
        return any(
            abs(revolution_s - period_s) <= _TOLERANCE * period_s
            for period_s in (scan.scan_time_s, measured_s)
        )


def deskewed(scan: Scan, stamps_ns: NDArray[np.int64], poses: Array) -> Scan:
    """The scan as a laser had measured it that makes all beams at the stamp of the scan.

    A spinning laser measures its beams one after the other. At 1 rad/s and 7 Hz the last beam
    points 8 degrees aside of where it would have pointed at the stamp. Odometry tells the motion in
    between.
    poses (K, 3): odometry at ascending stamps (K,) that cover the stamp and the times of all beams.
    Beams keep their bearings: the surface between two moved ends gives the range in between. A
    bearing that no beam covers any more is invalid (NaN). Rounded to float32 as `Scan.create` does.
    """
    headings = np.unwrap(poses[:, 2])
    since_s = (stamps_ns - scan.stamp_ns) / SECOND_NS
    beams_s = scan.first_beam_s + scan.beam_period_s * np.arange(scan.ranges_m.size)
    at_s = np.append(beams_s, 0.0)
    values = (poses[:, 0], poses[:, 1], headings)
    bases = np.column_stack([np.interp(at_s, since_s, value) for value in values])
    mount = scan.T_base_laser
    lasers = se2.transform_each(bases, np.tile(mount[:2], (len(bases), 1)))
    moved = _relative(np.column_stack([lasers, bases[:, 2] + mount[2]]))
    step = abs(scan.angle_increment_rad)
    if np.abs(moved[:, 2]).max() < 0.01 * step and np.abs(moved[:, :2]).max() < 1e-4:
        return scan
    fan = (scan.angle_min_rad, scan.angle_increment_rad)
    moved_m = _moved_beams(scan.ranges_m, scan.returned, moved, fan)
    ranges = moved_m.astype(np.float32).astype(np.float64)
    return replace(scan, ranges_m=ranges, beam_period_s=0.0, first_beam_s=0.0)


def _relative(poses: Array) -> Array:
    """Poses (N, 3), without the last one of (N + 1, 3), relative to it."""
    last = poses[-1]
    points = se2.transform_points(se2.invert(last), poses[:-1, :2])
    return np.column_stack([points, poses[:-1, 2] - last[2]])


@inlined
def _range_at(ranges: Array, hit: Mask, x: Array, y: Array, i: int, k: int, angle: float) -> float:
    """Range of beam i at an angle, on the surface between its end and that of its neighbour k."""
    measured: float = ranges[i]
    if not hit[i]:
        return measured
    own = math.hypot(x[i], y[i])
    if k < 0 or k >= ranges.size or not hit[k]:
        return own
    dx = x[k] - x[i]
    dy = y[k] - y[i]
    across = dx * math.sin(angle) - dy * math.cos(angle)
    if across == 0.0 or abs(math.hypot(x[k], y[k]) - own) > _MAX_SLOPE * abs(across):
        return own
    on_surface: float = (dx * y[i] - dy * x[i]) / across
    return on_surface


@kernel
def _moved_beams(ranges: Array, hit: Mask, moved: Array, fan: tuple[float, float]) -> Array:
    """Ranges (N,) of beams after each has moved by a pose (N, 3) of the laser.

    Each direction takes the nearest moved beam. hit (N,); fan: bearing of the first beam, angle
    between beams, rad.
    """
    first, step = fan
    count = ranges.size
    turn = round(2.0 * math.pi / abs(step))
    x = np.empty(count)
    y = np.empty(count)
    at = np.empty(count)  # where a moved beam points, in beams
    for i in range(count):
        angle = first + step * i + moved[i, 2]
        reach = ranges[i] if hit[i] else 0.0
        x[i] = moved[i, 0] + reach * math.cos(angle)
        y[i] = moved[i, 1] + reach * math.sin(angle)
        aside = math.atan2(y[i], x[i]) - angle if hit[i] else 0.0
        aside -= 2.0 * math.pi * round(aside / (2.0 * math.pi))
        at[i] = i + (moved[i, 2] + aside) / step
    found = np.full(count, np.nan)
    nearest = np.full(count, _NEAR)
    for i in range(count):
        below = math.floor(at[i])
        for j in (below, below + 1):
            beam = j - turn if j >= count else (j + turn if j < 0 else j)
            away = abs(j - at[i])
            if 0 <= beam < count and away < nearest[beam]:
                nearest[beam] = away
                found[beam] = _range_at(
                    ranges, hit, x, y, i, i + 1 if j > at[i] else i - 1, first + step * j
                )
    return found


@dataclass(frozen=True, eq=False)
class _Laser:
    """What is known of a laser; first: its first scan."""

    first: Scan
    monitor: LaserMonitor = field(default_factory=LaserMonitor)
    timing: SweepTiming = field(default_factory=SweepTiming)

    def has_made(self, scan: Scan) -> bool:
        """Whether a scan of another frame has the same beams, from the same place."""
        first = self.first
        return (
            np.array_equal(first.T_base_laser, scan.T_base_laser)
            and first.angle_min_rad == scan.angle_min_rad
            and first.angle_increment_rad == scan.angle_increment_rad
        )


class Lasers:
    """What is known of each laser of a robot, by the frame of its scans.

    A laser of several echoes publishes each in a frame of its own: what the first one shows is
    missing in the others.
    """

    def __init__(self) -> None:
        self._by_frame: dict[str, _Laser] = {}

    def of(self, scan: Scan) -> _Laser:
        """What is known of the laser of a scan."""
        known = self._by_frame.get(scan.frame)
        if known is None:
            same = (laser for laser in self._by_frame.values() if laser.has_made(scan))
            known = next(same, None) or _Laser(scan)
            self._by_frame[scan.frame] = known
        return known

    @property
    def warnings(self) -> dict[str, str]:
        """What the lasers or their drivers do otherwise than REP 117, by kind."""
        lasers = self._by_frame.values()
        return of_lasers({laser.first.frame: laser.monitor.warnings for laser in lasers})


class ScanOdometrySynchronizer:
    """Interpolates odometry at the stamp of each scan, in the order of the scans.

    A scan waits until newer odometry has arrived; those of several lasers do so in the order of
    their stamps. One that the laser did not measure is blind (see `LaserMonitor`). Live nodes and
    replay use it alike, so that both process the same pairs.
    """

    def __init__(self, capacity: int = 20) -> None:
        """capacity: scans of a laser that may wait."""
        self._buffer = OdometryBuffer(max_gap_ns=MAX_ODOMETRY_GAP_NS)
        self._lasers = Lasers()
        self._silence_s = 0.0  # since the last scan
        self._waiting: list[Scan] = []
        self._capacity = capacity
        self.dropped = 0

    @property
    def discarded_odometry(self) -> int:
        """Odometry samples whose stamps were ahead of those after them."""
        return self._buffer.discarded

    @property
    def warnings(self) -> dict[str, str]:
        """What the lasers or their drivers do otherwise than REP 117, by kind."""
        return self._lasers.warnings

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
        own = [waiting for waiting in self._waiting if waiting.frame == scan.frame]
        # A scan with a stamp more than a second ahead would block all later ones.
        while own and own[-1].stamp_ns > scan.stamp_ns + SECOND_NS:
            self._drop(own.pop())
        if len(own) >= self._capacity:
            self._drop(own[0])
        self._lasers.of(scan).timing.add(scan)
        self._waiting.insert(self._place(scan), scan)
        return self._ready()

    def finish(self) -> list[tuple[Scan, Array]]:
        """Scans at the end of a log, for whose last beams the odometry has ended."""
        ready = []
        waiting = []
        for scan in self._waiting:
            T_odom_base = self._buffer.interpolate(scan.stamp_ns)
            if T_odom_base is None:
                waiting.append(scan)
            else:
                ready.append(self._complete(scan, T_odom_base))
        self._waiting = waiting
        return ready

    def _place(self, scan: Scan) -> int:
        """Where a scan belongs among those that wait: before later ones of other lasers."""
        place = len(self._waiting)
        for waiting in reversed(self._waiting):
            if waiting.frame == scan.frame or waiting.stamp_ns <= scan.stamp_ns:
                break
            place -= 1
        return place

    def _drop(self, scan: Scan) -> None:
        self._waiting.remove(scan)
        self.dropped += 1

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
            if T_odom_base is None:
                self._drop(scan)
                continue
            self._waiting.pop(0)
            ready.append(self._complete(scan, T_odom_base))
        return ready

    def _complete(self, scan: Scan, T_odom_base: Array) -> tuple[Scan, Array]:
        scan = replace(scan, odometry_silence_s=self._silence_s)
        self._silence_s = 0.0
        checked = self._lasers.of(scan).monitor.checked(scan, T_odom_base)
        return self._deskewed(checked), T_odom_base

    def _needed_until(self, scan: Scan) -> int:
        """Time until which a scan needs odometry, ns."""
        is_plausible = self._lasers.of(scan).timing.is_plausible(scan)
        return scan.end_ns if is_plausible else scan.stamp_ns

    def _deskewed(self, scan: Scan) -> Scan:
        """The scan with all beams at its stamp, if their times and the motion are known."""
        if scan.is_blind or not self._lasers.of(scan).timing.is_plausible(scan):
            return scan
        sweep = self._buffer.between(scan.begin_ns, scan.end_ns)
        return scan if sweep is None else deskewed(scan, *sweep)


class Lateness:
    """How late measurements are received: their age, less its least value before.

    Their clock may be another one than that of the receiver, and may be set: only the change of the
    age counts. Measurements that are late from the first one on cannot be told from another clock.
    late_ns: of the last measurement.
    """

    def __init__(self, limit_ns: int) -> None:
        """limit_ns: up to which the clocks may drift."""
        self.late_ns = 0
        self._limit_ns = limit_ns
        self._least_age_ns: float | None = None
        self._newest_ns = 0
        self._set_back = 0
        self._received_ns = 0

    def add(self, stamp_ns: int, received_ns: int, age_ns: int) -> None:
        """Add a measurement; age_ns: its age when it was received, but for a constant."""
        least_ns = self._least_age_ns
        self._set_back = self._set_back + 1 if stamp_ns < self._newest_ns else 0
        if least_ns is None or self._set_back >= _SET_BACK:
            least_ns = age_ns
            self._newest_ns = stamp_ns
            self._set_back = 0
        elif self.late_ns <= self._limit_ns:
            # Not while it is late: a lasting delay must not become the usual one.
            least_ns += _DRIFT * max(received_ns - self._received_ns, 0)
        self._least_age_ns = min(least_ns, age_ns)
        self.late_ns = round(age_ns - self._least_age_ns)
        self._newest_ns = max(stamp_ns, self._newest_ns)
        self._received_ns = received_ns


class InputStream:
    """The measurements of a source, which a robot needs at least every timeout_ns."""

    def __init__(self, name: str, timeout_ns: int, late_limit_ns: int) -> None:
        """name: in faults. late_limit_ns: how late a measurement may be received."""
        self._name = name
        self._timeout_ns = timeout_ns
        self._late_limit_ns = late_limit_ns
        self._lateness = Lateness(late_limit_ns)
        self._received_ns: int | None = None
        self._stamp_ns: int | None = None
        self._repeated_ns: deque[int] = deque(maxlen=_MIXED)
        self._intervals_ns: deque[int] = deque(maxlen=_USUAL_INTERVALS)

    def add(self, stamp_ns: int, received_ns: int, age_ns: int) -> None:
        """Add a measurement: time at which it was received, and its age then, but for a constant.

        The time is one that does not jump.
        """
        if self._received_ns is not None:
            self._intervals_ns.append(received_ns - self._received_ns)
        self._received_ns = received_ns
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            self._repeated_ns.append(received_ns)
        self._stamp_ns = stamp_ns
        self._lateness.add(stamp_ns, received_ns, age_ns)

    def is_mixed(self, now_ns: int) -> bool:
        """Whether stamps did not grow lately: two sources measure at once."""
        times_ns = self._repeated_ns
        return len(times_ns) == _MIXED and now_ns - times_ns[0] <= _MIXED_NS

    def fault(self, now_ns: int) -> str:
        """Why the robot cannot rely on the measurements; '' for no reason, and before the first."""
        if self._received_ns is None:
            return ''
        silent_ns = now_ns - self._received_ns
        usual_ns = median(self._intervals_ns) if self._is_rate_known() else 0.0
        is_slow = usual_ns > self._timeout_ns
        if is_slow and silent_ns <= _GAP_INTERVALS * usual_ns:
            expected_hz = SECOND_NS / self._timeout_ns
            rate_hz = SECOND_NS / usual_ns
            return f'{self._name} at {rate_hz:.1f} Hz: expected at least {expected_hz:.1f} Hz'
        if silent_ns > self._timeout_ns:
            return f'{self._name} silent for {silent_ns / SECOND_NS:.1f} s'
        late_ns = self._lateness.late_ns
        if late_ns > self._late_limit_ns:
            expected_s = self._late_limit_ns / SECOND_NS
            late_s = late_ns / SECOND_NS
            return f'{self._name} {late_s:.1f} s late: expected at most {expected_s:.1f} s'
        return ''

    def _is_rate_known(self) -> bool:
        return len(self._intervals_ns) == _USUAL_INTERVALS
