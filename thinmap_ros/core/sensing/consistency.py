"""Checks the geometry of the laser by the motion of the robot: angles, turns, and its mount."""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.scan import MIN_HITS, Scan, laser_names, of_lasers
from thinmap_ros.core.se2 import BOUND_SIGMAS, Array, Mask, rotation
from thinmap_ros.core.sensing.odometry_scale import OdometryScale
from thinmap_ros.core.stage import Estimate
from thinmap_ros.jit import kernel

_ITERATIONS = 3


@dataclass(frozen=True)
class MountErrorConfig:
    """Spans of motion, their noise, and the prior of the estimate.

    A span of motion ends after span_m or span_rad, so long that the errors of its ends are small
    beside it. windows: number of the last spans of either kind from which the error is estimated:
    a slip is found by few, a small error by many; fewer show nothing. noise_m,
    noise_share: of a span, and for each metre of it, besides the covariance of its ends;
    min_information: for directions without information, as in a corridor; prior_sigmas: of the
    yaw (rad), of the odometry's scale and of the position (m); outlier_sigmas: residual
    with half the weight, for wheel slip.
    """

    span_m: float = 0.5
    span_rad: float = 0.5
    windows: tuple[int, int] = (5, 10)
    noise_m: float = 0.01
    noise_share: float = 0.02
    min_information: float = 1e-2
    prior_sigmas: tuple[float, ...] = (math.pi, 0.1, 0.2, 0.2)
    outlier_sigmas: float = 2.4


@dataclass(frozen=True, eq=False)
class MountError:
    """By how much the true pose of the laser on the robot differs from the given one.

    yaw_rad, and offset_m (2,) in the robot frame, with their standard deviations; that of the
    offset is in its least certain direction. yaw_support: ratio of the straight spans that ask for
    this yaw, whose squared residual would be larger by a variance without it.
    """

    yaw_rad: float
    yaw_sigma_rad: float
    offset_m: Array
    offset_sigma_m: float
    yaw_support: float

    @property
    def least_yaw_rad(self) -> float:
        """Least yaw error within three sigmas, if most spans ask for one; else at most 0.

        In a corridor one wrong match can turn the estimate to the other direction.
        """
        least = abs(self.yaw_rad) - BOUND_SIGMAS * self.yaw_sigma_rad
        return least if self.yaw_support > 0.5 else min(least, 0.0)

    @property
    def least_offset_m(self) -> float:
        """Least offset within three sigmas; negative where none is certain."""
        return math.hypot(*self.offset_m) - BOUND_SIGMAS * self.offset_sigma_m


@dataclass(frozen=True, eq=False)
class _Pose:
    """Poses (3,) of a scan, by matching and by odometry, and the covariance (3, 3) of the match."""

    T_map_base: Array
    T_odom_base: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class _Span:
    """A span of motion as linear equations of [cos, sin, x, y]: H (2, 4), y (2,).

    cos and sin of the yaw error, times the scale of the odometry; x, y: position of the laser. The
    errors of the equations are independent, with variance 1.
    """

    H: Array
    y: Array


