"""Obstacles around the robot as points, and the free path length of a disc among them."""

import math

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.planning.blind_sectors import MIN_OBSTACLE_WIDTH_M, BlindSectors
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import kernel

_REMEMBERED_M = 1.0
_SWEEP_STEP_M = 0.03
_NEIGHBOURS = 2  # beams on either side
_SAME_M = 0.03  # maximum difference of ranges of the same obstacle


class ObstaclePoints:
    """Hits of the newest scan, and earlier hits near the robot outside its field of view.

    A laser that looks ahead does not see the corner around which the robot is turning.
    points (N, 2): map frame, m; they stay where they were first observed.
    is_hidden: whether a blind sector, not a point, limited the last `free_arc_length_m`.
    """

    def __init__(self) -> None:
        self.points: Array = np.empty((0, 2))
        self.is_hidden = False
        self._blind_sectors = BlindSectors()
        self._scan: Scan | None = None

    def add_scan(self, T_map_base: Array, scan: Scan | None) -> None:
        """Add a scan made at a pose (3,). The newest one may be given again."""
        if scan is None or scan is self._scan:
            return
        self._scan = scan
        first = scan.angle_min_rad
        step = scan.angle_increment_rad
        T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
        hits = np.where(scan.hit, scan.ranges_m, np.nan)
        hits = np.where(scan.below_range_min, scan.range_min_m, hits)
        self._blind_sectors.add_scan(T_map_laser, scan)
        self.points = _points_around(hits, first, step, T_map_laser, self.points, T_map_base)

    def query_radius(self, T_map_base: Array, reach_m: float) -> Array:
        """Points (M, 2), m, within reach_m of a pose (3,)."""
        return np.asarray(
            self.points[np.square(self.points - T_map_base[:2]).sum(axis=1) < reach_m**2]
        )

    def clearance_along(self, path: Array, first: int, length_m: float) -> float:
        """Distance, m, of points from a path (K, 2), from its point `first` for length_m.

        inf without points.
        """
        return float(_clearance_along(path, first, length_m, self.points))

    def free_arc_length_m(
        self, T_map_base: Array, curvature: float, length_m: float, radius_m: float
    ) -> float:
        """Free length, m, of an arc from a pose (3,) for a disc, at most length_m.

        Along it the disc touches no point and sweeps no unobserved space.
        """
        count = math.ceil(length_m / _SWEEP_STEP_M)
        clear = _clear_steps_on_arc(T_map_base, curvature, length_m, count, self.points, radius_m)
        unseen = self._blind_points_ahead(T_map_base, length_m, radius_m)
        seen = _clear_steps_on_arc(T_map_base, curvature, length_m, count, unseen, radius_m)
        self.is_hidden = seen < clear
        return float(length_m * min(clear, seen) / max(count, 1))

    def _blind_points_ahead(self, T_map_base: Array, length_m: float, radius_m: float) -> Array:
        """Points (K, 2), map frame, in unobserved space that a disc at a pose (3,) may sweep."""
        # The space beside the robot was in front of it one diameter ago.
        points = self._blind_sectors.points(2.0 * radius_m + length_m, 2.0 * radius_m)
        if not len(points):
            return points
        # Directly beside a robot that starts to move, no laser has observed anything yet.
        away = se2.transform_points(se2.invert(T_map_base), points)
        near = np.hypot(away[:, 0], away[:, 1]) < radius_m + MIN_OBSTACLE_WIDTH_M
        return np.asarray(points[~(near & (np.abs(away[:, 1]) > away[:, 0]))])


@kernel
def _clearance_along(path: Array, first: int, length_m: float, points: Array) -> float:
    """Distance, m, of points (N, 2) from a path (K, 2), from its point `first` for length_m.

    inf without points.
    """
    nearest = np.inf
    along = 0.0
    for k in range(first, path.shape[0]):
        if k > first:
            along += math.hypot(path[k, 0] - path[k - 1, 0], path[k, 1] - path[k - 1, 1])
        if along > length_m:
            break
        for i in range(points.shape[0]):
            nearest = min(
                nearest, (points[i, 0] - path[k, 0]) ** 2 + (points[i, 1] - path[k, 1]) ** 2
            )
    return math.sqrt(nearest)


