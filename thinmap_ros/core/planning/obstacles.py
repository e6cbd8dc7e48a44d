"""Obstacles near the robot: points of the scan, blind sectors, what only blocked wheels tell."""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.scan import Scan, with_newest
from thinmap_ros.core.se2 import Array, Cells, Mask
from thinmap_ros.jit import kernel

# Width of the smallest relevant obstacle: a leg. Sectors are sampled at this spacing.
MIN_OBSTACLE_WIDTH_M = 0.1

_REMEMBERED_M = 1.0
_SWEEP_STEP_M = 0.03
_NEIGHBOURS = 2  # beams on either side
_SAME_M = 0.03  # maximum difference of ranges of the same obstacle

# What is where a scan saw free space so long ago has moved, unless noise of pose and ranges did it.
_LATELY_NS = 400_000_000
_MOVED_M = 0.1
_MOVED_BEAMS = 2  # on either side


class _Observation(NamedTuple):
    """Observed ranges (N,), m (NaN: invalid), of a scan, and the laser pose (3,), map frame."""

    seen_m: Array
    first_rad: float
    step_rad: float
    T_map_laser: Array


@dataclass(frozen=True)
class _Views:
    """The newest scan of a laser, and earlier ones."""

    newest: _Observation
    earlier: deque[_Observation]
    lately: deque[tuple[int, _Observation]]  # with their stamps, ns; the oldest first

    def near(self, remembered_m: float) -> Iterator[_Observation]:
        """Earlier scans made within this distance of the newest one, the last ones first."""
        here = self.newest.T_map_laser[:2]
        for earlier in reversed(self.earlier):
            if math.dist(earlier.T_map_laser[:2], here) <= remembered_m:
                yield earlier


class BlindSectors:
    """Sectors of invalid beams in the newest scans, behind which an obstacle may stand.

    Between two valid beams an angle D apart, an obstacle of width w cannot hide closer than w / D.
    The space beyond that in a sector of invalid beams is unobserved, unless another laser, or a
    recent scan, made near by, has observed it.
    """

    def __init__(self, scans: int = 32, apart_m: float = 0.05, apart_rad: float = 0.1) -> None:
        """Remember so many scans, made at least some distance or angle apart."""
        self._apart_m = apart_m
        self._apart_rad = apart_rad
        self._remembered = scans
        self._scans: tuple[Scan, ...] = ()
        self._views: dict[str, _Views] = {}

    def add_scan(self, T_map_laser: Array, scan: Scan) -> None:
        """Add a scan made by a laser at a pose (3,), map frame."""
        seen_m = np.where(scan.hit, scan.ranges_m, np.where(scan.valid, np.inf, np.nan))
        seen_m = np.where(scan.below_range_min, 0.0, seen_m)
        newest = _Observation(seen_m, scan.angle_min_rad, scan.angle_increment_rad, T_map_laser)
        last = self._views.get(scan.frame)
        earlier = deque[_Observation](maxlen=self._remembered) if last is None else last.earlier
        lately = deque[tuple[int, _Observation]]() if last is None else last.lately
        while len(lately) > 1 and lately[1][0] <= scan.stamp_ns - _LATELY_NS:
            lately.popleft()
        lately.append((scan.stamp_ns, newest))
        if last is not None and (
            not earlier
            or se2.are_apart(
                earlier[-1].T_map_laser, last.newest.T_map_laser, self._apart_m, self._apart_rad
            )
        ):
            earlier.append(last.newest)
        self._scans = with_newest(self._scans, scan)
        views = self._views | {scan.frame: _Views(newest, earlier, lately)}
        self._views = {each.frame: views[each.frame] for each in self._scans}

    def have_moved(self, points: Array, frame: str) -> Mask:
        """Which points (K, 2) of the newest scan of a laser are where it saw free space lately."""
        seen_m, first, step, laser = self._views[frame].lately[0][1]
        beside = np.pad(seen_m, _MOVED_BEAMS, constant_values=np.nan)
        shifted = [beside[k : k + seen_m.size] for k in range(2 * _MOVED_BEAMS + 1)]
        least = np.minimum.reduce(shifted) - _MOVED_M
        return np.asarray(_is_seen(points, least, first, step, laser))

    def points(self, reach_m: float, remembered_m: float) -> Array:
        """Points (K, 2), map frame, in unobserved space up to reach_m from the laser.

        remembered_m: earlier scans count if they were made within this distance.
        """
        found = [np.empty((0, 2))]
        for laser in self._views.values():
            newest = laser.newest
            invalid = np.isnan(newest.seen_m)
            points = _sector_points(
                invalid, newest.first_rad, newest.step_rad, newest.T_map_laser, reach_m
            )
            others = [each.newest for each in self._views.values() if each is not laser]
            for seen in chain(others, *(each.near(remembered_m) for each in self._views.values())):
                if not len(points):
                    break
                points = points[~_is_seen(points, *seen)]
            found.append(points)
        return np.concatenate(found)


