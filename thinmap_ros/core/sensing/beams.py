"""What beams mean: without return, at the robot itself, of no laser."""

import math
from collections import deque
from dataclasses import replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.scan import (
    BODY_TOLERANCE_M,
    MIN_HITS,
    NO_RETURN_CLEAR_RANGE_M,
    SURE_REACH,
    Scan,
    is_most_missed,
)
from thinmap_ros.core.se2 import SECOND_NS, Array, Mask
from thinmap_ros.jit import kernel

_MIN_STEP_RAD = 1e-6

# Of lasers that drop returns.
_FAN_REACH = 0.8  # of the range: farther walls at a small angle may have gone out of range

_APART_M = 0.1
_APART_RAD = 0.1

# Odometry drifts little over 4 m of path. Its turns are wrong by some percent: after half a radian,
# by a beam.
_VIEWS = 40
_MAX_TURN_RAD = 0.5
_SAME_SURFACE_M = 0.1
# Measured over whole recordings: at most 0.017 with lasers of 3 to 80 m in rooms, halls and
# outdoors; 0.05 with one that drops 5 % of its returns, 0.27 and 0.53 with cheap ones.
_MAX_MISSED = 0.03
# Measured: at most 0.06 in halls and outdoors, 0.15 and more with lasers that drop returns.
_MAX_WRONG = 0.1

# Of a robot at rest: a beam, and scans before and after it.
_AROUND = 4
_REST_M = 0.01
_REST_RAD = 0.003
_REST_APART_NS = SECOND_NS // 8  # with which a person who walks by has left after those scans
# Measured, of the beams at known surfaces: 0.6, 0.2, 0.011 and 0.005 with cheap and merged scans,
# at most 0.0004 in recordings of others, 0.002 with people before a laser of 3.5 m in a hall.
_MAX_BLINKS = 0.005
_TRUSTED_SCANS = 10
_MIN_AGREEING = 0.8  # of the beams: a robot that moves without odometry sees other ranges
_MIN_KNOWN = 0.15  # of the beams: in a hall, only the edges of people and pillars would count
# Beams without return between hits of one surface: 0.24 of all beams of merged scans; at most
# 0.028 in other recordings, 0.06 before a fence.
_MAX_GAP_BEAMS = 3
_GAP_HITS = 5  # on either side: more than a leg has
_MIN_GAPS = 0.1

# Of a finite range for beams without return. No surface gives exactly the same range to so many
# beams: ranges are noisy, and walls are oblique.
_MIN_SHARE = 0.2
# Real ranges may lie between that value and range_max.
_MAX_BEYOND = 0.05

# Of the robot's own body.
_BODY_REACH_M = 0.7  # a person follows farther behind
_BODY_MOVES_M = 0.5 * BODY_TOLERANCE_M
# Of the views: a laser that drops returns may measure a surface once, and never another one.
_BODY_SHARE = 0.5
_BODY_STRIKES = 2  # views in turn: a single range may be false
# A robot can follow a wall at one distance, and round the end of it. It does not turn in place
# meanwhile.
_BODY_PATH_M = 2.0
_BODY_HEADINGS_RAD = 2.8
_BODY_TURN_RAD = 0.8
_IN_PLACE_M = 0.2  # radius of a turn: nearer to its centre there is only the robot
_JUMP_M = 1.0
_JUMP_RAD = 1.5

# Of scans that no laser measured.
FROZEN = 'the same ranges while the robot moves'
_MOVED = 0.02  # m or rad with which the ranges of any laser must have changed
_DRIFT_PER_S = 0.02  # m or rad: a slower motion is drift of the odometry
NO_RETURNS = 'no returns from surfaces that it has just measured'
_CONFIRMED_NS = 2 * SECOND_NS


