"""Odometry at the stamps of scans, and its increments from scan to scan."""

import math
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_COUNT, Field

# Between samples that are further apart, the robot need not have moved evenly. Odometry at 1 Hz is
# interpolated, with one lost sample.
MAX_ODOMETRY_GAP_NS = 2 * SECOND_NS
_SPAN_NS = 10 * SECOND_NS  # of the samples that are kept
# A stream is silent when several samples are missing; stamps of real robots come in bunches.
_SHORTEST_GAP_NS = SECOND_NS
_GAP_PERIODS = 3.0
_USUAL_SAMPLES = 15
_UNITS = (('s', 1.0), ('h', 3600.0), ('days', 86400.0), ('years', 365.25 * 86400.0))

FIELDS = {
    'stamp_ns': Field(np.int64, (), 0, MAX_COUNT),
    'T_map_odom': Field(np.float64, (3,), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'T_odom_base': Field(np.float64, (3,), -MAX_COORDINATE_M, MAX_COORDINATE_M),
}


@dataclass(frozen=True)
class OdometryLimits:
    """Motion that odometry can report of one drive; a larger one is a discontinuity.

    The speeds are above those of indoor robots. The jumps allow for stamps that come in bunches.
    """

    jump_m: float = 0.5
    jump_rad: float = 0.3
    max_speed_m_s: float = 3.0
    max_speed_rad_s: float = 4.0
    max_gap_ns: int = 120_000_000_000

    def distance_m(self, seconds: float) -> float:
        """Largest distance between two samples so many seconds apart, m.

        After a longer gap than `max_gap_ns` it is not larger: nobody has seen that drive.
        """
        return self.jump_m + self.max_speed_m_s * self._bounded(seconds)

    def turn_rad(self, seconds: float) -> float:
        """Largest rotation between two samples so many seconds apart, rad."""
        return self.jump_rad + self.max_speed_rad_s * self._bounded(seconds)

    def allow(self, moved: Array, seconds: float) -> bool:
        """Whether a robot can move by `moved` (3,) within so many seconds."""
        is_near = math.hypot(moved[0], moved[1]) <= self.distance_m(seconds)
        return is_near and abs(float(moved[2])) <= self.turn_rad(seconds)

    def _bounded(self, seconds: float) -> float:
        return min(max(seconds, 0.0), self.max_gap_ns / SECOND_NS)


_LIMITS = OdometryLimits()


@dataclass(frozen=True)
class Missing:
    """Why a scan has no odometry: reason with {} for words, and the amount that these tell."""

    reason: str
    amount: float = 0.0
    words: str = ''

    @staticmethod
    def by_time(reason: str, ns: int) -> 'Missing':
        """A reason whose words are a time."""
        return Missing(reason, ns, _duration(ns))


def _duration(ns: int) -> str:
    """A time in the unit that suits it."""
    seconds = ns / SECOND_NS
    name, size = next(((n, s) for n, s in reversed(_UNITS) if seconds >= 2.0 * s), _UNITS[0])
    return f'{seconds / size:.3g} {name}'


class OdometryBuffer:
    """The last few seconds of odometry, looked up by stamp.

    Stamps of real robots step back a little now and then: a late sample is inserted in order. A
    sample much older than the newest one means that time was set back (a bag was restarted), or
    that the stamps before it were wrong: the buffer is cleared.
    discarded: number of samples with such stamps.
    """

    def __init__(self, max_gap_ns: int | None = None) -> None:
        """max_gap_ns: longest time that is interpolated, and that a stamp may step back.

        None: any within the span.
        """
        self.discarded = 0
        self._max_gap_ns = max_gap_ns
        self._is_begin_kept = True
        self._silence = SilenceDetector()
        self._stamps: list[int] = []
        self._poses: list[Array] = []
        self._silences_s: list[float] = []  # before each sample

    @property
    def latest_stamp_ns(self) -> int | None:
        """Stamp of the newest sample, or None where there is none."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp_ns: int, T_odom_base: Array) -> float:
        """Add a sample, (3,); returns the silence before it, see `SilenceDetector`, s.

        Raises InputError if the pose is not finite, or beyond MAX_COORDINATE_M.
        """
        if not se2.is_bounded_pose(T_odom_base):
            pose = ', '.join(f'{value:g}' for value in T_odom_base.tolist())
            raise InputError(
                f'odometry at {stamp_ns} ns: pose {pose}: expected finite numbers, at most '
                f'{se2.MAX_COORDINATE_M:g} m'
            )
        if self._stamps and stamp_ns < self._stamps[-1] - (self._max_gap_ns or _SPAN_NS):
            self.discarded += len(self._stamps) - bisect_left(self._stamps, stamp_ns)
            self._is_begin_kept = False
            self._stamps = []
            self._poses = []
            self._silences_s = []
        index = bisect_left(self._stamps, stamp_ns)
        if index < len(self._stamps) and self._stamps[index] == stamp_ns:
            self._poses[index] = T_odom_base
            return 0.0
        silence_s = self._silence.add(stamp_ns)
        self._stamps.insert(index, stamp_ns)
        self._poses.insert(index, T_odom_base)
        self._silences_s.insert(index, silence_s)
        self._drop_old()
        return silence_s

    def interpolate(self, stamp_ns: int) -> Array | None:
        """Pose at a stamp.

        Exact at a sample, interpolated between two, None outside the buffer, in a long gap and
        within a discontinuity.
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
        if self._is_gap(after - before) or self._jump(index) is not None:
            return None
        share = (stamp_ns - before) / (after - before)
        return se2.interpolate(self._poses[index - 1], self._poses[index], share)

    def missing(self, stamp_ns: int) -> Missing:
        """Why there is no pose at a stamp."""
        index = bisect_left(self._stamps, stamp_ns)
        if not self._stamps:
            return Missing('without any odometry')
        if index == len(self._stamps):
            late_ns = stamp_ns - self._stamps[-1]
            return Missing.by_time('after the last odometry, by up to {}', late_ns)
        if index == 0 and self._is_begin_kept:
            early_ns = self._stamps[0] - stamp_ns
            return Missing.by_time('before the first odometry, by up to {}', early_ns)
        if index == 0:
            late_ns = self._stamps[-1] - stamp_ns
            return Missing.by_time('received too late, by up to {} after their odometry', late_ns)
        gap_ns = self._stamps[index] - self._stamps[index - 1]
        if self._is_gap(gap_ns):
            limit = f'at most {MAX_ODOMETRY_GAP_NS / SECOND_NS:g} s'
            return Missing.by_time(
                f'in gaps of the odometry of up to {{}}: expected {limit}', gap_ns
            )
        jump = self._jump(index)
        if jump is None:
            return Missing('for an unknown reason')
        words = f'{jump[0]:.3g} m, {math.degrees(jump[1]):.0f} deg within {_duration(gap_ns)}'
        text = 'in jumps of the odometry of up to {}: reset, in mm or in degrees?'
        return Missing(text, sum(jump), words)

    def _is_gap(self, ns: int) -> bool:
        return self._max_gap_ns is not None and ns > self._max_gap_ns

    def _jump(self, index: int) -> tuple[float, float] | None:
        """Distance (m) and turn (rad) up to a sample that no robot can make; None otherwise."""
        moved = se2.between(self._poses[index - 1], self._poses[index])
        seconds = (self._stamps[index] - self._stamps[index - 1]) / SECOND_NS
        if _LIMITS.allow(moved, seconds - self._silences_s[index]):
            return None
        return math.hypot(moved[0], moved[1]), abs(float(moved[2]))

    def between(self, begin_ns: int, end_ns: int) -> tuple[NDArray[np.int64], Array] | None:
        """Stamps (K,) and poses (K, 3) of samples that cover a period; None where none do.

        Neither do samples in a long gap, nor those within a discontinuity.
        """
        first = bisect_right(self._stamps, begin_ns) - 1
        end = bisect_left(self._stamps, end_ns) + 1
        if first < 0 or end > len(self._stamps):
            return None
        inner = [begin_ns, *self._stamps[first + 1 : end - 1], end_ns]
        poses = [self.interpolate(stamp_ns) for stamp_ns in inner]
        known = [pose for pose in poses if pose is not None]
        middles = [(a + b) // 2 for a, b in pairwise(inner)]
        if len(known) < len(poses) or any(self.interpolate(ns) is None for ns in middles):
            return None
        return np.array(inner, dtype=np.int64), np.array(known)

    def headings(self, stamps_ns: NDArray[np.int64]) -> Array | None:
        """Headings (K,), without jumps of a turn, at stamps (K,).

        None where a stamp is outside the buffer, and where a long gap or a discontinuity is between
        the first and the last one.
        """
        first = bisect_right(self._stamps, int(stamps_ns.min())) - 1
        end = bisect_left(self._stamps, int(stamps_ns.max())) + 1
        if first < 0 or end > len(self._stamps):
            return None
        known_ns = np.array(self._stamps[first:end], dtype=np.int64)
        headings = np.unwrap([float(pose[2]) for pose in self._poses[first:end]])
        steps_ns = np.diff(known_ns)
        if self._max_gap_ns is not None and steps_ns.max(initial=0) > self._max_gap_ns:
            return None
        limits = _LIMITS.jump_rad + _LIMITS.max_speed_rad_s * steps_ns / SECOND_NS
        if (np.abs(np.diff(headings)) > limits).any():
            return None
        since_s = (stamps_ns - known_ns[0]) / SECOND_NS
        return np.asarray(np.interp(since_s, (known_ns - known_ns[0]) / SECOND_NS, headings))

    def _drop_old(self) -> None:
        first = bisect_left(self._stamps, self._stamps[-1] - _SPAN_NS)
        # In blocks, so that a long buffer is not shifted at every sample.
        if first > 256:
            self._is_begin_kept = False
            del self._stamps[:first], self._poses[:first], self._silences_s[:first]


class TiltBuffer:
    """How far a robot is tilted, in the last ten seconds, looked up by stamp."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float]] = deque()

    def add(self, stamp_ns: int, tilt_rad: float) -> None:
        """Add a sample: angle between the vertical and that of the robot, rad."""
        if self._samples and stamp_ns < self._samples[-1][0] - _SPAN_NS:
            self._samples.clear()
        self._samples.append((stamp_ns, tilt_rad))
        while self._samples[0][0] < stamp_ns - _SPAN_NS:
            self._samples.popleft()

    def at(self, stamp_ns: int) -> float:
        """Larger tilt of the samples before and after a stamp, rad; 0 where it is unknown."""
        later_rad = 0.0
        for sample_ns, tilt_rad in reversed(self._samples):
            if sample_ns <= stamp_ns:
                return max(tilt_rad, later_rad)
            later_rad = tilt_rad
        return 0.0


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
        moved = se2.between(self.T_odom_base, T_odom_base)
        return 0 <= gap_ns <= _LIMITS.max_gap_ns and _LIMITS.allow(moved, gap_ns / SECOND_NS)


@dataclass(frozen=True, eq=False)
class OdometryIncrement:
    """Motion since the previous scan, by odometry.

    T_before_base (3,), within `seconds`. discontinuity_m: 0; after an odometry discontinuity, where
    the increment is unknown, the distance (m) that the robot may have travelled. discontinuity: its
    description; '' without one.
    """

    T_before_base: Array
    seconds: float
    discontinuity_m: float = 0.0
    discontinuity: str = ''


class SilenceDetector:
    """Detects by the stamps of a stream that it was silent for longer than usual."""

    def __init__(self) -> None:
        self._periods: deque[int] = deque(maxlen=_USUAL_SAMPLES)
        self._stamp_ns: int | None = None

    def add(self, stamp_ns: int) -> float:
        """Time (s) by which the time since the previous sample exceeds the usual period.

        0 unless that is a gap: longer than a second and than several usual periods.
        """
        period_ns = 0 if self._stamp_ns is None else stamp_ns - self._stamp_ns
        self._stamp_ns = stamp_ns
        silence_s = self._silence_s(period_ns) if period_ns > _SHORTEST_GAP_NS else 0.0
        if period_ns > 0:
            self._periods.append(period_ns)
        return silence_s

    def _silence_s(self, period_ns: int) -> float:
        usual_ns = median(self._periods) if self._periods else math.inf
        is_gap = period_ns > _GAP_PERIODS * usual_ns
        return (period_ns - usual_ns) / SECOND_NS if is_gap else 0.0


class OdometryIncrements:
    """Motion from scan to scan, from the odometry poses at their stamps.

    Increments that are not finite, or faster than any robot, are counted in `rejected`.
    """

    def __init__(self) -> None:
        self.rejected = 0
        self._silence = SilenceDetector()
        self.T_odom_base: Array = np.zeros(3)  # of the last scan
        self._is_begun = False
        self.stamp_ns: int | None = None  # of the last scan
        self._last: Scan | None = None

    def add(self, scan: Scan, T_odom_base: Array) -> OdometryIncrement:
        """Increment up to the odometry pose (3,) of a scan; zero for the first one.

        An odometry that is reset while it is silent looks as if the robot had driven meanwhile. So
        the limits of a motion grow only with the time in which odometry came at its usual rate.
        """
        silence_s = self._silence.add(scan.odometry_ns)
        if scan.odometry_silence_s is not None:
            silence_s = scan.odometry_silence_s
        seconds = 0.0 if self._last is None else _seconds(self._last, scan)
        self.stamp_ns = scan.stamp_ns
        self._last = scan
        if not se2.is_finite(T_odom_base):
            self.rejected += 1
            return OdometryIncrement(np.zeros(3), seconds)
        before = self.T_odom_base if self._is_begun else T_odom_base
        if scan.T_odom_before is not None:
            before = scan.T_odom_before
        self._is_begun = True
        self.T_odom_base = np.array(T_odom_base, dtype=np.float64)
        # Rounded, so that text logs, bags and messages give identical results.
        moved = np.round(se2.between(before, self.T_odom_base), 9)
        if _LIMITS.allow(moved, seconds - silence_s):
            return OdometryIncrement(moved, seconds)
        self.rejected += 1
        jump = (
            f'odometry jumped by {math.hypot(moved[0], moved[1]):.2f} m, '
            f'{math.degrees(float(moved[2])):.0f} deg within {max(seconds, 0.0):.2f} s'
        )
        return OdometryIncrement(np.zeros(3), seconds, _LIMITS.distance_m(max(seconds, 1.0)), jump)


def _seconds(before: Scan, after: Scan) -> float:
    """Time between two scans by the clock of the odometry, s; as if none had found its delay."""
    if after.T_odom_before is not None and before.frame == after.frame:
        return (after.stamp_ns - before.stamp_ns) / SECOND_NS
    return (after.odometry_ns - before.odometry_ns) / SECOND_NS