class MountErrorEstimator:
    """Estimates by how much the pose of the laser on the robot is wrong.

    A laser that is turned on the robot turns the motion that scan matching finds against that of
    the odometry. A laser in another place moves while the robot turns in place. With a motion M by
    odometry and the same motion F by scan matching, F = inverse(E) o M o E for the error E of the
    mount. The translations are linear in the position of the laser and in cosine and sine of its
    yaw.
    Source: Shiu and Ahmad, "Calibration of wrist-mounted robotic sensors by solving homogeneous
    transform equations of the form AX = XB", 1989, in the plane.
    """

    def __init__(self, config: MountErrorConfig | None = None) -> None:
        self._config = config or MountErrorConfig()
        # Apart, so that turns do not displace what was learned in straight driving.
        self._straight: deque[_Span] = deque(maxlen=max(self._config.windows))
        self._turning: deque[_Span] = deque(maxlen=max(self._config.windows))
        self._begin: _Pose | None = None
        self._T_odom_last: Array = np.zeros(3)
        self._path_m = self._turn_rad = 0.0

    def reset_span(self) -> None:
        """Discard the current span: a pose is unknown, or is not due to matching."""
        self._begin = None

    def add(
        self, T_map_base: Array, information: Array, T_odom_base: Array, T_base_laser: Array
    ) -> bool:
        """Add a matched pose (3,) with the information (3, 3) of its scan; whether a span ended.

        T_odom_base (3,): odometry at the scan; T_base_laser (3,): pose of the laser as given.
        """
        config = self._config
        if self._begin is not None:
            moved = se2.between(self._T_odom_last, T_odom_base)
            self._path_m += math.hypot(moved[0], moved[1])
            self._turn_rad += float(moved[2])
        self._T_odom_last = T_odom_base
        is_long = self._path_m >= config.span_m
        if self._begin is not None and not is_long and abs(self._turn_rad) < config.span_rad:
            return False
        floor = config.min_information * np.eye(3)
        covariance: Array = np.linalg.inv(information + floor).astype(np.float64)
        end = _Pose(T_map_base, T_odom_base, covariance)
        begin = self._begin
        if begin is not None:
            span = self._span(begin, end, T_base_laser)
            if span is not None:
                (self._straight if is_long else self._turning).append(span)
        self._begin = end
        self._path_m = self._turn_rad = 0.0
        return begin is not None

    def estimates(self, T_base_laser: Array) -> list[MountError]:
        """Estimated errors of the pose T_base_laser (3,), by each window with enough motion."""
        found = []
        for count in self._config.windows:
            straight = _newest(self._straight, count)
            turning = _newest(self._turning, count)
            if straight or turning:
                found.append(_estimate(straight, turning, T_base_laser, self._config))
        return found

    def _span(self, begin: _Pose, end: _Pose, T_base_laser: Array) -> _Span | None:
        """Equations of the motion between two poses; None where no mount explains its length.

        Then the wheels have slipped, or a match is wrong.
        """
        config = self._config
        F = se2.between(begin.T_map_base, end.T_map_base)
        M = se2.between(begin.T_odom_base, end.T_odom_base)
        turn = float(F[2])
        # The chord of an arc is rotated by half the turn that the odometry lacks.
        unexplained = se2.wrap(turn - float(M[2]))
        along, aside = (rotation(0.5 * unexplained)[:2, :2] @ M[:2]).tolist()
        length = math.hypot(along, aside)
        lever = rotation(turn)[:2, :2] - np.eye(2)
        # By a coarse integration of the odometry its direction is wrong by up to half the turn.
        turn_variance = float(begin.covariance[2, 2]) + 0.25 * (turn**2 + unexplained**2)
        noise = config.noise_m**2 + length**2 * (config.noise_share**2 + turn_variance)
        R = rotation(-float(begin.T_map_base[2]))[:2, :2]
        ends = R @ (begin.covariance + end.covariance)[:2, :2] @ R.T
        _, scale, place, _ = config.prior_sigmas
        possible = config.noise_m**2 + se2.variances(ends)[1]
        swing = 2.0 * abs(math.sin(0.5 * turn))
        possible += (scale * length) ** 2 + (swing * place) ** 2
        # A laser may point anywhere: then it swings to the other side.
        opposite = 2.0 * swing * math.hypot(T_base_laser[0], T_base_laser[1])
        if abs(math.hypot(F[0], F[1]) - length) > BOUND_SIGMAS * math.sqrt(possible) + opposite:
            return None
        H = np.array([[along, aside, *lever[0]], [aside, -along, *lever[1]]])
        whitening = _whitening(ends + noise * np.eye(2))
        return _Span(whitening @ H, whitening @ (F[:2] + lever @ T_base_laser[:2]))


def _whitening(covariance: Array) -> Array:
    """Inverse (2, 2) of the lower root of a covariance (2, 2)."""
    (xx, _), (xy, yy) = covariance.tolist()
    own = math.sqrt(xx)
    rest = math.sqrt(yy - xy**2 / xx)
    return np.array([[1.0 / own, 0.0], [-xy / (xx * rest), 1.0 / rest]])


def _newest(spans: deque[_Span], count: int) -> list[_Span]:
    """The newest spans; none if there are fewer."""
    return list(spans)[-count:] if len(spans) >= count else []


def _estimate(
    straight: list[_Span], turning: list[_Span], T_base_laser: Array, config: MountErrorConfig
) -> MountError:
    """Estimated error of the pose T_base_laser (3,) of a laser by some spans."""
    spans = [*straight, *turning]
    H = np.concatenate([span.H for span in spans])
    y = np.concatenate([span.y for span in spans])
    prior = np.array(config.prior_sigmas) ** -2.0
    x, covariance, support = _solution(
        H, y, len(straight), T_base_laser[:2], prior, config.outlier_sigmas
    )
    largest = se2.variances(covariance[2:, 2:])[1]
    yaw_sigma = math.sqrt(float(covariance[0, 0]))
    return MountError(se2.wrap(float(x[0])), yaw_sigma, x[2:], math.sqrt(largest), support)


