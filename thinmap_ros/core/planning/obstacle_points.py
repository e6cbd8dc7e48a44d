"""What the laser sees round the robot, as points, and how far a disc can be moved among them."""

import math

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.planning.blind_sectors import MIN_OBSTACLE_WIDTH_M, BlindSectors
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

_REMEMBERED_M = 1.0
_SWEEP_STEP_M = 0.03
_BESIDE = 2  # beams to either side
_SAME_M = 0.03  # by how much those that see the same thing differ


class ObstaclePoints:
    """Where the beams of the newest scan ended, and points seen earlier where it does not look.

    The latter only as long as they are near.

    A laser that looks ahead only does not see the corner any more round which the robot is turning.
    points (N, 2): in the map frame, m; they keep the place where they were first seen.
    hidden: whether it was an unseen sector, not a point, that came first in the last `clear_m`.
    """

    def __init__(self) -> None:
        self.points: Array = np.empty((0, 2))
        self.hidden = False
        self._unseen = BlindSectors()
        self._scan: Scan | None = None

    def look(self, T_map_base: Array, scan: Scan | None) -> None:
        """Take a scan made at a pose (3,).

        The one taken last may be given again while the robot moves on.
        """
        if scan is None or scan is self._scan:
            return
        self._scan = scan
        first = scan.angle_min_rad
        step = scan.angle_increment_rad
        T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
        hits = np.where(scan.hit, scan.ranges_m, np.nan)
        hits = np.where(scan.below_range_min, scan.range_min_m, hits)
        self._unseen.observe(T_map_laser, scan)
        self.points = _points_around(hits, first, step, T_map_laser, self.points, T_map_base)

    def within(self, T_map_base: Array, reach_m: float) -> Array:
        """Points (M, 2), m, nearer than reach_m to a pose (3,)."""
        return np.asarray(
            self.points[np.square(self.points - T_map_base[:2]).sum(axis=1) < reach_m**2]
        )

    def room_along(self, path: Array, first: int, length_m: float) -> float:
        """How near points are to a path (K, 2) from its point `first` on for some length, m.

        Without points: inf.
        """
        return float(_room_along(path, first, length_m, self.points))

    def free_arc_length_m(
        self, T_map_base: Array, curvature: float, length_m: float, radius_m: float
    ) -> float:
        """How far, m, a disc can be moved along an arc from a pose (3,), at most length_m.

        It touches nothing on that way, and nothing of what it sweeps is unseen.
        """
        count = math.ceil(length_m / _SWEEP_STEP_M)
        clear = _clear_steps_on_arc(T_map_base, curvature, length_m, count, self.points, radius_m)
        unseen = self._unseen_ahead(T_map_base, length_m, radius_m)
        seen = _clear_steps_on_arc(T_map_base, curvature, length_m, count, unseen, radius_m)
        self.hidden = seen < clear
        return float(length_m * min(clear, seen) / max(count, 1))

    def _unseen_ahead(self, T_map_base: Array, length_m: float, radius_m: float) -> Array:
        """Points (K, 2), map frame, in what is unseen and may be swept by a disc at a pose (3,)."""
        # What lies beside the robot now was in front of it one diameter ago.
        points = self._unseen.points(2.0 * radius_m + length_m, 2.0 * radius_m)
        if not len(points):
            return points
        # Right at its sides, a robot that begins to move has seen nothing, whatever its laser.
        away = se2.transform_points(se2.invert(T_map_base), points)
        near = np.hypot(away[:, 0], away[:, 1]) < radius_m + MIN_OBSTACLE_WIDTH_M
        return np.asarray(points[~(near & (np.abs(away[:, 1]) > away[:, 0]))])


@kernel
def _room_along(path: Array, first: int, length_m: float, points: Array) -> float:
    """How near points (N, 2) are to a path (K, 2) from its point `first` on for some length, m.

    Without points: inf.
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
    """Points (count + 1, 2), evenly spaced, of an arc that begins at a pose (3,), m."""
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
    """Index of the last centre (K, 2) to which a disc can be moved, one after the other.

    It touches none of the points (N, 2) on its way.

    A point that is too near to the first centre already only forbids to come still nearer.
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
    """How many of `count` steps along an arc a disc can be moved without touching points.

    See `_arc` and `_clear_steps`.
    """
    return _clear_steps(_arc(start, curvature, length_m, count), points, radius)


@kernel
def _smoothed(ranges: Array, i: int) -> float:
    """A range of a scan (NaN: none), m: the mean of the beams beside it that differ by noise only.

    The nearest of many noisy points is nearer than the wall: without this, passages would seem
    narrower than they are.
    """
    total = 0.0
    count = 0
    for k in range(max(i - _BESIDE, 0), min(i + _BESIDE + 1, ranges.size)):
        if abs(ranges[k] - ranges[i]) < _SAME_M:
            total += ranges[k]
            count += 1
    return total / count


@kernel
def _points_around(
    ranges: Array, first: float, step: float, laser: Array, earlier: Array, robot: Array
) -> Array:
    """Where the beams of a scan ended (NaN: nowhere), and what counts of the points seen before.

    Of those (N, 2), the ones near to the robot's pose (3,) that lie beside the scan's field of
    view. All in the map frame, m.
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
