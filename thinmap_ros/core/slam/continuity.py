"""Whether a scan continues the previous one: evidence of the place that needs no map.

A kidnapped robot sees other walls than a moment ago, though a map that grows soon agrees
with them. A crowd, a door that is shut and wheels that slip change a scan as well; each has its
share in the likelihood. A beam without return shows free space, as in the map: in a hall, most do.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.scan import MIN_HITS, NO_RETURN_CLEAR_RANGE_M, Scan
from thinmap_ros.core.se2 import Array, Mask
from thinmap_ros.jit import kernel

# Share of the returns that a scan shows again, of those of which it tells. Measured: the 5 %
# quantile is .86 to .99 in dense logs; of two scans of one building at random the median is
# .14 to .37.
_FOUND = 0.9
_FOUND_SIGMA = 0.12
_ELSEWHERE = 0.25
_ELSEWHERE_SIGMA = 0.2
_OUTLIER = 1e-5  # share of scans that show something else though the robot is here
# In a crowd: share of the scans, for each metre of motion, and what these show again.
_CROWD_PER_M = 0.05
_CROWD_FOUND = 0.6
_CROWD_SIGMA = 0.2
_LEAST_TOLD = 0.3  # share of its returns of which another scan has to tell
_NEAR_M = 0.25  # within which a return is shown again
_FREE_M = 0.3  # in front of the returns of the other scan: free space there
_REACH_M = 12.0
# Who stands so near hides half of a laser's view, and walks on.
_PERSON_M = 1.0
_POINTS = 180  # that are compared: more tell the same


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion (3,) that may be right; log_likelihood: at most 0, given the odometry."""

    T: Array
    log_likelihood: float = 0.0


def log_ratio(found: float, moved_m: float) -> float:
    """Log likelihood ratio, of here to elsewhere, of a share found again after some motion, m."""
    right = _log_density(min(found - _FOUND, 0.0), _FOUND_SIGMA)
    elsewhere = _log_density(max(found - _ELSEWHERE, 0.0), _ELSEWHERE_SIGMA)
    share = _CROWD_PER_M * min(moved_m, 1.0)
    crowd = _log_density(min(found - _CROWD_FOUND, 0.0), _CROWD_SIGMA)
    other = math.log(share * math.exp(crowd) + _OUTLIER)
    return float(np.logaddexp(right, other) - elsewhere)


def _log_density(off: float, sigma: float) -> float:
    """Of a normal distribution, without its constant."""
    return -0.5 * (off / sigma) ** 2 - math.log(sigma)


def continuity(before: Scan, scan: Scan, motions: list[Motion]) -> float:
    """Log likelihood ratio, at most 0, that the robot was not kidnapped between two scans.

    motions: any of which may be right, the first is that of the odometry.
    """
    moved_m = math.hypot(*motions[0].T)  # a radian changes the view as much as a metre
    best = -math.inf
    for motion in motions:
        share = seen_again(before, scan, motion.T)
        told = 0.0 if share is None else log_ratio(share, moved_m)
        best = max(best, motion.log_likelihood + told)
        if best >= 0.0:
            return 0.0
    return best


def continues(before: Scan, scan: Scan, T: Array, is_told: bool = False) -> bool:
    """Whether a scan, T (3,) from the previous one, shows it again.

    is_told: whether it has to tell so; else one that cannot tell counts as one that does.
    """
    share = seen_again(before, scan, T)
    if share is None:
        return not is_told
    return log_ratio(share, math.hypot(*T)) >= 0.0


def seen_again(before: Scan, scan: Scan, T: Array) -> float | None:
    """Share of the returns that two scans, T (3,) apart, show of each other; None: unknown.

    The smaller one of both directions: one may show nothing of what the other does, as behind a
    door that is shut.
    """
    shares = [_shown_by(before, scan, T), _shown_by(scan, before, se2.invert(T))]
    return min((share for share in shares if share is not None), default=None)


def _shown_by(a: Scan, b: Scan, T_a_b: Array) -> float | None:
    """Share of the returns of b that a shows again, of those of which it tells; None: too few.

    A return in front of those of a is where a has seen free space, and so is one where a beam of a
    has no return, if others have. One behind them is hidden.
    """
    points = _compared(b)
    if len(points) < MIN_HITS:
        return None
    T_laser = se2.compose(se2.invert(a.T_base_laser), T_a_b)
    seen = se2.transform_points(T_laser, points)
    clear_m = min(a.range_max_m, a.max_range_m, NO_RETURN_CLEAR_RANGE_M)
    ranges = np.where(a.no_return, clear_m, a.ranges_m)
    clears = a.hit if np.count_nonzero(a.hit) < MIN_HITS else a.hit | a.no_return
    first = a.angle_min_rad
    found, contrary = _counts(seen, ranges, a.hit, clears, first, a.angle_increment_rad)
    told = found + contrary
    return None if told < max(_LEAST_TOLD * len(points), 1.0) else found / told


def _compared(scan: Scan) -> Array:
    """Returns (N, 2) of a scan that are compared, robot frame."""
    compared = scan.hit & (scan.ranges_m > _PERSON_M) & (scan.ranges_m < _REACH_M)
    beams = np.flatnonzero(compared)
    beams = beams[:: max(1, len(beams) // _POINTS)]
    angles = scan.angles_rad[beams]
    points = scan.ranges_m[beams, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.asarray(se2.transform_points(scan.T_base_laser, points))


@kernel
def _counts(
    points: Array, ranges: NDArray[np.float64], hit: Mask, clears: Mask, first: float, step: float
) -> tuple[int, int]:
    """Numbers of points (M, 2), laser frame, that a scan shows, and that lie in its free space.

    ranges, hit, clears (N,): of its beams, the first at an angle, the next each a step further,
    rad; clears: the space is free up to the range.
    """
    found = 0
    contrary = 0
    count = len(ranges)
    for point in points:
        range_m = math.hypot(point[0], point[1])
        turn = math.atan2(point[1], point[0]) - first
        turn = (turn if step > 0.0 else -turn) % (2.0 * math.pi)
        beam = int(turn / abs(step) + 0.5)
        if beam >= count or range_m < 0.1 or range_m > _REACH_M:
            continue
        reach = int(min(_NEAR_M / max(range_m, 0.2) / abs(step), count / 8.0)) + 1
        is_shown = False
        for k in range(max(beam - reach, 0), min(beam + reach + 1, count)):
            if not hit[k]:
                continue
            angle = first + step * k
            dx = ranges[k] * math.cos(angle) - point[0]
            dy = ranges[k] * math.sin(angle) - point[1]
            if dx * dx + dy * dy < _NEAR_M * _NEAR_M:
                is_shown = True
                break
        if is_shown:
            found += 1
            continue
        is_free = True
        for k in range(max(beam - 1, 0), min(beam + 2, count)):
            is_free = is_free and clears[k] and ranges[k] - _FREE_M > range_m
        if is_free:
            contrary += 1
    return found, contrary