class DropoutDetector:
    """Decides from the data whether the beams of a laser without return show free space.

    A laser whose range ends in a hall has no return because nothing is in range. Cheap lasers also
    drop returns of surfaces in range. The second kind contradicts itself: its beams without return
    cross surfaces that it has just measured. While the robot rests, they blink (`_Rest`).
    Views are scans 0.1 m or 0.1 rad apart. In each, the beams are counted that point at a surface
    of earlier views within the range that a beam without return clears, and those of them that have
    no return. No return does not mean free if the laser misses more than 3 % of what it must hit,
    and if that explains a tenth of its beams without return: in a hall most of them are right. A
    laser is trusted at first, with the weight of one scan.
    """

    def __init__(self) -> None:
        self.drops_out = False
        self._rest = _Rest()
        self._views: deque[Array] = deque(maxlen=_VIEWS)
        self._turns_rad: deque[float] = deque(maxlen=_VIEWS)  # before each view
        self._last: Array | None = None
        self._aimed = 0  # beams at surfaces
        self._missed = 0  # of these, without return
        self._unreturned = 0  # beams without return, whatever they point at

    @property
    def miss_ratio(self) -> float:
        """Share of the beams to a known surface that have no return, so far."""
        return (self._missed + self._rest.missed) / max(self._aimed + self._rest.known, 1)

    @property
    def warning(self) -> str:
        """Description of a laser that drops out; '' for any other."""
        if not self.drops_out:
            return ''
        return (
            f'{100.0 * self.miss_ratio:.0f} % of the beams to surfaces that the laser has measured '
            'have no return: no return is taken as unknown, not as free'
        )

    def update(self, scan: Scan, T_odom_base: Array) -> bool:
        """Add a scan made at an odometry pose (3,); returns whether the laser drops returns."""
        if scan.is_blind:
            return self.drops_out
        self._rest.add(scan, T_odom_base)
        if self._last is None or se2.are_apart(self._last, T_odom_base, _APART_M, _APART_RAD):
            self._add_view(scan, T_odom_base)
        # With a gap, so that the verdict on a laser near the limit does not alternate.
        scale = 0.5 if self.drops_out else 1.0
        most = scale * max(
            _MAX_MISSED * (self._aimed + scan.ranges_m.size), _MAX_WRONG * self._unreturned
        )
        self.drops_out = self._missed > most or self._rest.is_contradicted(scale)
        return self.drops_out

    def _add_view(self, scan: Scan, T_odom_base: Array) -> None:
        self._forget_turned(T_odom_base)
        self._last = T_odom_base
        aimed = self._aimed_beams(scan, T_odom_base)
        missed = int(np.count_nonzero(aimed & scan.without_return))
        self._aimed += int(np.count_nonzero(aimed & scan.hit)) + missed
        self._missed += missed
        self._unreturned += int(np.count_nonzero(scan.without_return))
        self._views.append(se2.transform_points(T_odom_base, _surfaces(scan)))

    def _forget_turned(self, T_odom_base: Array) -> None:
        """Forget the views from which the robot has turned too far since."""
        turn_rad = 0.0 if self._last is None else abs(se2.wrap(T_odom_base[2] - self._last[2]))
        self._turns_rad.append(float(turn_rad))
        while self._views and sum(self._turns_rad) > _MAX_TURN_RAD:
            self._views.popleft()
            self._turns_rad.popleft()

    def _aimed_beams(self, scan: Scan, T_odom_base: Array) -> Mask:
        """Which beams (N,) point at a surface of an earlier view."""
        if not self._views:
            return np.zeros(scan.ranges_m.size, dtype=np.bool_)
        T_odom_laser = se2.compose(T_odom_base, scan.T_base_laser)
        fan = (scan.angle_min_rad, scan.angle_increment_rad, _reach_m(scan))
        points = np.vstack(self._views)
        return _interior(_aimed(points, T_odom_laser, scan.ranges_m.size, fan))


