"""Lines of a scan, line features, and the models of motion and observation."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.config import Config, laser_range_noise, parameter
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, rotation, transform_points, wrap
from thinmap_ros.jit import kernel


@dataclass(eq=False)
class FeatureTrack:
    """A feature's id, and the observed interval [low, high] (m) of its line.

    Positions along a line are relative to the foot of the perpendicular from the map's origin,
    positive to the left of the normal. first_seen_from (2,): position of the laser at the first
    observation, map frame, m. misses: number of consecutive scans that saw through the feature.
    unseen: number of scans since the last observation.
    """

    id: int
    low: float
    high: float
    first_seen_from: Array
    misses: int = 0
    unseen: int = 0

    def grow(self, low: float, high: float) -> None:
        """Extend the interval to include another one, m."""
        self.low = min(self.low, low)
        self.high = max(self.high, high)


@dataclass(frozen=True, eq=False)
class LineFeature:
    """A feature for display and storage.

    r_m >= 0 and alpha_rad with their covariance (2, 2); start, end (2,): m, map frame; nodes: ids
    of the topological nodes at which it is stored; local: whether it is in the local area.
    """

    id: int
    r_m: float
    alpha_rad: float
    covariance: Array
    start: Array
    end: Array
    nodes: list[int]
    local: bool


def normals_of(lines: Array) -> Array:
    """Unit normals (N, 2) of lines (N, 2) as (r, alpha)."""
    return _paired(np.cos(lines[:, 1]), np.sin(lines[:, 1]))


def tangents_of(lines: Array) -> Array:
    """Unit tangents (N, 2) of lines (N, 2): their normals rotated by 90 degrees to the left."""
    return _paired(-np.sin(lines[:, 1]), np.cos(lines[:, 1]))


def _paired(x: Array, y: Array) -> Array:
    """(N, 2) of x (N,) and y (N,); np.column_stack is too slow for such frequent calls."""
    pairs = np.empty((x.size, 2))
    pairs[:, 0] = x
    pairs[:, 1] = y
    return pairs


def sides_of(lines: Array, points: Array) -> Array:
    """Side (N,) of lines (N, 2) on which points (N, 2), or one point (2,), are.

    1: the side of the origin; -1: the other side.
    """
    return np.where(lines[:, 0] - (normals_of(lines) * points).sum(axis=1) >= 0.0, 1.0, -1.0)


def interval(line: Array, points: Array) -> tuple[float, float]:
    """Lowest and highest position of points (M, 2) along a line (r, alpha), m."""
    along = points @ tangents_of(line[None])[0]
    return float(along.min()), float(along.max())


def ends_of(feature: FeatureTrack, line: Array) -> Array:
    """Ends (2, 2) of a feature on its line (r, alpha), map frame."""
    positions = np.array([[feature.low], [feature.high]])
    return np.asarray(line[0] * normals_of(line[None]) + positions * tangents_of(line[None]))


def as_seen(
    feature: FeatureTrack, line: Array, covariance: Array, nodes: list[int], local: bool
) -> LineFeature:
    """LineFeature of a feature with its current line (r, alpha), converted to r >= 0."""
    start, end = ends_of(feature, line)
    if line[0] < 0.0:
        signs = np.array([-1.0, 1.0])
        line = np.array([-line[0], line[1] + np.pi])
        covariance = signs[:, None] * covariance * signs
    return LineFeature(
        feature.id, float(line[0]), wrap(float(line[1])), covariance, start, end, nodes, local
    )


@dataclass(frozen=True)
class OdometryConfig(Config):
    """Noise of odometry, 1 sigma."""

    noise_ratio: float = parameter(
        0.03,
        'Standard deviation of odometry per metre or radian of motion, besides its systematic '
        'error, which is calibrated. Smallest value; it grows where scans find more. Raise it for '
        'wheels that slip, lower it for an odometry that is better than that.',
        low=0.001,
        high=2.0,
    )
    noise_floor_m: float = parameter(
        0.003,
        'Smallest standard deviation of the position in an odometry increment (m). Raise it if the '
        'pose sticks where the robot is pushed, lower it if it drifts at a standstill.',
        low=1e-5,
        high=1.0,
    )
    noise_floor_rad: float = parameter(
        0.003,
        'Smallest standard deviation of the heading in an odometry increment (rad). Raise it if '
        'the heading sticks where the robot is turned, lower it if it drifts at a standstill.',
        low=1e-5,
        high=1.0,
    )


def odometry_slip(config: OdometryConfig) -> Array:
    """Smallest error (3,), 1 sigma, of an odometry increment."""
    return np.array([config.noise_floor_m, config.noise_floor_m, config.noise_floor_rad])


def odometry_variances(increment: Array, config: OdometryConfig) -> Array:
    """Variances (3,) of an odometry increment (3,), in the robot frame before the motion."""
    length_m = math.hypot(increment[0], increment[1])
    turn = abs(float(increment[2]))
    sigmas = odometry_slip(config) + config.noise_ratio * np.array([length_m, length_m, turn])
    return np.square(sigmas)


def motion_jacobians(T_map_base: Array, increment: Array) -> tuple[Array, Array]:
    """F_x and F_u, (3, 3) each, of T_map_base o increment.

    Source: EKF-SLAM/TI paper eqs. (10), (11).
    """
    F_u = rotation(float(T_map_base[2]))
    dx, dy, _ = F_u @ increment
    F_x = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    return F_x, F_u


def observe_line(T_map_base: Array, line: Array) -> tuple[Array, Array, Array]:
    """Predicted observation (2,) of a map line (r, alpha), robot frame.

    Also returns its Jacobians w.r.t. the pose (2, 3) and the line (2, 2).

    Source: EKF-SLAM/TI paper eq. (3), which is illegible in the text. For a line
    x cos(alpha) + y sin(alpha) = r it is
    r^R = r - (x cos(alpha) + y sin(alpha)), alpha^R = alpha - theta,
    and if r^R < 0: -r^R, alpha^R + pi.
    """
    x, y, theta = (float(v) for v in T_map_base)
    r = float(line[0])
    alpha = float(line[1])
    c = math.cos(alpha)
    s = math.sin(alpha)
    distance = r - (x * c + y * s)
    bearing = alpha - theta
    sign = 1.0
    if distance < 0.0:
        distance = -distance
        bearing = bearing + math.pi
        sign = -1.0
    by_pose = np.array([[-sign * c, -sign * s, 0.0], [0.0, 0.0, -1.0]])
    by_line = np.array([[sign, sign * (x * s - y * c)], [0.0, 1.0]])
    return np.array([distance, wrap(bearing)]), by_pose, by_line


def place_line(T_map_base: Array, seen: Array) -> tuple[Array, Array, Array]:
    """Line (2,), map frame, of an observed line (r, alpha), robot frame.

    Also returns its Jacobians w.r.t. the pose (2, 3) and the observation (2, 2).

    The inverse of `observe_line`; r >= 0 in the map, too.
    """
    x, y, theta = (float(v) for v in T_map_base)
    alpha = float(seen[1]) + theta
    c = math.cos(alpha)
    s = math.sin(alpha)
    r = float(seen[0]) + x * c + y * s
    sign = 1.0
    if r < 0.0:
        r = -r
        alpha = alpha + math.pi
        sign = -1.0
    turn = sign * (-x * s + y * c)
    by_pose = np.array([[sign * c, sign * s, turn], [0.0, 0.0, 1.0]])
    by_seen = np.array([[sign, turn], [0.0, 1.0]])
    return np.array([r, wrap(alpha)]), by_pose, by_seen


# Of the extraction of lines.
_FLATTEST_RAD = math.radians(10.0)  # smallest usable angle between wall and beam

_WIDEST_GAP_M = 0.6  # largest gap in a wall: narrower than a door

_MAX_MISSING = 2  # largest number of adjacent beams without return inside a wall

_MIN_LENGTH_M = 0.8  # of a line: furniture is shorter

_MAX_SAGITTA_M = 0.02  # rise of the points over the chord of a line: that of rough walls

_MAX_CHI2 = 3.0  # per degree of freedom: rough walls pass, clutter does not

_TRIM_SIGMAS = 3.0  # end points with a larger distance are mixed pixels or on the next wall

# Columns of the fit of a line.
_R, _ALPHA, _RR, _RA, _AA, _CHI2, _BOW, _BOW_SIGMA, _LOW, _HIGH = range(10)


@dataclass(frozen=True)
class LineConfig(Config):
    """Parameters of line extraction and the noise of the beams.

    split_sigmas: smallest distance of a split, in standard deviations of a range.
    """

    laser_range_noise_m: float = laser_range_noise()
    bearing_noise_rad: float = parameter(
        0.002,
        'Standard deviation of a bearing (rad). Set it to the noise of the laser.',
        low=0.0,
        high=0.1,
    )
    max_range_m: float = parameter(
        20.0,
        'Points beyond this range are not used for lines (m), nor are those beyond the usable '
        'range of the laser, max_range_m. Lower it for a laser whose beams are so far apart that '
        'distant points are too sparse to be a wall.',
        low=1.0,
        high=200.0,
    )
    split_distance_m: float = parameter(
        0.05,
        'Distance of a point from the chord at which a line is split (m). Raise it for a noisy '
        'laser, lower it to resolve shallow corners.',
        low=0.005,
        high=1.0,
    )
    min_points: int = parameter(
        8,
        'Smallest number of points of a line. Raise it against lines on clutter, lower it for a '
        'laser with few beams.',
        low=4,
        high=1000,
    )
    split_sigmas: float = 4.0


@dataclass(frozen=True, eq=False)
class Lines:
    """Line segments of a scan, robot frame.

    z (K, 2) as (r, alpha), r >= 0; covariances (K, 2, 2); ends (K, 2, 2), m.
    """

    z: Array
    covariances: Array
    ends: Array

    def __len__(self) -> int:
        return len(self.z)

    @property
    def lengths_m(self) -> Array:
        """Lengths (K,) of the segments."""
        return np.asarray(np.hypot(*(self.ends[:, 1] - self.ends[:, 0]).T))

    def select(self, which: NDArray[np.int64]) -> 'Lines':
        """The lines at some indices (M,)."""
        return Lines(self.z[which], self.covariances[which], self.ends[which])


def no_lines() -> Lines:
    """Lines of an empty scan: none."""
    return Lines(np.empty((0, 2)), np.empty((0, 2, 2)), np.empty((0, 2, 2)))


def extract_lines(scan: Scan, config: LineConfig) -> Lines:
    """Extract the line segments of a scan, robot frame, in the order of the beams.

    Split and merge, with a weighted least-squares fit that minimises
    sum w (rho cos(phi - alpha) - r)^2. A run of beams ends if two neighbours are farther apart than
    on a wall at the smallest usable angle of incidence. A run is split at the point farthest from
    the chord of its ends while this distance exceeds the noise (iterative end point fit). Adjacent
    parts that fit one line are merged again. A segment is accepted if it has enough points, is long
    enough, has residuals within the noise, and has no curvature (round columns make short chords).
    Source: EKF-SLAM/TI paper section 4 (least-squares lines, reference [9] there); the breakpoints
    after Borges and Aldon, "Line extraction in 2D range images", 2004.
    """
    beams = np.flatnonzero(scan.hit & (scan.ranges_m < config.max_range_m))
    if beams.size < config.min_points:
        return no_lines()
    split_m = max(config.split_distance_m, config.split_sigmas * config.laser_range_noise_m)
    sigmas = np.array([config.laser_range_noise_m, config.bearing_noise_rad, split_m])
    ranges = scan.ranges_m[beams]
    angles = scan.angles_rad[beams]
    x = ranges * np.cos(angles)
    y = ranges * np.sin(angles)
    step = abs(scan.angle_increment_rad)
    fits, count = _extract(x, y, ranges, angles, beams, step, sigmas, config.min_points)
    fits = fits[:count]
    length = fits[:, _HIGH] - fits[:, _LOW]
    straight = (fits[:, _BOW] < _MAX_SAGITTA_M) | (fits[:, _BOW] < 3.0 * fits[:, _BOW_SIGMA])
    good = (length >= _MIN_LENGTH_M) & (fits[:, _CHI2] < _MAX_CHI2) & straight
    return _in_robot_frame(fits[good], scan.T_base_laser)


def _in_robot_frame(fits: Array, T_base_laser: Array) -> Lines:
    """Transform fitted lines from the laser frame to the robot frame."""
    r = fits[:, _R]
    alpha = fits[:, _ALPHA]
    normals = np.column_stack([np.cos(alpha), np.sin(alpha)])
    along = np.column_stack([-normals[:, 1], normals[:, 0]])
    feet = r[:, None] * normals
    ends = np.stack([feet + fits[:, [_LOW]] * along, feet + fits[:, [_HIGH]] * along], axis=1)
    alpha_base = alpha + T_base_laser[2]
    # r_base = r + m n(alpha_base), so an error of alpha moves r by m t(alpha_base).
    c = np.cos(alpha_base)
    s = np.sin(alpha_base)
    r_base = r + T_base_laser[0] * c + T_base_laser[1] * s
    lever = -T_base_laser[0] * s + T_base_laser[1] * c
    rr = fits[:, _RR] + 2.0 * lever * fits[:, _RA] + lever**2 * fits[:, _AA]
    ra = fits[:, _RA] + lever * fits[:, _AA]
    sign = np.where(r_base < 0.0, -1.0, 1.0)
    z = np.column_stack([sign * r_base, wrap(alpha_base + np.where(sign < 0.0, np.pi, 0.0))])
    covariances = np.stack([rr, sign * ra, sign * ra, fits[:, _AA]], axis=1).reshape(-1, 2, 2)
    return Lines(
        z, covariances, transform_points(T_base_laser, ends.reshape(-1, 2)).reshape(-1, 2, 2)
    )


@kernel
def _extract(
    x: Array,
    y: Array,
    ranges: Array,
    angles: Array,
    beams: NDArray[np.int64],
    step: float,
    sigmas: Array,
    fewest: int,
) -> tuple[Array, int]:
    """Fits (N, 10) of all segments, in the first rows, and their number.

    sigmas (3,): range noise m, bearing noise rad, split distance m.
    """
    fits = np.empty((ranges.size, 10))
    fit = np.empty(10)
    parts = np.empty((ranges.size + 2, 2), dtype=np.int64)
    stack = np.empty((ranges.size + 2, 2), dtype=np.int64)
    count = 0
    first = 0
    for end in range(1, ranges.size + 1):
        if end < ranges.size and not _apart(x, y, ranges, beams, step, sigmas[0], end):
            continue
        number = _split(x, y, first, end, sigmas[2], parts, stack)
        first = end
        k = 0
        while k < number:
            a = parts[k, 0]
            b = parts[k, 1]
            # Merge with the parts that follow while one line explains both.
            while k + 1 < number:
                _fit(x, y, ranges, angles, a, parts[k + 1, 1], sigmas, fit)
                if fit[_CHI2] > _MAX_CHI2 or fit[_BOW] > 0.5 * sigmas[2]:
                    break
                k += 1
                b = parts[k, 1]
            a, b = _fit_trimmed(x, y, ranges, angles, a, b, sigmas, fewest, fit)
            if b - a >= fewest:
                for column in range(fit.size):
                    fits[count, column] = fit[column]
                count += 1
            k += 1
    return fits, count


@kernel
def _apart(
    x: Array, y: Array, ranges: Array, beams: NDArray[np.int64], step: float, sigma: float, i: int
) -> bool:
    """Whether point i is too far from point i - 1 to be on the same wall."""
    turn = (beams[i] - beams[i - 1]) * step
    if beams[i] - beams[i - 1] > 1 + _MAX_MISSING or turn >= 0.9 * _FLATTEST_RAD:
        return True
    reach = (
        min(ranges[i], ranges[i - 1]) * math.sin(turn) / math.sin(_FLATTEST_RAD - turn)
        + 3.0 * sigma
    )
    return bool(math.hypot(x[i] - x[i - 1], y[i] - y[i - 1]) > min(reach, _WIDEST_GAP_M))


@kernel
def _split(
    x: Array,
    y: Array,
    first: int,
    end: int,
    distance: float,
    parts: NDArray[np.int64],
    stack: NDArray[np.int64],
) -> int:
    """Split a run [first, end) of points into parts that are near their chords.

    Returns the number of parts.
    """
    count = 0
    depth = 1
    stack[0, 0] = first
    stack[0, 1] = end
    while depth > 0:
        depth -= 1
        a = stack[depth, 0]
        b = stack[depth, 1]
        dx = x[b - 1] - x[a]
        dy = y[b - 1] - y[a]
        length = max(math.hypot(dx, dy), 1e-9)
        worst = distance
        at = -1
        for i in range(a + 1, b - 1):
            away = abs(dx * (y[i] - y[a]) - dy * (x[i] - x[a])) / length
            if away > worst:
                worst = away
                at = i
        if at < 0:
            parts[count, 0] = a
            parts[count, 1] = b
            count += 1
        else:
            stack[depth, 0] = at
            stack[depth, 1] = b
            stack[depth + 1, 0] = a
            stack[depth + 1, 1] = at + 1
            depth += 2
    return count


@kernel
def _fit_trimmed(
    x: Array,
    y: Array,
    ranges: Array,
    angles: Array,
    a: int,
    b: int,
    sigmas: Array,
    fewest: int,
    fit: Array,
) -> tuple[int, int]:
    """Fit points [a, b) without end points that are outliers; returns the remaining [a, b)."""
    for _ in range(4):
        _fit(x, y, ranges, angles, a, b, sigmas, fit)
        start = a
        stop = b
        while b - a >= fewest and _off(x, y, ranges, angles, a, sigmas, fit) > _TRIM_SIGMAS:
            a += 1
        while b - a >= fewest and _off(x, y, ranges, angles, b - 1, sigmas, fit) > _TRIM_SIGMAS:
            b -= 1
        if a == start and b == stop:
            break
    return a, b


@kernel
def _variance(rho: float, off: float, sigmas: Array) -> float:
    """Variance of a point across a line, at an angle `off` between its beam and the normal."""
    across = sigmas[0] * math.cos(off)
    along = sigmas[1] * rho * math.sin(off)
    return float(across * across + along * along + 1e-8)


@kernel
def _off(
    x: Array, y: Array, ranges: Array, angles: Array, i: int, sigmas: Array, fit: Array
) -> float:
    """Distance of a point from a fitted line, in sigmas."""
    distance = x[i] * math.cos(fit[_ALPHA]) + y[i] * math.sin(fit[_ALPHA]) - fit[_R]
    return float(abs(distance)) / math.sqrt(_variance(ranges[i], angles[i] - fit[_ALPHA], sigmas))


@kernel
def _fit(
    x: Array, y: Array, ranges: Array, angles: Array, a: int, b: int, sigmas: Array, fit: Array
) -> None:
    """Weighted total least squares through points [a, b), with covariance, chi2 and bow.

    The covariance is (J' W J)^-1, with J the derivative of each point's distance with respect to
    (r, alpha). The bow is the parabolic component of the residuals.
    """
    chord = math.atan2(y[b - 1] - y[a], x[b - 1] - x[a])
    alpha = chord - 0.5 * math.pi
    mx = 0.0
    my = 0.0
    total = 0.0
    for _ in range(2):
        mx = 0.0
        my = 0.0
        total = 0.0
        for i in range(a, b):
            w = 1.0 / _variance(ranges[i], angles[i] - alpha, sigmas)
            mx = mx + w * x[i]
            my = my + w * y[i]
            total = total + w
        mx = mx / total
        my = my / total
        xx = 0.0
        xy = 0.0
        yy = 0.0
        for i in range(a, b):
            w = 1.0 / _variance(ranges[i], angles[i] - alpha, sigmas)
            dx = x[i] - mx
            dy = y[i] - my
            xx = xx + w * dx * dx
            xy = xy + w * dx * dy
            yy = yy + w * dy * dy
        alpha = 0.5 * math.atan2(-2.0 * xy, yy - xx)
    c = math.cos(alpha)
    s = math.sin(alpha)
    r = mx * c + my * s
    if r < 0.0:
        r = -r
        alpha = alpha + math.pi
        c = -c
        s = -s
    foot = -mx * s + my * c
    spread = 0.0
    chi2 = 0.0
    low = np.inf
    high = -np.inf
    for i in range(a, b):
        w = 1.0 / _variance(ranges[i], angles[i] - alpha, sigmas)
        t = -x[i] * s + y[i] * c
        d = x[i] * c + y[i] * s - r
        spread = spread + w * (t - foot) ** 2
        chi2 = chi2 + w * d * d
        low = min(low, t)
        high = max(high, t)
    spread = max(spread, 1e-12)
    # The errors of the mean and of the direction are independent. A rotation about the mean changes
    # r by foot times the angle.
    fit[_R] = r
    fit[_ALPHA] = alpha
    fit[_AA] = 1.0 / spread
    fit[_RA] = foot / spread
    fit[_RR] = 1.0 / total + foot * foot / spread
    fit[_CHI2] = chi2 / max(b - a - 2, 1)
    fit[_LOW] = low
    fit[_HIGH] = high
    fit[_BOW], fit[_BOW_SIGMA] = _bow(x, y, ranges, angles, a, b, sigmas, fit, foot, spread / total)


@kernel
def _bow(
    x: Array,
    y: Array,
    ranges: Array,
    angles: Array,
    a: int,
    b: int,
    sigmas: Array,
    fit: Array,
    middle: float,
    spread: float,
) -> tuple[float, float]:
    """Rise of the parabola of the residuals over half of the line, m, and its sigma.

    middle, spread: mean and variance of the positions t along the line.
    """
    half = max(0.5 * (fit[_HIGH] - fit[_LOW]), 1e-6)
    c = math.cos(fit[_ALPHA])
    s = math.sin(fit[_ALPHA])
    product = 0.0
    square = 0.0
    for i in range(a, b):
        w = 1.0 / _variance(ranges[i], angles[i] - fit[_ALPHA], sigmas)
        t = -x[i] * s + y[i] * c
        d = x[i] * c + y[i] * s - fit[_R]
        shape = ((t - middle) ** 2 - spread) / (half * half)
        product = product + w * d * shape
        square = square + w * shape * shape
    square = max(square, 1e-12)
    return abs(product / square), 1.0 / math.sqrt(square)
