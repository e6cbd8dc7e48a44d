"""Where the laser does not see though it looks there: behind invalid beams something may stand.

Between two valid beams an angle D apart, a thing of width w cannot hide nearer than w / D. What
lies farther out in a sector of invalid beams is unseen, until an earlier scan has seen it from a
place that the robot has just left.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

# The narrowest thing that must not be driven over unseen: a leg. Sectors are sampled this densely.
MIN_OBSTACLE_WIDTH_M = 0.1
_REMEMBERED_SCANS = 32
# Between two scans that are remembered
_APART_M = 0.05
_APART_RAD = 0.1


class _Observation(NamedTuple):
    """Ranges (N,) that a scan saw, m (NaN: not at all), and from where, (3,), map frame."""

    seen_m: Array
    first_rad: float
    step_rad: float
    T_map_laser: Array


class BlindSectors:
    """The sectors of invalid beams in the newest scan, less what the scans just before saw."""

    def __init__(self) -> None:
        self._newest: _Observation | None = None
        self._earlier: deque[_Observation] = deque(maxlen=_REMEMBERED_SCANS)

    def observe(self, T_map_laser: Array, scan: Scan) -> None:
        """Take a scan made by a laser at a pose (3,), map frame."""
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
        return math.hypot(moved[0], moved[1]) > _APART_M or abs(float(moved[2])) > _APART_RAD

    def points(self, reach_m: float, remembered_m: float) -> Array:
        """Points (K, 2), map frame, in what is unseen up to reach_m from the laser.

        remembered_m: how far the robot may have come from where an earlier scan saw a point.
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
    """Points (K, 2) to a reach in the sectors of invalid beams (N,), from where something can hide.

    first, step: bearing of the first beam and from one to the next, rad; laser (3,): its pose.
    """
    count = invalid.size
    points = [(0.0, 0.0) for _ in range(0)]
    # Where the beams go all round, the last one is beside the first.
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
    """Whether beams of a scan went past points (K, 2): (K,).

    seen (N,): how far each beam saw, m, NaN: not at all; first, step: their bearings, rad; laser
    (3,): pose of the laser.
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
