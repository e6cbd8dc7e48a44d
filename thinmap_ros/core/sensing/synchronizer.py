"""Scans with the odometry at their stamps, without the motion during them; late measurements."""

import math
from collections import Counter, defaultdict, deque
from collections.abc import Collection
from copy import deepcopy
from dataclasses import dataclass, field, replace
from statistics import median

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import counted
from thinmap_ros.core.odometry import MAX_ODOMETRY_GAP_NS, Missing, OdometryBuffer, TiltBuffer
from thinmap_ros.core.scan import TILTED, Scan, laser_names, of_lasers
from thinmap_ros.core.se2 import SECOND_NS, Array, Mask
from thinmap_ros.core.sensing.beams import LaserMonitor
from thinmap_ros.core.sensing.delay import DelayEstimator
from thinmap_ros.core.stage import Estimate
from thinmap_ros.jit import inlined, kernel

# Of its scans, a robot whose IMU is not askew makes at least so many on level ground.
_LEVEL_SHARE = 0.1
_MAX_OVERDUE = 10_000  # stamps of scans whose odometry may still come
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
        measured_s = median(self._periods_s) if self._periods_s else 0.0
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
    since_s = (stamps_ns - scan.odometry_ns) / SECOND_NS
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


@dataclass(eq=False)
class _Laser:
    """What is known of a laser; frame, last: of its first scan, and its last one."""

    frame: str
    last: Scan
    monitor: LaserMonitor = field(default_factory=LaserMonitor)
    timing: SweepTiming = field(default_factory=SweepTiming)

    def has_made(self, scan: Scan) -> bool:
        """Whether a scan of another frame has the same beams, from the same place and time."""
        last = self.last
        return (
            last.stamp_ns == scan.stamp_ns
            and np.array_equal(last.T_base_laser, scan.T_base_laser)
            and last.angle_min_rad == scan.angle_min_rad
            and last.angle_increment_rad == scan.angle_increment_rad
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
            known = next(same, None) or _Laser(scan.frame, scan)
            self._by_frame[scan.frame] = known
        known.last = scan
        return known

    @property
    def warnings(self) -> dict[str, str]:
        """What the lasers or their drivers do otherwise than REP 117, by kind."""
        lasers = self._by_frame.values()
        return of_lasers({laser.frame: laser.monitor.warnings for laser in lasers})


class PacketStamps:
    """Stamps of the scans of one laser, several of which may arrive in one packet with one stamp.

    The later ones are taken as made a period after each other. The period is the usual time between
    two stamps, over the number of scans with the first of them. A scan that comes twice keeps its
    stamp, and so do sectors of one revolution, which begin at other angles. moved: number of scans
    whose stamp was moved on.
    """

    def __init__(self) -> None:
        self.moved = 0
        self._last: Scan | None = None
        self._count = 0  # scans with the last stamp
        self._periods_ns: deque[float] = deque(maxlen=_USUAL_SCANS)

    @property
    def period_ns(self) -> int:
        """Usual time from scan to scan; 0 before two stamps differ."""
        return round(median(self._periods_ns)) if self._periods_ns else 0

    def moved_on(self, scan: Scan, is_kept: bool = False) -> Scan | None:
        """The next scan, at a stamp of its own; None where its time is unknown.

        is_kept: whether it keeps its stamp.
        """
        last = self._last
        if last is None or scan.stamp_ns != last.stamp_ns:
            if last is not None and scan.stamp_ns > last.stamp_ns:
                self._periods_ns.append((scan.stamp_ns - last.stamp_ns) / self._count)
            self._last = scan
            self._count = 1
            return scan
        is_kept |= scan.angle_min_rad != last.angle_min_rad
        if is_kept or np.array_equal(scan.ranges_m, last.ranges_m, equal_nan=True):
            return scan
        self._last = scan
        later_ns = self._count * self.period_ns
        self._count += 1
        if not 0 < later_ns <= SECOND_NS:
            return None
        self.moved += 1
        return replace(scan, stamp_ns=scan.stamp_ns + later_ns)


class _UnpairedScans:
    """Number of scans without odometry by laser and reason, with the words of the worst case."""

    def __init__(self) -> None:
        self.total = 0
        self._found: dict[str, dict[str, tuple[int, Missing]]] = {}

    def add(self, frame: str, missing: Missing) -> None:
        self.total += 1
        own = self._found.setdefault(frame, {})
        count, worst = own.get(missing.reason, (0, missing))
        own[missing.reason] = (count + 1, max(worst, missing, key=lambda m: m.amount))

    def reasons(self, frames: Collection[str]) -> dict[str, int]:
        """Number by reason, of each laser where there are several frames."""
        names = laser_names(frames, 'of {} ')
        return {
            names[frame] + reason.format(worst.words): count
            for frame, own in self._found.items()
            for reason, (count, worst) in own.items()
        }


class ScanOdometrySynchronizer:
    """Interpolates odometry at the stamp of each scan, in the order of the scans.

    A scan waits until newer odometry has arrived; those of several lasers do so in the order of
    their stamps. One that the laser did not measure is blind (see `LaserMonitor`), and so is one of
    a tilted robot. Live nodes and replay use it alike, so that both process the same pairs. The
    delay of each laser is estimated from the estimates of its scans, and corrected.
    """

    def __init__(self, capacity: int = 20) -> None:
        """capacity: scans of a laser that may wait."""
        self._buffer = OdometryBuffer(max_gap_ns=MAX_ODOMETRY_GAP_NS)
        self._lasers = Lasers()
        self._silence_s = 0.0  # since the last scan
        self._waiting: list[Scan] = []
        self._delays: defaultdict[str, DelayEstimator] = defaultdict(DelayEstimator)  # by frame
        self._last: Scan | None = None  # that was paired
        self._capacity = capacity
        self._odometry_ns: int | None = None  # stamp of the last sample
        self._since: set[str] = set()  # frames of the scans since then
        self._packets: dict[str, PacketStamps] = {}  # by frame of the laser
        self._tilts = TiltBuffer()
        self._tilted: Counter[bool] = Counter()  # scans above the limit, and others
        self._least_tilt_rad = math.inf
        self._unpaired = _UnpairedScans()
        self._overdue: deque[tuple[int, str]] = deque()  # time and frame of scans that were late

    @property
    def dropped(self) -> int:
        """Scans that were not paired, and do not wait."""
        return self._unpaired.total + len(self._overdue)

    @property
    def discarded_odometry(self) -> int:
        """Odometry samples whose stamps were ahead of those after them."""
        return self._buffer.discarded

    @property
    def warnings(self) -> dict[str, str]:
        """What the laser, its driver or the odometry do otherwise than expected, by kind."""
        found = self._lasers.warnings
        names = laser_names(self._packets.keys())
        for frame, delay in self._delays.items():
            if delay.warning:
                found[f'delay {frame}'] = names[frame] + delay.warning
        moved = [packets for packets in self._packets.values() if packets.moved]
        if moved:
            count = sum(packets.moved for packets in moved)
            periods = ', '.join(f'{packets.period_ns / SECOND_NS:.3f} s' for packets in moved)
            found['stamps'] = (
                f'{counted(count, "scan")} with the stamp of the scan before and other ranges: '
                f'taken as made a period later ({periods})'
            )
        if self._is_askew:
            least_deg = math.degrees(self._least_tilt_rad)
            found['tilt'] = (
                f'robot tilted by {least_deg:.0f} deg or more since the start: '
                'is its IMU askew? No scan is left out for it'
            )
        return found

    @property
    def delays_s(self) -> dict[str, float]:
        """Delay of the scans of each laser frame, s."""
        return {frame: delay.total_s for frame, delay in self._delays.items()}

    @property
    def waiting(self) -> int:
        """Scans that wait for odometry."""
        return len(self._waiting)

    def reasons(self) -> dict[str, int]:
        """Number of scans that were not paired, or wait, by reason."""
        found = deepcopy(self._unpaired)
        waiting = ((scan.odometry_ns, scan.frame) for scan in self._waiting)
        for odometry_ns, frame in (*self._overdue, *waiting):
            found.add(frame, self._buffer.missing(odometry_ns))
        return found.reasons(self._packets.keys())

    def add_odometry(
        self, stamp_ns: int, T_odom_base: Array, tilt_rad: float = 0.0
    ) -> list[tuple[Scan, Array]]:
        """Take an odometry sample; tilt_rad: of the robot, 0 where it is unknown.

        Returns the scans that are ready now, each with its T_odom_base (3,).
        """
        self._silence_s += self._buffer.add(stamp_ns, T_odom_base)
        self._tilts.add(stamp_ns, tilt_rad)
        self._odometry_ns = stamp_ns
        self._since.clear()
        while self._overdue and self._overdue[0][0] <= stamp_ns:
            self._end_overdue()
        return self._ready()

    def add_scan(self, scan: Scan) -> list[tuple[Scan, Array]]:
        """Add a scan; returns the scans that are ready now, each with its T_odom_base (3,)."""
        # Odometry with that stamp came in between: by a coarse clock each scan has its own pose.
        has_own_pose = self._odometry_ns == scan.stamp_ns and scan.frame not in self._since
        self._since.add(scan.frame)
        stamped = self._packets.setdefault(scan.frame, PacketStamps()).moved_on(scan, has_own_pose)
        if stamped is None:
            self._unpaired.add(scan.frame, Missing('with the stamp of the scan before'))
            return []
        scan = stamped
        own = [waiting for waiting in self._waiting if waiting.frame == scan.frame]
        # A scan with a stamp more than a second ahead would block all later ones.
        while own and own[-1].stamp_ns > scan.stamp_ns + SECOND_NS:
            ahead_ns = own[-1].stamp_ns - scan.stamp_ns
            reason = 'with a stamp ahead of later ones, by up to {}'
            self._drop(own.pop(), Missing.by_time(reason, ahead_ns))
        if len(own) >= self._capacity:
            self._waiting.remove(own[0])
            self._overdue.append((own[0].odometry_ns, own[0].frame))
        if len(self._overdue) > _MAX_OVERDUE:
            self._end_overdue()
        self._lasers.of(scan).timing.add(scan)
        self._waiting.insert(self._place(scan), scan)
        return self._ready()

    def _end_overdue(self) -> None:
        """Count the scan that has waited longest; it waits no more."""
        odometry_ns, frame = self._overdue.popleft()
        missing = Missing('with too many others between two samples of the odometry')
        if self._buffer.interpolate(odometry_ns) is None:
            missing = self._buffer.missing(odometry_ns)
        self._unpaired.add(frame, missing)

    def finish(self) -> list[tuple[Scan, Array]]:
        """Scans at the end of a log, for whose last beams the odometry has ended."""
        ready = []
        unpaired = []
        for waiting in self._waiting:
            scan = self._delays[waiting.frame].with_delay(waiting)
            T_odom_base = self._buffer.interpolate(scan.odometry_ns)
            if T_odom_base is None:
                unpaired.append(waiting)
            else:
                ready.append(self._complete(scan, T_odom_base))
        self._waiting = unpaired
        return ready

    def add_estimate(self, scan: Scan, estimate: Estimate) -> None:
        """Add the estimate of a scan that was ready, from which the delay is estimated."""
        self._delays[scan.frame].add(scan, estimate, self._buffer)

    def _time_ns(self, scan: Scan) -> int:
        """Time of a scan by the clock of the odometry, ns."""
        return self._delays[scan.frame].with_delay(scan).odometry_ns

    def _place(self, scan: Scan) -> int:
        """Where a scan belongs among those that wait: before later ones of other lasers."""
        place = len(self._waiting)
        for waiting in reversed(self._waiting):
            if waiting.frame == scan.frame or self._time_ns(waiting) <= self._time_ns(scan):
                break
            place -= 1
        return place

    def _drop(self, scan: Scan, missing: Missing) -> None:
        self._waiting.remove(scan)
        self._unpaired.add(scan.frame, missing)

    def _ready(self) -> list[tuple[Scan, Array]]:
        ready = []
        latest = self._buffer.latest_stamp_ns
        while self._waiting and latest is not None:
            waiting = self._waiting[0]
            scan = self._delays[waiting.frame].with_delay(waiting)
            T_odom_base = self._buffer.interpolate(scan.odometry_ns)
            if latest < self._needed_until(scan) or (
                T_odom_base is None and scan.odometry_ns > latest
            ):
                break
            if T_odom_base is None:
                self._drop(waiting, self._buffer.missing(scan.odometry_ns))
                continue
            self._waiting.pop(0)
            ready.append(self._complete(scan, T_odom_base))
        return ready

    def _complete(self, scan: Scan, T_odom_base: Array) -> tuple[Scan, Array]:
        T_before = self._odometry_before()
        self._last = scan
        scan = replace(scan, odometry_silence_s=self._silence_s, T_odom_before=T_before)
        self._silence_s = 0.0
        if self._is_tilted(scan):
            return scan.blinded(TILTED), T_odom_base
        checked = self._lasers.of(scan).monitor.checked(scan, T_odom_base)
        return self._deskewed(checked), T_odom_base

    def _is_tilted(self, scan: Scan) -> bool:
        """Whether the scan shows the floor; not of a robot that is never level: its IMU is askew.

        It may also have started on a ramp.
        """
        tilt_rad = self._tilts.at(scan.odometry_ns)
        self._least_tilt_rad = min(self._least_tilt_rad, tilt_rad)
        is_above = tilt_rad > scan.max_tilt_rad
        self._tilted[is_above] += 1
        return is_above and not self._is_askew

    @property
    def _is_askew(self) -> bool:
        """Whether the robot was hardly ever level; an IMU that is askew is level on some bump."""
        return self._tilted[False] < _LEVEL_SHARE * self._tilted.total()

    def _odometry_before(self) -> Array | None:
        """Odometry pose (3,) of the previous scan if its delay has changed since; else None.

        The motion between two scans is that of the odometry with one delay.
        """
        last = self._last
        if last is None or self._delays[last.frame].total_s == last.delay_s:
            return None
        return self._buffer.interpolate(
            replace(last, delay_s=self._delays[last.frame].total_s).odometry_ns
        )

    def _needed_until(self, scan: Scan) -> int:
        """Time until which a scan needs odometry, ns."""
        is_plausible = self._lasers.of(scan).timing.is_plausible(scan)
        return scan.end_ns if is_plausible else scan.odometry_ns

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
        is_rate_known = len(self._intervals_ns) == _USUAL_INTERVALS
        usual_ns = median(self._intervals_ns) if is_rate_known else 0.0
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