@kernel
def _solution(
    H: Array, y: Array, straight: int, place: Array, prior: Array, outlier: float
) -> tuple[Array, Array, float]:
    """Yaw error, scale of the odometry and offset of the laser (4,), covariance, support.

    straight: number of spans whose support for the yaw is counted, the first ones; place (2,):
    position of the laser as given; prior (4,): information; outlier: see `MountErrorConfig`.
    Gauss-Newton with Cauchy weights. Residuals beyond the modelled noise lower the information.
    The scale has a prior: along a corridor the odometry alone measures the length of a motion.
    """
    mean = np.array([0.0, 1.0, 0.0, 0.0])
    x = mean.copy()
    x[0] = _first_yaw(H, y, place, outlier)
    information = np.diag(prior)
    for _ in range(_ITERATIONS):
        residuals = _residuals(H, y, x, place)
        weights = 1.0 / (1.0 + np.square(residuals / outlier))
        information, b = _normal_equations(_derivatives(H, x, place), residuals, weights)
        information += np.diag(prior)
        b += prior * (mean - x)
        x += _solved(information, b.reshape(-1, 1))[:, 0]
    squared = np.sum(weights * np.square(residuals))
    spread = max(1.0, squared / max(np.sum(weights) - 3.0, 1.0))
    return x, spread * _solved(information, np.eye(4)), _support(H, y, straight, x, place)