@kernel
def _sector_points(invalid: Mask, first: float, step: float, laser: Array, reach: float) -> Array:
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
def _is_seen(points: Array, seen: Array, first: float, step: float, laser: Array) -> Mask:
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


class ObstaclePoints:
    """Hits of the newest scan of each laser, and earlier ones near the robot outside their view.

    A laser that looks ahead does not see the corner around which the robot is turning. What one
    sees now stays where another one does not see it: that may look over it, or be shaded.
    points (N, 2): map frame, m; they stay where they were first observed.
    is_hidden: whether a blind sector, not a point, limited the last `free_arc_length_m`.
    """

    def __init__(self) -> None:
        self.points: Array = np.empty((0, 2))
        self.is_hidden = False
        self._blind_sectors = BlindSectors()
        self._scans: tuple[Scan, ...] = ()
        self._hits: dict[str, Array] = {}  # of the newest scan by the frame of its laser
        self._moving: dict[str, Array] = {}  # those of them that have moved
        self._remembered: Array = np.empty((0, 2))

    def add_scan(self, T_map_base: Array, scan: Scan | None) -> None:
        """Add a scan made at a pose (3,). The newest one of a laser may be given again."""
        if scan is None or any(scan is each for each in self._scans):
            return
        self._scans = with_newest(self._scans, scan)
        first = scan.angle_min_rad
        step = scan.angle_increment_rad
        T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
        hits = np.where(scan.hit, scan.ranges_m, np.nan)
        hits = np.where(scan.below_range_min, scan.range_min_m, hits)
        self._blind_sectors.add_scan(T_map_laser, scan)
        others = {each.frame: self._hits[each.frame] for each in self._scans[:-1]}
        past = [points for frame, points in self._hits.items() if frame not in others]
        earlier = np.concatenate([*past, self._remembered])
        points = _points_around(hits, first, step, T_map_laser, earlier, T_map_base)
        count = int(np.count_nonzero(~np.isnan(hits)))
        self._hits = {**others, scan.frame: points[:count]}
        has_moved = self._blind_sectors.have_moved(points[:count], scan.frame)
        still = {frame: self._moving[frame] for frame in others}
        self._moving = {**still, scan.frame: points[:count][has_moved]}
        self._remembered = points[count:]
        self.points = np.concatenate([*self._hits.values(), self._remembered])

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
        self,
        T_map_base: Array,
        curvature: float,
        length_m: float,
        radius_m: float,
        moved_m: float = 0.0,
    ) -> float:
        """Free length, m, of an arc from a pose (3,) for a disc, at most length_m.

        Along it the disc touches no point and sweeps no unobserved space. moved_m: by which points
        that move may come nearer meanwhile.
        """
        count = math.ceil(length_m / _SWEEP_STEP_M)
        arc = _arc(T_map_base, curvature, length_m, count)
        clear = _clear_steps(arc, self.points, radius_m)
        for moving in self._moving.values():
            clear = min(clear, _clear_steps(arc, moving, radius_m + moved_m))
        seen = _clear_steps(arc, self._blind_points_ahead(T_map_base, length_m, radius_m), radius_m)
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


