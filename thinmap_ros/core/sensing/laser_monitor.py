"""Detects scans that a laser did not measure, by the scans before and the motion of the robot."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.scan import MIN_HITS, Scan, is_most_missed
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.sensing.dropouts import DropoutDetector
from thinmap_ros.core.sensing.no_return_range import NoReturnRange

FROZEN = 'the same ranges while the robot moves'
NO_RETURNS = 'no returns from surfaces that it has just measured'
_REACH = 0.9  # of range_max: a farther surface may have gone out of range
_MIN_STEP_RAD = 1e-6
_CONFIRMED_NS = 2 * SECOND_NS


@dataclass(frozen=True)
class _Motion:
    """Motion since a scan: path length (m) and rotation (rad); standing still adds nothing."""

    path_m: float = 0.0
    turn_rad: float = 0.0

    def moved(self, increment: Array, seconds: float) -> '_Motion':
        """Add an increment (3,); slower ones than a robot drives are drift of the odometry."""
        path_m = math.hypot(increment[0], increment[1])
        turn_rad = abs(float(increment[2]))
        if path_m < 0.02 * seconds and turn_rad < 0.02 * seconds:
            return self
        return _Motion(self.path_m + path_m, self.turn_rad + turn_rad)

    @property
    def changes_ranges(self) -> bool:
        """Whether the ranges of any laser must have changed."""
        return self.path_m > 0.02 or self.turn_rad > 0.02


class _FreezeDetector:
    """Ranges of a real laser are noisy: equal ones, while the robot moves, are an old scan."""

    def __init__(self) -> None:
        self._last: tuple[Scan, Array] | None = None
        self._motion = _Motion()

    def is_frozen(self, scan: Scan, T_odom_base: Array) -> bool:
        """Whether the ranges are those of an earlier pose; T_odom_base (3,)."""
        last = self._last
        self._last = (scan, T_odom_base)
        if last is None or not np.array_equal(last[0].ranges_m, scan.ranges_m, equal_nan=True):
            self._motion = _Motion()
            return False
        seconds = (scan.stamp_ns - last[0].stamp_ns) / SECOND_NS
        self._motion = self._motion.moved(se2.between(last[1], T_odom_base), seconds)
        return self._motion.changes_ranges and int(np.count_nonzero(scan.hit)) >= MIN_HITS


@dataclass(frozen=True, eq=False)
class _Surfaces:
    """End points (N, 2) of the hits of a scan, odometry frame, m."""

    points: Array = field(default_factory=lambda: np.empty((0, 2)))

    @staticmethod
    def of(scan: Scan, T_odom_base: Array) -> '_Surfaces':
        return _Surfaces(se2.transform_points(T_odom_base, scan.points_base()))

    def are_missed(self, scan: Scan, T_odom_base: Array) -> bool:
        """Whether a scan at an odometry pose (3,) has no return from most of them."""
        T_odom_laser = se2.compose(T_odom_base, scan.T_base_laser)
        local = se2.transform_points(se2.invert(T_odom_laser), self.points)
        ranges = np.hypot(local[:, 0], local[:, 1])
        near = ranges < _REACH * scan.range_max_m
        bearings = np.arctan2(local[near, 1], local[near, 0]) - scan.angle_min_rad
        step = abs(scan.angle_increment_rad)
        ahead = bearings if scan.angle_increment_rad > 0.0 else -bearings
        # A single beam has no increment.
        beams = np.rint(np.mod(ahead, 2.0 * math.pi) / max(step, _MIN_STEP_RAD))
        beams = beams[beams < scan.ranges_m.size].astype(np.int64)
        return is_most_missed(scan, int(np.count_nonzero(scan.without_return[beams])))


class LaserMonitor:
    """Replaces scans that the laser did not measure by blind ones, and recognizes dropouts.

    A frozen driver repeats its ranges with new stamps. A laser that has failed may report no return
    for its beams: walls do not vanish from one scan to the next. Such a scan is blind, until walls
    are measured again, or scans agree with each other for some time (the robot was carried away).
    The scans of a laser that often has no return from surfaces in range are marked (`drops_out`).
    """

    def __init__(self) -> None:
        self._freeze = _FreezeDetector()
        self._no_return = NoReturnRange()
        self._dropouts = DropoutDetector()
        self._trusted = _Surfaces()
        self._previous = _Surfaces()
        self._doubted_ns: int | None = None  # first scan of a series that agrees with itself only

    @property
    def warnings(self) -> dict[str, str]:
        """What the laser or its driver do otherwise than REP 117, by kind."""
        texts = {'no return': self._no_return.warning, 'dropouts': self._dropouts.warning}
        return {kind: text for kind, text in texts.items() if text}

    def checked(self, scan: Scan, T_odom_base: Array) -> Scan:
        """The scan, or a blind one with the reason; T_odom_base (3,): pose, without jumps."""
        scan = self._no_return.applied(scan)
        if self._freeze.is_frozen(scan, T_odom_base):
            return scan.blinded(FROZEN)
        if scan.is_blind:
            return scan
        # Of a laser that drops out, a scan without returns is blind anyway.
        if not self._dropouts.drops_out and self._has_failed(scan, T_odom_base):
            return scan.blinded(NO_RETURNS)
        drops_out = self._dropouts.update(scan, T_odom_base)
        return replace(scan, drops_out=True) if drops_out else scan

    def _has_failed(self, scan: Scan, T_odom_base: Array) -> bool:
        surfaces = _Surfaces.of(scan, T_odom_base)
        is_empty = len(surfaces.points) < MIN_HITS
        contradicts = self._trusted.are_missed(scan, T_odom_base)
        contradicts |= self._doubted_ns is not None and is_empty
        if contradicts and self._doubted_ns is not None and not is_empty:
            agrees = not self._previous.are_missed(scan, T_odom_base)
            contradicts = not agrees or scan.stamp_ns - self._doubted_ns < _CONFIRMED_NS
            self._doubted_ns = self._doubted_ns if agrees else scan.stamp_ns
        elif contradicts:
            self._doubted_ns = scan.stamp_ns
        self._previous = surfaces
        if not contradicts:
            self._trusted = surfaces
            self._doubted_ns = None
        return contradicts