@kernel
def _first_yaw(H: Array, y: Array, place: Array, outlier: float) -> float:
    """The yaw of none, of all together, or of one span that has the lowest cost.

    A span with a jump of the pose would draw the solution of all together anywhere.
    """
    information, b = _normal_equations(H, y, np.ones(len(y)))
    linear = _solved(information + np.eye(4), b.reshape(-1, 1))[:, 0]
    yaw = 0.0
    least = _cost(H, y, yaw, place, outlier)
    for span in range(-1, len(y) // 2):
        found = math.atan2(linear[1], linear[0]) if span < 0 else _own_yaw(H, y, 2 * span)
        cost = _cost(H, y, found, place, outlier)
        if cost < least:
            yaw = found
            least = cost
    return yaw


@kernel
def _own_yaw(H: Array, y: Array, row: int) -> float:
    """Yaw by the translation of one span, the equations of which begin at a row."""
    # A span without translation has no direction.
    cos2 = H[row, 0] ** 2 + H[row + 1, 0] ** 2 + 1e-6
    sin2 = H[row, 1] ** 2 + H[row + 1, 1] ** 2 + 1e-6
    both = H[row, 0] * H[row, 1] + H[row + 1, 0] * H[row + 1, 1]
    c = H[row, 0] * y[row] + H[row + 1, 0] * y[row + 1]
    s = H[row, 1] * y[row] + H[row + 1, 1] * y[row + 1]
    return math.atan2(cos2 * s - both * c, sin2 * c - both * s)


@kernel
def _cost(H: Array, y: Array, yaw: float, place: Array, outlier: float) -> float:
    """Cost of a yaw without an offset, which outliers raise little."""
    residuals = _residuals(H, y, np.array([yaw, 1.0, 0.0, 0.0]), place)
    return float(np.sum(np.log1p(np.square(residuals / outlier))))


@kernel
def _support(H: Array, y: Array, straight: int, x: Array, place: Array) -> float:
    """Ratio of the first spans for which a solution (4,) fits better than one without yaw."""
    without = x.copy()
    without[0] = 0.0
    worse = np.square(_residuals(H, y, without, place))
    gains = worse - np.square(_residuals(H, y, x, place))
    count = 0
    for span in range(straight):
        count += gains[2 * span] + gains[2 * span + 1] > 1.0
    return count / max(straight, 1)


@kernel
def _residuals(H: Array, y: Array, x: Array, place: Array) -> Array:
    """What a solution (4,) leaves of the equations (N,)."""
    c = math.cos(x[0])
    s = math.sin(x[0])
    ahead = place[0] + x[2]
    aside = place[1] + x[3]
    turned = H[:, 2] * (c * ahead + s * aside) + H[:, 3] * (c * aside - s * ahead)
    left: Array = y - x[1] * (c * H[:, 0] + s * H[:, 1]) - turned
    return left


@kernel
def _derivatives(H: Array, x: Array, place: Array) -> Array:
    """Derivatives (N, 4) of the equations by a solution (4,)."""
    c = math.cos(x[0])
    s = math.sin(x[0])
    ahead = place[0] + x[2]
    aside = place[1] + x[3]
    J = np.empty_like(H)
    turned = H[:, 2] * (c * aside - s * ahead) - H[:, 3] * (c * ahead + s * aside)
    J[:, 0] = x[1] * (c * H[:, 1] - s * H[:, 0]) + turned
    J[:, 1] = c * H[:, 0] + s * H[:, 1]
    J[:, 2] = c * H[:, 2] - s * H[:, 3]
    J[:, 3] = s * H[:, 2] + c * H[:, 3]
    return J


@kernel
def _normal_equations(J: Array, residuals: Array, weights: Array) -> tuple[Array, Array]:
    """J' W J (4, 4) and J' W r (4,)."""
    information = np.zeros((4, 4))
    b = np.zeros(4)
    for k in range(len(J)):
        for i in range(4):
            b[i] += weights[k] * J[k, i] * residuals[k]
            for j in range(4):
                information[i, j] += weights[k] * J[k, i] * J[k, j]
    return information, b


@kernel
def _solved(matrix: Array, right: Array) -> Array:
    """Solution (4, K) of linear equations with a positive definite matrix (4, 4)."""
    left = matrix.copy()
    solution = right.copy()
    for k in range(4):
        solution[k] /= left[k, k]
        left[k] /= left[k, k]
        for i in range(4):
            if i != k:
                solution[i] -= left[i, k] * solution[k]
                left[i] -= left[i, k] * left[k]
    return solution


# Two scans are compared with so much odometry between them: a right angle more would be ambiguous
# in a square room.
_MIN_TURN_RAD = 0.15
_MAX_TURN_RAD = 0.5
_MAX_PATH_M = 0.5
_STEP_RAD = 0.025  # between turns that are tried
_MAX_RATIO = 1.5  # of these to the turn of the odometry, to either side
_MAX_POINTS = 120  # of a scan
# Difference of ranges with half the score, m, and least share of the points in view of both scans.
_WITHIN = np.array([0.1, 0.3])
_MIN_LEAD = 0.05  # of the best turn over those in the other direction, to mean anything
_RATIO_SIGMA = 0.5  # of the ratio of two turns: 0.10 to 0.44 on the recordings of seven robots


@dataclass(frozen=True)
class Turns:
    """Sums of turns that were compared, rad.

    odometry: without signs; scans: positive in the direction of the odometry, negative against it.
    squares: sum of the squared turns of the odometry; products: of both; fourth: sum of the fourth
    powers of the odometry's.
    """

    odometry: float = 0.0
    scans: float = 0.0
    squares: float = 0.0
    products: float = 0.0
    fourth: float = 0.0

    def added(self, odometry: float, scans: float) -> 'Turns':
        """The sums with two more turns."""
        return Turns(
            self.odometry + abs(odometry),
            self.scans + math.copysign(1.0, odometry) * scans,
            self.squares + odometry**2,
            self.products + odometry * scans,
            self.fourth + odometry**4,
        )

    @property
    def are_opposed(self) -> bool:
        """Whether the scans turn against the odometry, by three sigmas.

        Their ratio is nearer to -1, of a mirrored laser, than to 0, of unrelated turns.
        """
        if self.squares == 0.0:
            return False
        sigma = _RATIO_SIGMA * math.sqrt(self.fourth) / self.squares
        return self.products / self.squares + BOUND_SIGMAS * sigma < -0.5


class TurnComparison:
    """Sums up the turns of scans and those of the odometry, to find a mirrored laser.

    A driver whose angle increment has the wrong sign exchanges left and right. The map is a perfect
    mirror image then, and nothing within the scans contradicts it. Only the scans turn against the
    odometry. The turn between two near scans is that with which most of their ranges agree. The
    odometry's translation is applied to it, its turn is not.
    """

    def __init__(self) -> None:
        self.turns = Turns()
        self._reference: tuple[Scan, Array] | None = None

    @property
    def are_opposed(self) -> bool:
        """Whether the scans turn against the odometry."""
        return self.turns.are_opposed

    def add(self, scan: Scan, T_odom_base: Array) -> None:
        """Add a scan with the odometry pose (3,) at its stamp."""
        if np.count_nonzero(scan.hit) < MIN_HITS:
            self._reference = None
            return
        if self._reference is None:
            self._reference = (scan, T_odom_base)
            return
        reference, T_odom_reference = self._reference
        moved = se2.between(T_odom_reference, T_odom_base)
        turn = float(moved[2])
        is_near = math.hypot(moved[0], moved[1]) <= _MAX_PATH_M
        if is_near and abs(turn) < _MIN_TURN_RAD:
            return
        self._reference = (scan, T_odom_base)
        if is_near and abs(turn) <= _MAX_TURN_RAD:
            found = self._turn(reference, scan, moved)
            if found is not None:
                self.turns = self.turns.added(turn, found)

    def _turn(self, reference: Scan, scan: Scan, moved: Array) -> float | None:
        """Turn (rad) from a reference to a scan; None if one in the other direction fits as well.

        moved (3,): motion by odometry in between, robot frame.
        """
        count = math.ceil(_MAX_RATIO * abs(float(moved[2])) / _STEP_RAD)
        turns = _STEP_RAD * np.arange(-count, count + 1, dtype=np.float64)
        points = reference.points_base()
        points = points[:: -(-len(points) // _MAX_POINTS)] - moved[:2]
        beams = np.array([scan.angle_min_rad, scan.angle_increment_rad])
        mount = scan.T_base_laser
        score = _agreement(points, turns, mount, beams, scan.ranges_m, scan.hit, _WITHIN)
        best = int(score.argmax())
        opposite = score[:count] if best > count else score[count + 1 :]
        if best == count or score[best] - opposite.max() < _MIN_LEAD:
            return None
        return float(turns[best])


@kernel
def _agreement(
    points: Array, turns: Array, laser: Array, beams: Array, ranges: Array, hit: Mask, within: Array
) -> Array:
    """Agreement (K,), 0 to 1, of points (N, 2) with the ranges of a scan for some turns (K,).

    points: in the robot frame of the scan but for its turn; 0 where too few are in view. laser:
    pose (3,) of the laser; beams (2,): first angle and increment, rad; within (2,): tolerance, m,
    and least share of the points in view.
    """
    step = beams[1]
    sense = math.copysign(1.0, step)
    score = np.zeros(len(turns))
    for k in range(len(turns)):
        c = math.cos(turns[k])
        s = math.sin(turns[k])
        seen = 0
        fits = 0.0
        for i in range(len(points)):
            x = c * points[i, 0] + s * points[i, 1] - laser[0]
            y = c * points[i, 1] - s * points[i, 0] - laser[1]
            ahead = (sense * (math.atan2(y, x) - laser[2] - beams[0])) % (2.0 * math.pi)
            beam = round(ahead / max(abs(step), 1e-6))
            if beam < len(ranges) and hit[beam]:
                seen += 1
                fits += 1.0 / (1.0 + ((ranges[beam] - math.hypot(x, y)) / within[0]) ** 2)
        if seen > 0 and seen >= within[1] * len(points):
            score[k] = fits / seen
    return score


# Errors of the laser's pose on the robot that are reported, and at which the robot stops.
_WARN_YAW_RAD = math.radians(5.0)
_STOP_YAW_RAD = math.radians(20.0)
_WARN_OFFSET_M = 0.1


class ConsistencyMonitor:
    """Checks each scan with its estimate; warns of contradictions between laser and odometry.

    Each laser is checked on its own, by the frame of its scans.
    odometry_scale: turns and distances of the odometry, compared with those of the scans.
    """

    def __init__(self) -> None:
        self.odometry_scale = OdometryScale()
        self._matched: str | None = None  # frame of the scan that was matched last
        self._lasers: dict[str, _LaserConsistency] = {}

    @property
    def warnings(self) -> dict[str, str]:
        """Those that hold now, by kind."""
        return of_lasers({frame: own.warnings for frame, own in self._lasers.items()})

    @property
    def reported(self) -> dict[str, str]:
        """The last text of each kind so far."""
        return of_lasers({frame: own.reported for frame, own in self._lasers.items()})

    def checked(self, scan: Scan, T_odom_base: Array, estimate: Estimate) -> Estimate:
        """The estimate of a scan with odometry pose (3,), with `mount_fault` where there is one.

        A pose that no match has set, or that a loop closure has moved, says nothing of the mount,
        and neither does an odometry that has jumped.
        """
        own = self._lasers.setdefault(scan.frame, _LaserConsistency())
        is_other_time = scan.T_odom_before is not None
        if is_other_time or estimate.correction is not None or estimate.odometry_discontinuity:
            self._begin_again(is_other_time)
        elif se2.is_finite(T_odom_base):
            self._compare(scan, T_odom_base, estimate)
            own.add_motion(scan, T_odom_base, estimate)
        fault = own.check(scan, T_odom_base)
        name = laser_names(self._lasers.keys())[scan.frame]
        return replace(estimate, mount_fault=name + fault) if fault else estimate

    def _begin_again(self, is_other_time: bool) -> None:
        """Begin new spans; is_other_time: the odometry so far was that of another time."""
        for laser in self._lasers.values():
            laser.reset_span()
        self.odometry_scale.reset_span()
        if is_other_time:
            self.odometry_scale.forget()

    def _compare(self, scan: Scan, T_odom_base: Array, estimate: Estimate) -> None:
        """Compare the motion by odometry and by matching; a laser beside may match nothing."""
        if estimate.scan_information is not None:
            self._matched = scan.frame
            self.odometry_scale.add(estimate.T_map_base, estimate.scan_information, T_odom_base)
        elif scan.frame == self._matched:
            self.odometry_scale.reset_span()


class _LaserConsistency:
    """The same for one laser."""

    def __init__(self) -> None:
        self.warnings: dict[str, str] = {}
        self.reported: dict[str, str] = {}
        self._turns = TurnComparison()
        self._mount_errors = MountErrorEstimator()
        self._by_window: list[MountError] = []

    def reset_span(self) -> None:
        """Discard the current span of motion."""
        self._mount_errors.reset_span()

    def check(self, scan: Scan, T_odom_base: Array) -> str:
        """Check a scan; returns why the robot must not drive with this laser, '' for no reason."""
        if se2.is_finite(T_odom_base):
            self._turns.add(scan, T_odom_base)
        turned = max(self._by_window, key=lambda error: error.least_yaw_rad, default=None)
        self.warnings = dict(self._found(scan, turned))
        self.reported |= self.warnings
        is_wrong = turned is not None and turned.least_yaw_rad > _STOP_YAW_RAD
        return _yaw_text(turned) if turned is not None and is_wrong else ''

    def add_motion(self, scan: Scan, T_odom_base: Array, estimate: Estimate) -> None:
        """Add a pose that neither a loop closure nor a jump of the odometry has moved."""
        information = estimate.scan_information
        if information is None:
            self.reset_span()
            return
        T_base_laser = scan.T_base_laser
        if self._mount_errors.add(estimate.T_map_base, information, T_odom_base, T_base_laser):
            self._by_window = self._mount_errors.estimates(T_base_laser)

    def _found(self, scan: Scan, turned: MountError | None) -> Iterator[tuple[str, str]]:
        """Kind and text of each warning; turned: the estimate that is surest of a turned laser."""
        if scan.warning:
            yield 'angles', scan.warning
        if self._turns.are_opposed:
            turns = self._turns.turns
            yield (
                'turns',
                f'scans turn against the odometry: by {turns.scans:.1f} rad where the odometry '
                f'turned by {turns.odometry:.1f} rad: laser upside down or clockwise, or the yaw '
                'of the odometry inverted?',
            )
        if turned is not None and turned.least_yaw_rad > _WARN_YAW_RAD:
            yield 'yaw', _yaw_text(turned)
        moved = max(self._by_window, key=lambda error: error.least_offset_m, default=None)
        if moved is not None and moved.least_offset_m > _WARN_OFFSET_M:
            x, y = moved.offset_m.tolist()
            yield (
                'offset',
                f'laser displaced by {x:.2f}, {y:.2f} m (sigma {moved.offset_sigma_m:.2f} m) from '
                'its given pose on the robot: by turns in scans and in odometry',
            )


def _yaw_text(error: MountError) -> str:
    yaw = math.degrees(error.yaw_rad)
    sigma = math.degrees(error.yaw_sigma_rad)
    return (
        f'laser turned by {yaw:.0f} deg (sigma {sigma:.1f} deg) from its given pose on the robot: '
        'by the direction of motion in scans and in odometry'
    )