class RecentPath:
    """The last metres of the robot's path; reset when the pose jumps, as after a correction.

    The robot can return along it, even if noise in the map makes a passage appear too narrow. All
    that choose or plan paths remember the same metres, however often each of them hears of a pose:
    else one sends the robot where another one knows no path.
    """

    def __init__(self, step_m: float = 0.03, jump_m: float = 0.5, length_m: float = 300.0) -> None:
        """Keep the last length_m, by points step_m apart or more; longer than jump_m is a jump."""
        self._step_m = step_m
        self._jump_m = jump_m
        self._length_m = length_m
        # Points x, y, and the length of the path to each. Twice as many as are kept: they are moved
        # to the front only when the array is full.
        self._points = np.empty((2 * math.ceil(length_m / step_m + 1), 3))
        self._begin = self._end = 0

    def add_pose(self, T_map_base: Array) -> None:
        """Add a pose of the robot, (3,); poses that are not finite are ignored."""
        if not se2.is_finite(T_map_base):
            return
        x, y, _ = T_map_base.tolist()
        last_x, last_y, along_m = self._points[self._end - 1].tolist()
        away = math.dist((x, y), (last_x, last_y)) if self._end > self._begin else math.inf
        if away > self._jump_m:
            self._begin = self._end = 0
            self._append(x, y, 0.0)
        elif away >= self._step_m:
            self._append(x, y, along_m + away)

    def cells(self, frame: GridFrame, shape: tuple[int, ...]) -> Cells:
        """Cells (N, 2) of a map (H, W) on the path; consecutive cells share an edge."""
        if self._end == self._begin:
            return np.empty((0, 2), dtype=np.int64)
        points = self._points[self._begin : self._end, :2]
        return np.asarray(_connected_cells(frame.cells_of(points), shape[0], shape[1]))

    def _append(self, x: float, y: float, along_m: float) -> None:
        if self._end == len(self._points):
            kept = self._end - self._begin
            self._points[:kept] = self._points[self._begin : self._end]
            self._begin = 0
            self._end = kept
        self._points[self._end] = x, y, along_m
        self._end += 1
        while self._points[self._begin, 2] < along_m - self._length_m:
            self._begin += 1


@kernel
def _connected_cells(cells: Cells, rows: int, cols: int) -> Cells:
    """Cells (N, 2) and the cells between them, first along the column, then along the row.

    Cells outside the map are omitted.
    """
    count = cells.shape[0]
    for k in range(1, cells.shape[0]):
        count += abs(cells[k, 0] - cells[k - 1, 0]) + abs(cells[k, 1] - cells[k - 1, 1])
    found = np.empty((count, 2), dtype=np.int64)
    row = cells[0, 0]
    col = cells[0, 1]
    used = 0
    for k in range(cells.shape[0]):
        while True:
            if 0 <= row < rows and 0 <= col < cols:
                found[used, 0] = row
                found[used, 1] = col
                used += 1
            if row != cells[k, 0]:
                row += 1 if cells[k, 0] > row else -1
            elif col != cells[k, 1]:
                col += 1 if cells[k, 1] > col else -1
            else:
                break
    return found[:used].copy()


# A robot is stuck if it has moved by less than this share of what it was commanded for a while, and
# of so much that the noise of its pose does not matter. The least share of a simulated exploration
# (dungeon/d1573, 543 s) is 0.88; a slow base, and wheels that slip while the localizer corrects
# their odometry, lie between.
_SHARE = 0.1
_WINDOW_S = 1.5
_MIN_PATH_M = 0.2
_MIN_TURN_RAD = 0.5

# Another pose than the one at which the robot was stuck.
_AWAY_M = 0.1
_AWAY_RAD = 0.3
_RING = 2.0 * np.pi * np.arange(8) / 8.0


class _Sample(NamedTuple):
    """Pose (3,), and time, commanded path and turn, and turn of the pose since the first one."""

    T_map_base: Array
    time_s: float
    path_m: float
    commanded_rad: float
    turned_rad: float