class _Rest:
    """Beams of a robot at rest that have no return from a surface which they have just measured.

    A beam blinks where it has no return, and returns from one range in the half of a second before
    and after. At the edges of people and pillars all beams do: those beside it must know a surface,
    too. Beams that never return, as the empty ones of merged scans, lie between many hits of one
    surface. missed: number of both; known: of the beams at known surfaces, they among them.
    """

    def __init__(self) -> None:
        self.missed = 0
        self.known = 0
        self._trusted = 0  # beams of the scans whose weight the laser has from the beginning
        self._scans: deque[tuple[Scan, Array]] = deque(maxlen=2 * _AROUND + 1)

    def is_contradicted(self, scale: float) -> bool:
        """Whether more beams blink than those of a laser that returns; scale: of that limit."""
        return self.missed > scale * _MAX_BLINKS * (self.known + self._trusted)

    def add(self, scan: Scan, T_odom_base: Array) -> None:
        """Add a scan made at an odometry pose (3,)."""
        if self._scans:
            last, T_last = self._scans[-1]
            if 0 <= scan.stamp_ns - last.stamp_ns < _REST_APART_NS:
                return
            is_other = last.ranges_m.size != scan.ranges_m.size
            if is_other or se2.are_apart(T_last, T_odom_base, _REST_M, _REST_RAD):
                self._scans.clear()
        self._scans.append((scan, T_odom_base))
        if len(self._scans) == self._scans.maxlen:
            self._count()

    def _count(self) -> None:
        """Count the beams of the scan in the middle."""
        middle = self._scans[_AROUND][0]
        self._trusted = _TRUSTED_SCANS * middle.ranges_m.size
        ranges = np.array([np.where(scan.hit, scan.ranges_m, np.nan) for scan, _ in self._scans])
        hit = ranges < _reach_m(middle)
        nearest = np.where(hit, ranges, np.inf).min(axis=0)
        farthest = np.where(~np.isnan(ranges), ranges, 0.0).max(axis=0)
        agrees = hit.any(axis=0) & (farthest - nearest < _SAME_SURFACE_M)
        begun = hit[: _AROUND // 2].any(axis=0)
        known = agrees & begun & hit[-_AROUND // 2 :].any(axis=0)
        is_still = agrees.sum() >= _MIN_AGREEING * hit.any(axis=0).sum()
        if not is_still or known.sum() < _MIN_KNOWN * known.size:
            return
        gaps = _gaps(middle)
        known = _interior(known) | gaps
        self.known += int(known.sum())
        self.missed += int(np.count_nonzero(known & middle.without_return))


def _gaps(scan: Scan) -> Mask:
    """Beams (N,) without return between hits of one surface; none where these are few."""
    gaps = np.zeros(scan.ranges_m.size, dtype=np.bool_)
    hits = np.flatnonzero(scan.hit)
    ranges = scan.ranges_m[hits]
    is_surface = np.abs(np.diff(ranges)) < _SAME_SURFACE_M
    is_surface &= (np.diff(hits) <= _MAX_GAP_BEAMS + 1) & (ranges[1:] < _reach_m(scan))
    links = 2 * _GAP_HITS - 1
    if is_surface.size < links:
        return gaps
    inside = np.flatnonzero(np.convolve(is_surface, np.ones(links), 'same') >= links)
    for k in inside[np.diff(hits)[inside] > 1]:
        gaps[hits[k] + 1 : hits[k + 1]] = True
    gaps &= scan.without_return
    return gaps if gaps.sum() >= _MIN_GAPS * gaps.size else np.zeros_like(gaps)


def _reach_m(scan: Scan) -> float:
    """Range within which a surface that was measured returns again."""
    return _FAN_REACH * min(scan.range_max_m, scan.max_range_m, NO_RETURN_CLEAR_RANGE_M)


def _surfaces(scan: Scan) -> Array:
    """Hits (N, 2), robot frame, with a neighbour at the same range: not the mixed pixels."""
    ranges = np.where(scan.hit, scan.ranges_m, np.inf)
    with np.errstate(invalid='ignore'):
        near = np.abs(np.diff(ranges)) < _SAME_SURFACE_M
    surfaces = (np.append(near, False) | np.append(False, near))[scan.hit]
    return np.asarray(scan.points_base()[surfaces])


def _interior(aimed: Mask) -> Mask:
    """The beams (N,) whose neighbours point at a surface, too.

    At its edge a small error of the odometry decides whether a beam meets it.
    """
    inside = np.zeros_like(aimed)
    inside[1:-1] = aimed[:-2] & aimed[1:-1] & aimed[2:]
    return inside


@kernel
def _aimed(points: Array, laser: Array, count: int, fan: tuple[float, float, float]) -> Mask:
    """Which beams (count,) point at one of some points (M, 2) in reach.

    laser (3,): its pose in the frame of the points; fan: bearing of the first beam, angle between
    beams, rad, and reach, m.
    """
    first, step, reach = fan
    aimed = np.zeros(count, dtype=np.bool_)
    for k in range(points.shape[0]):
        dx = points[k, 0] - laser[0]
        dy = points[k, 1] - laser[1]
        if dx * dx + dy * dy >= reach * reach:
            continue
        ahead = (math.atan2(dy, dx) - laser[2] - first) * (1.0 if step > 0.0 else -1.0)
        ahead -= 2.0 * math.pi * math.floor(ahead / (2.0 * math.pi))
        beam = round(ahead / max(abs(step), _MIN_STEP_RAD))
        if beam < count:
            aimed[beam] = True
    return aimed


class NoReturnRange:
    """Largest range of a laser whose driver publishes a value below range_max for no return.

    Drivers publish 2.99 m for a laser of 3 m, or the true range of a laser with a wrong range_max.
    REP 117 takes such a value for a hit, and a wall appears all around the robot. At least a fifth
    of the beams share it in a scan, and hardly any range is larger.
    """

    def __init__(self) -> None:
        self._range_m: float | None = None

    @property
    def warning(self) -> str:
        """Description of such a value; '' where a driver publishes none."""
        if self._range_m is None:
            return ''
        return f'many beams of a scan share the range {self._range_m:.3f} m: taken as no return'

    def applied(self, scan: Scan) -> Scan:
        """The scan, in which the beams with that value have no return."""
        if self._range_m is None or not self._is_largest(scan, self._range_m):
            self._range_m = self._shared(scan)
        return scan if self._range_m is None else replace(scan, range_max_m=self._range_m)

    def _shared(self, scan: Scan) -> float | None:
        """The shared range; None without one, and where all beams share it: that says nothing."""
        ranges = scan.ranges_m[scan.returned]
        if ranges.size < _MIN_SHARE * scan.ranges_m.size:
            return None
        values, counts = np.unique(ranges, return_counts=True)
        most = int(np.argmax(counts))
        shared_m = float(values[most])
        is_shared = _MIN_SHARE * scan.ranges_m.size <= counts[most] < ranges.size
        return shared_m if is_shared and self._is_largest(scan, shared_m) else None

    def _is_largest(self, scan: Scan, range_m: float) -> bool:
        beyond = np.count_nonzero(scan.ranges_m[scan.returned] > range_m)
        return bool(beyond <= _MAX_BEYOND * scan.ranges_m.size)


class _FreezeDetector:
    """Ranges of a real laser are noisy: equal ones, while the robot moves, are an old scan."""

    def __init__(self) -> None:
        self._last: tuple[Scan, Array] | None = None
        self._motion = np.zeros(2)  # since the ranges are the same: path, m, and turn, rad

    def is_frozen(self, scan: Scan, T_odom_base: Array) -> bool:
        """Whether the ranges are those of an earlier pose; T_odom_base (3,)."""
        last = self._last
        self._last = (scan, T_odom_base)
        if last is None or not np.array_equal(last[0].ranges_m, scan.ranges_m, equal_nan=True):
            self._motion = np.zeros(2)
            return False
        seconds = (scan.stamp_ns - last[0].stamp_ns) / SECOND_NS
        x, y, turn = se2.between(last[1], T_odom_base).tolist()
        motion = np.array([math.hypot(x, y), abs(turn)])
        if (motion >= _DRIFT_PER_S * seconds).any():
            self._motion = self._motion + motion
        has_moved = bool((self._motion > _MOVED).any())
        return has_moved and int(np.count_nonzero(scan.hit)) >= MIN_HITS


def _are_missed(surfaces: Array, scan: Scan, T_odom_base: Array) -> bool:
    """Whether a scan at an odometry pose (3,) has no return from most of some points (N, 2).

    surfaces: odometry frame, m.
    """
    T_odom_laser = se2.compose(T_odom_base, scan.T_base_laser)
    local = se2.transform_points(se2.invert(T_odom_laser), surfaces)
    ranges = np.hypot(local[:, 0], local[:, 1])
    near = ranges < SURE_REACH * scan.range_max_m
    bearings = np.arctan2(local[near, 1], local[near, 0]) - scan.angle_min_rad
    step = abs(scan.angle_increment_rad)
    ahead = bearings if scan.angle_increment_rad > 0.0 else -bearings
    # A single beam has no increment.
    beams = np.rint(np.mod(ahead, 2.0 * math.pi) / max(step, _MIN_STEP_RAD))
    beams = beams[beams < scan.ranges_m.size].astype(np.int64)
    return is_most_missed(scan, int(np.count_nonzero(scan.without_return[beams])))


class BodyDetector:
    """Finds the beams of a laser that end at the robot's own body.

    Their ranges stay while the robot drives, turns by nearly 180 degrees, and turns in place.
    Ranges of surfaces change then: of a wall that the robot follows, of a person who follows the
    robot. Views are scans 0.1 m or 0.1 rad apart, of one range for each degree.
    """

    def __init__(self) -> None:
        self._last: Array | None = None
        self._motion = np.zeros(2)  # path, m, and heading, rad
        self._range_m = np.full(360, np.nan)  # of what may be the body
        self._strikes = np.zeros(360, dtype=np.int64)
        # Since the range is that: views, and those with it; path before, headings, turn in place.
        self._views = np.zeros((2, 360), dtype=np.int64)
        self._begun_m = np.zeros(360)
        self._headings = np.zeros((2, 360))
        self._turns = np.zeros((2, 360))
        self._is_body = np.zeros(360, dtype=np.bool_)
        self._body_m: Array | None = None
        self._is_mirrored = False

    @property
    def warning(self) -> str:
        """Description of the body that the laser sees; '' where it sees none."""
        if self._body_m is None:
            return ''
        text = _sectors_text(~np.isnan(self._body_m), self._is_mirrored)
        return (
            f"the laser sees the robot's own body at bearings of {text} deg: left out; set "
            f'body_sectors to "{text}"'
        )

    def applied(self, scan: Scan, T_odom_base: Array) -> Scan:
        """The scan, made at an odometry pose (3,), without the beams at the body."""
        if self._last is None or se2.are_apart(self._last, T_odom_base, _APART_M, _APART_RAD):
            self._move(T_odom_base)
            self._add_view(_by_degree(scan))
            self._is_mirrored = scan.is_mirrored
        return scan.without_body(self._body_m)

    def _move(self, T_odom_base: Array) -> None:
        moved = se2.between(T_odom_base if self._last is None else self._last, T_odom_base)
        self._last = T_odom_base
        path_m = math.hypot(moved[0], moved[1])
        turn_rad = float(moved[2])
        if path_m > _JUMP_M or abs(turn_rad) > _JUMP_RAD:
            self._range_m[~self._is_body] = np.nan
            return
        is_in_place = path_m < _IN_PLACE_M * abs(turn_rad)
        self._motion = self._motion + [path_m, turn_rad]
        self._turns[0] = self._turns[0] + turn_rad if is_in_place else 0.0

    def _add_view(self, ranges: Array) -> None:
        agrees = np.abs(ranges - self._range_m) < _BODY_MOVES_M
        self._strikes = np.where(agrees, 0, self._strikes + ~np.isnan(ranges))
        is_new = np.isnan(self._range_m) | (self._strikes >= _BODY_STRIKES)
        self._range_m[is_new] = np.where(ranges < _BODY_REACH_M, ranges, np.nan)[is_new]
        self._strikes[is_new] = 0
        self._views[:, is_new] = 0
        self._views += [np.ones_like(agrees), agrees]
        path_m, heading = self._motion
        self._begun_m[is_new] = path_m
        self._headings[:, is_new] = heading
        self._turns[:, is_new] = 0.0
        self._headings[0] = np.minimum(self._headings[0], heading)
        self._headings[1] = np.maximum(self._headings[1], heading)
        self._turns[1] = np.maximum(self._turns[1], np.abs(self._turns[0]))
        is_body = ~np.isnan(self._range_m) & (path_m - self._begun_m >= _BODY_PATH_M)
        is_body &= self._headings[1] - self._headings[0] >= _BODY_HEADINGS_RAD
        is_body &= self._views[1] > _BODY_SHARE * self._views[0]
        self._is_body = is_body & (self._turns[1] >= _BODY_TURN_RAD)
        self._set_body()

    def _set_body(self) -> None:
        """Set the degrees (360,) of the body, with one more beside each: their beams are mixed."""
        core = np.where(self._is_body, self._range_m, np.nan)
        body_m = np.fmin.reduce([core, np.roll(core, 1), np.roll(core, -1)])
        before = np.full(360, np.nan) if self._body_m is None else self._body_m
        if not np.array_equal(body_m, before, equal_nan=True):
            self._body_m = None if np.isnan(body_m).all() else body_m


def _by_degree(scan: Scan) -> Array:
    """Nearest range of each degree from -180, (360,): inf without return, NaN where unknown."""
    ranges = np.full(360, np.nan)
    known = scan.returned | scan.no_return
    ends = np.where(scan.returned, scan.ranges_m, np.inf)[known]
    np.fmin.at(ranges, scan.degrees[known], ends)
    return ranges


def _sectors_text(is_body: Mask, is_mirrored: bool) -> str:
    """Sectors of degrees (360,) from -180, as the parameter `body_sectors`."""
    if is_mirrored:
        is_body = np.roll(is_body[::-1], 1)
    if is_body.all():
        return '-180 180'
    begin = np.flatnonzero(is_body & ~np.roll(is_body, 1))
    end = np.flatnonzero(is_body & ~np.roll(is_body, -1))
    if end[0] < begin[0]:
        end = np.roll(end, -1)
    pairs = zip((begin - 180.5).tolist(), (end - 179.5).tolist(), strict=True)
    return ', '.join(f'{low:g} {high:g}' for low, high in pairs)


class LaserMonitor:
    """Replaces scans that the laser did not measure by blind ones, and recognizes dropouts.

    A frozen driver repeats its ranges with new stamps. A laser that has failed may report no return
    for its beams: walls do not vanish from one scan to the next. Such a scan is blind, until walls
    are measured again, or scans agree with each other for some time (the robot was carried away).
    The scans of a laser that often has no return from surfaces in range are marked (`drops_out`).
    Beams that end at the robot's own body are invalid.
    """

    def __init__(self) -> None:
        self._freeze = _FreezeDetector()
        self._no_return = NoReturnRange()
        self._dropouts = DropoutDetector()
        self._body = BodyDetector()
        # Ends of hits (N, 2), odometry frame, m.
        self._trusted = np.empty((0, 2))
        self._previous = np.empty((0, 2))
        self._doubted_ns: int | None = None  # first scan of a series that agrees with itself only

    @property
    def warnings(self) -> dict[str, str]:
        """What the laser or its driver do otherwise than REP 117, by kind."""
        texts = {
            'no return': self._no_return.warning,
            'dropouts': self._dropouts.warning,
            'body': self._body.warning,
        }
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
        if self._dropouts.update(scan, T_odom_base):
            scan = replace(scan, drops_out=True)
        return self._body.applied(scan, T_odom_base)

    def _has_failed(self, scan: Scan, T_odom_base: Array) -> bool:
        surfaces = se2.transform_points(T_odom_base, scan.points_base())
        is_empty = len(surfaces) < MIN_HITS
        contradicts = _are_missed(self._trusted, scan, T_odom_base)
        contradicts |= self._doubted_ns is not None and is_empty
        if contradicts and self._doubted_ns is not None and not is_empty:
            agrees = not _are_missed(self._previous, scan, T_odom_base)
            contradicts = not agrees or scan.stamp_ns - self._doubted_ns < _CONFIRMED_NS
            self._doubted_ns = self._doubted_ns if agrees else scan.stamp_ns
        elif contradicts:
            self._doubted_ns = scan.stamp_ns
        self._previous = surfaces
        if not contradicts:
            self._trusted = surfaces
            self._doubted_ns = None
        return contradicts
