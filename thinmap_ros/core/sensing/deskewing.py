"""Motion within a scan: all beams are moved to the stamp of the scan.

A spinning laser measures its beams one after the other. At 1 rad/s and 7 Hz the last beam points
8 degrees aside of where it would have pointed at the stamp. Odometry tells the motion in between.
"""

import math
from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.jit import inlined, kernel

# Largest relative difference between the stated and the measured time of a revolution.
_TOLERANCE = 0.2
_USUAL_SCANS = 15
# Neighbouring beams are on one surface where the range changes by at most this often the distance
# between them: up to an angle of incidence of 70 degrees.
_MAX_SLOPE = 3.0
# A beam stands for its own direction and for half of the way to its neighbours.
_NEAR = 0.75


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
    moved = _relative(_lasers(bases, scan.T_base_laser))
    step = abs(scan.angle_increment_rad)
    if np.abs(moved[:, 2]).max() < 0.01 * step and np.abs(moved[:, :2]).max() < 1e-4:
        return scan
    fan = (scan.angle_min_rad, scan.angle_increment_rad)
    moved_m = _moved_beams(scan.ranges_m, scan.returned, moved, fan)
    ranges = moved_m.astype(np.float32).astype(np.float64)
    return replace(scan, ranges_m=ranges, beam_period_s=0.0, first_beam_s=0.0)


def _lasers(bases: Array, T_base_laser: Array) -> Array:
    """Poses (N, 3) of the laser, from those of the robot."""
    c = np.cos(bases[:, 2])
    s = np.sin(bases[:, 2])
    x = bases[:, 0] + c * T_base_laser[0] - s * T_base_laser[1]
    y = bases[:, 1] + s * T_base_laser[0] + c * T_base_laser[1]
    return np.column_stack([x, y, bases[:, 2] + T_base_laser[2]])


def _relative(poses: Array) -> Array:
    """Poses (N, 3), without the last one of (N + 1, 3), relative to it."""
    last = poses[-1]
    points = se2.transform_points(se2.invert(last), poses[:-1, :2])
    return np.column_stack([points, poses[:-1, 2] - last[2]])


@inlined
def _range_at(
    ranges: Array, hit: NDArray[np.bool_], x: Array, y: Array, i: int, k: int, angle: float
) -> float:
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
def _moved_beams(
    ranges: Array, hit: NDArray[np.bool_], moved: Array, fan: tuple[float, float]
) -> Array:
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