class StuckDetector:
    """Detects robots that do not move as commanded.

    Their wheels are blocked, or an obstacle that the laser cannot see is in the way.
    is_turning: whether what was commanded last was a turn on the spot.
    """

    def __init__(self) -> None:
        self.is_turning = False
        self._samples: deque[_Sample] = deque()

    def add(self, T_map_base: Array, v: float, w: float, dt_s: float) -> bool:
        """Add a pose (3,), after a command v (m/s), w (rad/s) of dt_s.

        Returns whether the robot is stuck. A stop restarts the comparison.
        """
        if (v == 0.0 and w == 0.0) or not self._samples:
            self._samples = deque([_Sample(T_map_base, 0.0, 0.0, 0.0, 0.0)])
            return False
        last = self._samples[-1]
        turned = se2.wrap(float(T_map_base[2] - last.T_map_base[2]))
        now = _Sample(
            T_map_base,
            last.time_s + dt_s,
            last.path_m + abs(v) * dt_s,
            last.commanded_rad + w * dt_s,
            last.turned_rad + turned,
        )
        self._samples.append(now)
        while len(self._samples) > 2 and _is_enough(self._samples[1], now):
            self._samples.popleft()
        return self._is_stuck(self._samples[0], now)

    def _is_stuck(self, then: _Sample, now: _Sample) -> bool:
        if not _is_enough(then, now):
            return False
        path_m = now.path_m - then.path_m
        self.is_turning = path_m < _MIN_PATH_M
        if self.is_turning:
            turned = now.turned_rad - then.turned_rad
            is_stuck = abs(turned) < _SHARE * abs(now.commanded_rad - then.commanded_rad)
        else:
            is_stuck = math.dist(now.T_map_base[:2], then.T_map_base[:2]) < _SHARE * path_m
        if is_stuck:
            self._samples.clear()
        return is_stuck


def _is_enough(then: _Sample, now: _Sample) -> bool:
    """Whether so much was commanded meanwhile that a robot must have moved."""
    if now.time_s - then.time_s < _WINDOW_S:
        return False
    is_driven = now.path_m - then.path_m >= _MIN_PATH_M
    return is_driven or abs(now.commanded_rad - then.commanded_rad) >= _MIN_TURN_RAD


class StuckPlaces:
    """Places at which the robot was stuck: discs of its radius ahead of it.

    A robot that is stuck in two directions is blocked itself, and no place is. Until it has turned
    away, a place counts for the goal of that time only. Only having driven there shows that a place
    is free: what blocks the robot may be transparent to the laser.
    """

    def __init__(self, robot_radius_m: float) -> None:
        self._radius_m = robot_radius_m
        self._places: list[Array] = []
        self._stuck: Array | None = None  # pose (3,) at which the robot was stuck, and still is
        self._is_place = False
        self._is_new_goal = False

    def points(self) -> Array:
        """Points (N, 2) on the discs, map frame, m."""
        places = list(self._places)
        if self._stuck is not None and self._is_place and not self._is_new_goal:
            places.append(self._ahead(self._stuck))
        ring = self._radius_m * np.column_stack([np.cos(_RING), np.sin(_RING)])
        discs = [place + np.vstack([ring, np.zeros((1, 2))]) for place in places]
        return np.concatenate(discs) if discs else np.empty((0, 2))

    def goal_set(self) -> None:
        """Try again where the robot has been stuck and has not moved since."""
        self._is_new_goal = True

    def add_pose(self, T_map_base: Array) -> None:
        """Add a pose (3,) of the robot: places that it drives over are free."""
        self._places = [
            place for place in self._places if math.dist(place, T_map_base[:2]) > self._radius_m
        ]
        if self._stuck is None:
            return
        moved = se2.between(self._stuck, T_map_base)
        if moved[0] >= _AWAY_M:
            self._stuck = None  # it drove on
        elif math.hypot(moved[0], moved[1]) >= _AWAY_M or abs(moved[2]) >= _AWAY_RAD:
            if self._is_place:
                self._places.append(self._ahead(self._stuck))
            self._stuck = None

    def add_stuck(self, T_map_base: Array, is_turning: bool) -> bool:
        """The robot is stuck at a pose (3,). Returns whether it was, and has not moved since."""
        is_repeated = self._stuck is not None
        self._is_place = not is_repeated and not is_turning
        self._is_new_goal = False
        if not is_repeated:
            self._stuck = T_map_base
        return is_repeated

    def _ahead(self, T_map_base: Array) -> Array:
        """Centre (2,) of a disc that touches the robot in front."""
        heading = float(T_map_base[2])
        return T_map_base[:2] + 2.0 * self._radius_m * np.array(
            [math.cos(heading), math.sin(heading)]
        )