@kernel
def _arc(start: Array, curvature: float, length_m: float, count: int) -> Array:
    """Evenly spaced points (count + 1, 2) of an arc that starts at a pose (3,), m."""
    points = np.empty((count + 1, 2))
    for k in range(count + 1):
        length = length_m * k / max(count, 1)
        half = 0.5 * curvature * length
        chord = length if half == 0.0 else length * math.sin(half) / half
        points[k, 0] = start[0] + chord * math.cos(start[2] + half)
        points[k, 1] = start[1] + chord * math.sin(start[2] + half)
    return points


@kernel
def _clear_steps(centres: Array, points: Array, radius: float) -> int:
    """Index of the last centre (K, 2) that a disc reaches without touching points (N, 2).

    A point that is already too close to the first centre only forbids approaching it further.
    """
    clear: int = centres.shape[0]
    for i in range(points.shape[0]):
        limit = min(radius, math.hypot(points[i, 0] - centres[0, 0], points[i, 1] - centres[0, 1]))
        for k in range(clear):
            if math.hypot(points[i, 0] - centres[k, 0], points[i, 1] - centres[k, 1]) < limit:
                clear = k
                break
    return max(clear - 1, 0)


@kernel
def _clear_steps_on_arc(
    start: Array, curvature: float, length_m: float, count: int, points: Array, radius: float
) -> int:
    """Number of steps, of `count` along an arc, that a disc can move without touching points.

    See `_arc` and `_clear_steps`.
    """
    return _clear_steps(_arc(start, curvature, length_m, count), points, radius)


@kernel
def _smoothed(ranges: Array, i: int) -> float:
    """Smoothed range, m: mean of the neighbouring beams that differ by noise only (NaN: none).

    The nearest of many noisy points is closer than the wall: without smoothing, passages appear too
    narrow.
    """
    total = 0.0
    count = 0
    for k in range(max(i - _NEIGHBOURS, 0), min(i + _NEIGHBOURS + 1, ranges.size)):
        if abs(ranges[k] - ranges[i]) < _SAME_M:
            total += ranges[k]
            count += 1
    return total / count


@kernel
def _points_around(
    ranges: Array, first: float, step: float, laser: Array, earlier: Array, robot: Array
) -> Array:
    """Hits of a scan (NaN: none), and the earlier points (N, 2) that remain valid.

    Those are near the robot pose (3,) and outside the field of view. All in the map frame, m.
    """
    points = np.empty((ranges.size + earlier.shape[0], 2))
    count = 0
    for i in range(ranges.size):
        if not math.isnan(ranges[i]):
            angle = laser[2] + first + step * i
            metres = _smoothed(ranges, i)
            points[count, 0] = laser[0] + metres * math.cos(angle)
            points[count, 1] = laser[1] + metres * math.sin(angle)
            count += 1
    last = first + step * (ranges.size - 1)
    middle = laser[2] + 0.5 * (first + last)
    half = 0.5 * abs(last - first)
    for i in range(earlier.shape[0]):
        dx = earlier[i, 0] - laser[0]
        dy = earlier[i, 1] - laser[1]
        off = math.pi - (math.pi - (math.atan2(dy, dx) - middle)) % (2.0 * math.pi)
        near = (earlier[i, 0] - robot[0]) ** 2 + (earlier[i, 1] - robot[1]) ** 2 < _REMEMBERED_M**2
        if near and abs(off) > half:
            points[count, 0] = earlier[i, 0]
            points[count, 1] = earlier[i, 1]
            count += 1
    return points[:count].copy()
