"""Blind sectors: invalid beams behind which an obstacle may stand.

Between two valid beams an angle D apart, an obstacle of width w cannot hide closer than w / D. The
space beyond that in a sector of invalid beams is unobserved, unless a recent scan, made near by,
has observed it.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import kernel

# Width of the smallest relevant obstacle: a leg. Sectors are sampled at this spacing.
MIN_OBSTACLE_WIDTH_M = 0.1


class _Observation(NamedTuple):
    """Observed ranges (N,), m (NaN: invalid), of a scan, and the laser pose (3,), map frame."""

    seen_m: Array
    first_rad: float
    step_rad: float
    T_map_laser: Array


class BlindSectors:
    """Sectors of invalid beams in the newest scan, less the space that recent scans observed."""

    def __init__(self, scans: int = 32, apart_m: float = 0.05, apart_rad: float = 0.1) -> None:
        """Remember so many scans, made at least some distance or angle apart."""
        self._apart_m = apart_m
        self._apart_rad = apart_rad
        self._newest: _Observation | None = None
        self._earlier: deque[_Observation] = deque(maxlen=scans)

    def add_scan(self, T_map_laser: Array, scan: Scan) -> None:
        """Add a scan made by a laser at a pose (3,), map frame."""
        seen_m = np.where(scan.hit, scan.ranges_m, np.where(scan.valid, np.inf, np.nan))
        seen_m = np.where(scan.below_range_min, 0.0, seen_m)
        newest = _Observation(seen_m, scan.angle_min_rad, scan.angle_increment_rad, T_map_laser)
        if self._newest is not None and self._is_apart(self._newest.T_map_laser):
            self._earlier.append(self._newest)
        self._newest = newest

    def _is_apart(self, T_map_laser: Array) -> bool:
        if not self._earlier:
            return True
        moved = se2.between(self._earlier[-1].T_map_laser, T_map_laser)
        has_moved = math.hypot(moved[0], moved[1]) > self._apart_m
        return has_moved or abs(float(moved[2])) > self._apart_rad

    def points(self, reach_m: float, remembered_m: float) -> Array:
        """Points (K, 2), map frame, in unobserved space up to reach_m from the laser.

        remembered_m: earlier scans count if they were made within this distance.
        """
        if self._newest is None:
            return np.empty((0, 2))
        newest = self._newest
        invalid = np.isnan(newest.seen_m)
        points = _sector_points(
            invalid, newest.first_rad, newest.step_rad, newest.T_map_laser, reach_m
        )
        for earlier in reversed(self._earlier):
            if not len(points):
                break
            if math.dist(earlier.T_map_laser[:2], newest.T_map_laser[:2]) <= remembered_m:
                points = points[~_is_seen(points, *earlier)]
        return points


@kernel
def _sector_points(
    invalid: NDArray[np.bool_], first: float, step: float, laser: Array, reach: float
) -> Array:
    """Points (K, 2) in the sectors of invalid beams (N,), up to a reach, where obstacles can hide.

    first, step: bearing of the first beam and increment, rad; laser (3,): its pose.
    """
    count = invalid.size
    points = [(0.0, 0.0) for _ in range(0)]
    # In a full circle, the last beam is beside the first.
    is_circle = count * abs(step) > 2.0 * math.pi - 0.5 * abs(step)
    start = 0
    while is_circle and start < count and invalid[start]:
        start += 1
    begun = -1
    for k in range(count + 1):
        if k < count and invalid[(start + k) % count]:
            begun = k if begun < 0 else begun
            continue
        if begun < 0:
            continue
        width = (k - begun + 1) * abs(step)
        ring = MIN_OBSTACLE_WIDTH_M / width
        while ring <= reach:
            across = max(1, int(math.ceil(ring * (k - begun) * abs(step) / MIN_OBSTACLE_WIDTH_M)))
            for j in range(across + 1):
                beam = start + begun + (k - 1 - begun) * j / across
                angle = laser[2] + first + step * beam
                points.append(
                    (laser[0] + ring * math.cos(angle), laser[1] + ring * math.sin(angle))
                )
            ring += MIN_OBSTACLE_WIDTH_M
        begun = -1
    found = np.empty((len(points), 2))
    for i in range(len(points)):
        found[i, 0], found[i, 1] = points[i]
    return found


@kernel
def _is_seen(
    points: Array, seen: Array, first: float, step: float, laser: Array
) -> NDArray[np.bool_]:
    """Whether beams of a scan passed points (K, 2): (K,).

    seen (N,): observed range of each beam, m, NaN: invalid; first, step: bearing of the first beam
    and increment, rad; laser (3,): pose of the laser.
    """
    result = np.zeros(points.shape[0], dtype=np.bool_)
    turn = 2.0 * math.pi
    for i in range(points.shape[0]):
        dx = points[i, 0] - laser[0]
        dy = points[i, 1] - laser[1]
        bearing = math.atan2(dy, dx) - laser[2] - first
        along = bearing if step > 0.0 else -bearing
        beam = int(round((along % turn) / abs(step)))
        if beam < seen.size and not math.isnan(seen[beam]):
            result[i] = math.hypot(dx, dy) <= seen[beam]
    return result
