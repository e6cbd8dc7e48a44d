"""Prediction of the pose by odometry: its noise, and its systematic error, which is calibrated."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import parameter
from thinmap_ros.core.ekf_slam.features import OdometryConfig, odometry_slip, odometry_variances
from thinmap_ros.core.odometry import OdometryIncrement, OdometryIncrements
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import (
    BOUND_SIGMAS,
    Array,
    carried,
    inverse,
    propagated_covariance,
    rotated_covariance,
    rotation,
)
from thinmap_ros.core.slam.graph.pose_graph import NO_SHARE
from thinmap_ros.core.slam.graph.tables import Rows
from thinmap_ros.core.slam.matching.scan_matcher import Match
from thinmap_ros.jit import kernel


@dataclass(frozen=True)
class MotionConfig(OdometryConfig):
    """Parameters of the odometry noise, and of its adaptation to scan matching."""

    noise_window: float = parameter(
        20.0,
        'Number of scans over which the odometry noise is estimated. Raise it for a steadier '
        'estimate, lower it to follow changes of the floor sooner.',
        low=1.0,
        high=1e4,
    )


@dataclass(frozen=True, eq=False)
class MotionPrediction:
    """Increment (3,) and its covariance (3, 3), in the robot frame before it.

    is_stationary: whether the increment is within the noise floor of the odometry; by_calibration
    (3, 4): derivative of the increment by the parameters of the calibration.
    """

    increment: Array
    covariance: Array
    is_stationary: bool
    by_calibration: Array = field(default_factory=lambda: np.zeros((3, 4)))


_MIN_SCALE = 1.0  # of the modelled variance: good wheels slip, too
# Below this ratio of the information across a corridor, that along it is of a smooth one.
_CORRIDOR_RATIO = 0.2


def _distinctness(information: Array) -> Array:
    """Weight (2,), 0 to 1, of a scan's innovation in x and y, by its information (3, 3).

    Along a smooth corridor the information of a match is overconfident, and its innovation is no
    error of the odometry.
    """
    own = np.diag(information)[:2]
    return np.asarray(np.minimum(own / max(_CORRIDOR_RATIO * float(own.max()), 1e-12), 1.0))


class MotionModel:
    """Predicts the motion between two scans, and adapts its noise to the innovations of matches.

    They scale the noise of the odometry model, separately for translation and rotation. So an
    odometry that slips, lags or lacks rotation gets a larger covariance.
    Source: Mehra, "On the identification of variances and adaptive Kalman filtering", 1970;
    Siegwart and Nourbakhsh, "Introduction to autonomous mobile robots", for the odometry's noise.
    """

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._share: Array = np.ones(2)  # scale of the variances of translation and rotation
        self._learned = 0  # number of updates
        self._allowed: Array = np.ones(3)
        self._expected: Array = np.zeros(3)

    def predict(self, increment: Array, systematic: Array) -> MotionPrediction:
        """Predict the motion since the previous scan by the odometry increment (3,).

        systematic (3, 3): covariance of the residual systematic error of the odometry.
        """
        config = self._config
        self._expected = increment
        self._allowed = odometry_variances(increment, config) + np.diag(systematic)
        moves = np.abs(increment) > BOUND_SIGMAS * odometry_slip(config)
        return MotionPrediction(increment, np.diag(self._variances), not moves.any())

    def update(self, found: Array, scan_information: Array) -> None:
        """Adapt the noise to a matched motion (3,); information (3, 3) of the scan, robot frame."""
        # Variance of the motion as the scan measures it.
        variance = 1.0 / np.maximum(np.diag(scan_information), 1e-12)
        gain = self._variances / (self._variances + variance)
        innovation = found - self._expected
        innovation[2] = se2.wrap(float(innovation[2]))
        # The match is a posterior: it has moved the pose by `gain` times the scan's innovation.
        squared = np.square(innovation / gain)
        beyond = np.maximum(squared - variance, 0.0)  # not explained by the noise of the scan
        share = self._share[[0, 0, 1]]
        # A larger innovation is an outlier, such as a single slip: its effect is limited.
        change = np.minimum(beyond / self._allowed, BOUND_SIGMAS**2 * share) - share
        change *= np.maximum(gain**2, beyond / np.maximum(squared, 1e-12))
        change[:2] *= np.where(change[:2] > 0.0, _distinctness(scan_information), 1.0)
        self._learned += 1
        rate = max(1.0 / self._config.noise_window, 1.0 / (1.0 + self._learned))
        self._share[0] += rate * 0.5 * (change[0] + change[1])
        self._share[1] += rate * change[2]
        np.maximum(self._share, _MIN_SCALE, out=self._share)

    @property
    def _variances(self) -> Array:
        return np.asarray(self._allowed * self._share[[0, 0, 1]])


# Of scale, drift, turn_scale and askew: before the first span, and their random walk per m or rad,
# as floor and load change.
_PRIOR_SIGMAS = (0.02, 0.02, 0.05, 0.02)
_WALK_SIGMAS = (0.001, 0.001, 0.001, 0.0002)
# Smallest span to compare, so long that the covariance of its two ends is small beside it.
_SPAN_M = 1.0
_SPAN_RAD = 1.0
# Of a span, besides that of its ends and of the odometry: errors of matches are correlated.
_SPAN_NOISE_M = 0.02
_SPAN_NOISE_RAD = 0.02
_MIN_INFORMATION = 1e-2  # for directions without information, as in a corridor
_GATE_SIGMAS = 4.0  # a larger innovation is wheel slip
_SPAN_WINDOW = 20.0  # number of spans whose innovations scale the noise


@dataclass(frozen=True, eq=False)
class _MatchedPose:
    """Pose (3,), its covariance (3, 3) by the scan, and derivative (3, 4) by the parameters.

    All in the map frame.
    """

    T_map_base: Array
    covariance: Array
    systematic: Array


class OdometryCalibration:
    """Estimates the systematic odometry error from scan matches, and removes it.

    Its causes are wheels of an unexpected size, unequal wheels, and a laser that is mounted askew.
    A match corrects only a part of the prediction error. The rest enters the map and bends it.
    Therefore the systematic part is estimated, by a Kalman filter while driving, and removed from
    the prediction. A metre of odometry is `scale` metres, in a direction that is `askew` radians
    off the heading of the scans. A radian of odometry is `turn_scale` radians, and each metre adds
    `drift` radians. Source: Borenstein and Feng, "Measurement and correction of systematic odometry
    errors in mobile robots", 1996 (UMBmark), for the model.
    """

    def __init__(self) -> None:
        self.begin_with(np.array([1.0, 0.0, 1.0, 0.0]), np.diag(np.square(_PRIOR_SIGMAS)))
        # Of turn, length and lateral offset of a span.
        self._noises = [_Noise() for _ in range(3)]
        self.reset_segment()

    def reset_segment(self) -> None:
        """Discard the current span, after a pose that is not due to matching: set or lost."""
        self._begin: _MatchedPose | None = None
        self._expected = np.zeros(3)
        self._by_parameters = np.zeros((3, 4))  # derivative of _expected
        self._travelled_m = self._turned_rad = 0.0
        self._random = np.zeros(2)

    def begin_with(self, parameters: Array, covariance: Array) -> None:
        """Begin with parameters (4,) and covariance (4, 4) that were found before.

        Scale, drift in rad/m, turn_scale, askew in rad.
        """
        self.parameters = parameters
        self.covariance = covariance
        self._spans = _Spans(parameters, covariance)
        self.applied = parameters  # as the map contains them

    @property
    def spans(self) -> int:
        """Number of spans that the parameters were estimated from."""
        return len(self._spans)

    def covariance_of(self, derivative: Array) -> Array:
        """Covariance (N, N) of what has a derivative (N, 4) by the parameters."""
        return np.asarray(derivative @ self.covariance @ derivative.T)

    def smoothed(self) -> Array:
        """Parameters (N, 4) after each number of spans, as all spans together have them."""
        return self._spans.smoothed()

    def corrected(self, increment: Array, variances: Array) -> tuple[Array, Array]:
        """Odometry increment (3,), robot frame, without its systematic error.

        Also returns its derivative (3, 4) by the parameters.

        variances (2,): random errors of the chord, m^2, and of the turn, rad^2.
        """
        length = _signed_length(increment)
        turned = float(increment[2])
        scale, drift, turn_scale, askew = self.parameters
        turn = turn_scale * turned + drift * length
        bent = askew + 0.5 * (turn - turned)  # the chord of an arc is rotated by half its turn
        c = scale * math.cos(bent)
        s = scale * math.sin(bent)
        x = c * increment[0] - s * increment[1]
        y = s * increment[0] + c * increment[1]
        self._travelled_m += length
        self._turned_rad += turned
        self._random = self._random + variances
        found = np.array([x, y, turn])
        G = np.array(
            [
                [x / scale, -0.5 * y * length, -0.5 * y * turned, -y],
                [y / scale, 0.5 * x * length, 0.5 * x * turned, x],
                [0.0, length, turned, 0.0],
            ]
        )
        before = self._expected
        self._expected = se2.compose(before, found)
        moved = carried(self._by_parameters, self._expected[:2] - before[:2])
        self._by_parameters = moved + rotation(float(before[2])) @ G
        return found, G

    def update(self, T_map_base: Array, by_map: Array, systematic: Array) -> None:
        """Update the calibration by a matched pose (3,), map frame, after the increments so far.

        by_map (3, 3): information of the scan alone. The odometry prior must not be part of it,
        because it is not independent of the increments. systematic (3, 4): derivative of the pose
        by the parameters, map frame: a match with a map that was drawn at a pose of the odometry
        does not measure the odometry, but confirms it.
        """
        if (
            self._begin is not None
            and abs(self._travelled_m) < _SPAN_M
            and abs(self._turned_rad) < _SPAN_RAD
        ):
            return
        covariance: Array = np.linalg.inv(by_map + _MIN_INFORMATION * np.eye(3)).astype(np.float64)
        begin = self._begin
        if begin is not None:
            R = rotation(float(begin.T_map_base[2]))
            found = se2.between(begin.T_map_base, T_map_base)
            begun = carried(begin.systematic, T_map_base[:2] - begin.T_map_base[:2])
            H = self._by_parameters - R.T @ (systematic - begun)
            self._update_span(found, R.T @ (covariance + begin.covariance) @ R, H)
        self.reset_segment()
        self._begin = _MatchedPose(T_map_base, covariance, systematic)

    def _update_span(self, found: Array, covariance: Array, H: Array) -> None:
        """Kalman updates by the turn of a span, its length, and its lateral offset.

        found (3,), covariance (3, 3): measured end of the span, in the frame of its start; H
        (3, 4): what it measures of the parameters.
        """
        moved = abs(self._travelled_m) + abs(self._turned_rad)
        self.covariance = self.covariance + np.diag(np.square(_WALK_SIGMAS)) * moved
        predicted = self.covariance
        off_turn = float(se2.wrap(float(found[2] - self._expected[2])))
        variance = _SPAN_NOISE_RAD**2 + self._random[1] + float(covariance[2, 2])
        self._update(off_turn, H[2], variance, self._noises[0])
        length = math.hypot(self._expected[0], self._expected[1])
        if length > 0.5 * _SPAN_M:
            x, y = self._expected[:2] / length
            dx, dy = found[:2] - self._expected[:2]
            along = np.array([x, y])
            across = np.array([-y, x])
            variance = (
                _SPAN_NOISE_M**2 + self._random[0] + float(along @ covariance[:2, :2] @ along)
            )
            self._update(x * dx + y * dy, along @ H[:2], variance, self._noises[1])
            # The lateral offset contains half of the turn error.
            aside = x * dy - y * dx - 0.5 * length * off_turn
            variance = (
                _SPAN_NOISE_M**2
                + 0.25 * length**2 * self._random[1]
                + float(across @ covariance[:2, :2] @ across)
            )
            H_aside = across @ H[:2] - 0.5 * length * H[2]
            self._update(aside, H_aside, variance, self._noises[2])
        self._spans.add(self.parameters, predicted, self.covariance)

    def _update(self, off: float, H: Array, modelled: float, noise: '_Noise') -> None:
        """Scalar Kalman update by an innovation `off`; an innovation outside the gate is ignored.

        modelled: variance of the measurement, which `noise` scales.
        """
        along = self.covariance @ H
        known = float(H @ along)
        variance = known + noise.scale * modelled
        noise.learn(off, known, modelled)
        if off * off > _GATE_SIGMAS**2 * variance:
            return
        gain = along / variance
        self.parameters = self.parameters + gain * off
        self.covariance = self.covariance - np.outer(gain, along)


class _Noise:
    """Scale, at least 1, of the modelled variance of a measurement, by its innovations.

    An odometry that slips at single steps, as the motion model has long learned, does so in spans.
    Source: Mehra, "On the identification of variances and adaptive Kalman filtering", 1970.
    """

    def __init__(self) -> None:
        self.scale = 1.0
        self._learned = 0.0  # innovations so far, by weight

    def learn(self, off: float, known: float, modelled: float) -> None:
        """Adapt to an innovation; variances: known, by the parameters; modelled, by the noise."""
        noise = self.scale * modelled
        beyond = max(off * off - known, 0.0) / modelled
        outlier = BOUND_SIGMAS**2 * self.scale
        weight = noise / (noise + known)  # what the innovation says about the noise
        self._learned += weight
        rate = max(1.0 / _SPAN_WINDOW, 1.0 / (1.0 + self._learned))
        self.scale = max(self.scale + rate * weight * (min(beyond, outlier) - self.scale), 1.0)


class _Spans:
    """The parameters after each span, and their smoother.

    Source: Rauch, Tung and Striebel, "Maximum likelihood estimates of linear dynamic systems",
    1965.
    """

    def __init__(self, parameters: Array, covariance: Array) -> None:
        self._parameters = Rows(4)
        self._parameters.append(parameters)
        self._gains = Rows(4, 4)  # of the smoother, from each span to the previous
        self._after = covariance  # of the last span

    def __len__(self) -> int:
        return len(self._gains)

    def add(self, parameters: Array, before: Array, after: Array) -> None:
        """Add a span: parameters (4,), covariances (4, 4) before and after its measurement."""
        self._parameters.append(parameters)
        self._gains.append(self._after @ np.linalg.inv(before))
        self._after = after

    def smoothed(self) -> Array:
        """Parameters (N, 4) of each number of spans, given all of them."""
        return np.asarray(_smoothed(self._parameters.values, self._gains.values))


@kernel
def _smoothed(parameters: Array, gains: Array) -> Array:
    found = parameters.copy()
    for k in range(len(gains) - 1, -1, -1):
        for i in range(4):
            for j in range(4):
                found[k, i] += gains[k, i, j] * (found[k + 1, j] - parameters[k, j])
    return found


def _signed_length(increment: Array) -> float:
    """Signed length of an increment (3,): negative where the robot drove backwards."""
    chord = math.hypot(increment[0], increment[1])
    half = 0.5 * float(increment[2])
    return -chord if increment[0] * math.cos(half) + increment[1] * math.sin(half) < 0.0 else chord


@dataclass(frozen=True, eq=False)
class Reversal:
    """Expected reversal of an odometry error by the next increment, in the robot frame before it.

    mean (3,), covariance (3, 3). The next reading reverses a wrong reading of the odometry, but
    not wheel slip. Both are assumed to be equally likely.
    """

    mean: Array = field(default_factory=lambda: np.zeros(3))
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Poses (3,) before a motion and, as predicted, after it, and covariance (3, 3) of the motion.

    In the frame of the pose before, the anchor's. motion: the increment in the robot frame;
    discontinuity: description of an odometry jump; '' without one.
    """

    before: Array
    prior: Array
    covariance: Array
    motion: MotionPrediction
    discontinuity: str


class OdometryPrediction:
    """Predicts the pose of each scan by calibrated odometry, and estimates its errors."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._increments = OdometryIncrements()
        self.calibration = OdometryCalibration()
        self._model = MotionModel(config)
        self._reversal = Reversal()
        self._begins_known = False  # whether the next motion starts at a matched pose
        self._revision = 0

    @property
    def rejected(self) -> int:
        """Number of odometry poses with invalid values."""
        return self._increments.rejected

    @property
    def T_odom_base(self) -> Array:  # noqa: N802
        """Odometry pose (3,) of the last scan."""
        return self._increments.T_odom_base

    def predict(
        self, scan: Scan, T_odom_base: Array, before: Array, revision: int = 0
    ) -> Prediction:
        """Predict the pose of a scan by its odometry pose (3,) and the previous pose (3,).

        revision: number of corrections of the map so far: matches before one are not compared with
        those after it.
        """
        if revision != self._revision:
            self._revision = revision
            self.reset_segment()
        increment = self._increments.add(scan, T_odom_base)
        motion = self._motion(increment)
        reversal = self._reversal
        self._reversal = Reversal()
        R = rotation(float(before[2]))
        expected = se2.compose(before, motion.increment) + R @ reversal.mean
        covariance = R @ (motion.covariance + reversal.covariance) @ R.T
        prior = se2.pose(*expected.tolist())
        return Prediction(before, prior, covariance, motion, increment.discontinuity)

    def contradict(self, prediction: Prediction, match: Match, accepted: bool) -> None:
        """Expect that the next increment may reverse the innovation of an unexpected match."""
        after = match.pose if accepted else prediction.prior
        off = rotation(-float(after[2])) @ se2.pose_difference(match.pose, prediction.prior)
        mean = -0.5 * off if accepted else np.zeros(3)
        self._reversal = Reversal(mean, 0.25 * np.outer(off, off))

    def update(self, prediction: Prediction, match: Match) -> None:
        """Update the odometry noise by a match with enough inliers, in the prediction's frame."""
        if self._begins_known:
            scan_information = rotated_covariance(
                match.scan_information, -float(prediction.before[2])
            )
            self._model.update(se2.between(prediction.before, match.pose), scan_information)
        self._begins_known = True

    def reset_segment(self) -> None:
        """Stop comparing odometry with matches across a pose that was set or lost."""
        self._begins_known = False
        self.calibration.reset_segment()

    def _motion(self, increment: OdometryIncrement) -> MotionPrediction:
        """Motion since the last scan, robot frame; wide after an odometry discontinuity."""
        variances = odometry_variances(increment.T_before_base, self._config)[[0, 2]]
        moved, G = self.calibration.corrected(increment.T_before_base, variances)
        motion = self._model.predict(moved, G @ self.calibration.covariance @ G.T)
        if increment.discontinuity_m == 0.0:
            return replace(motion, by_calibration=G)
        self.calibration.reset_segment()
        unknown = np.diag(np.square([increment.discontinuity_m, increment.discontinuity_m, 1.0]))
        return MotionPrediction(motion.increment, motion.covariance + unknown, False)


CHI2 = 11.34  # 99 % of three degrees of freedom
UNKNOWN = np.diag(np.square([300.0, 300.0, np.pi]))  # covariance of an unknown pose
_MIN_STEP = np.diag(np.square([2e-3, 2e-3, 5e-4]))  # smallest covariance between keyframes


class Contradiction:
    """Sum of the innovations of matches since the anchor: pose changes that are no motion."""

    def __init__(self) -> None:
        self._moved: Array = np.zeros(3)
        self._expected = np.zeros((3, 3))
        self._known: Array = np.zeros((3, 3))

    def add(self, off: Array, expected: Array) -> None:
        """Add the innovation (3,) of a match, and the prior covariance (3, 3) of it."""
        self._moved = self._moved + off
        self._expected = self._expected + expected

    def add_jump(self, covariance: Array) -> None:
        """Add the covariance (3, 3) of a known discontinuity."""
        self._known = self._known + covariance

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) to add to the step from the anchor; 0 if the innovations are noise.

        Many small innovations in one direction pull the pose onto an earlier map; they are no
        motion of the robot.
        """
        expected = self._expected + _MIN_STEP
        if float(self._moved @ np.linalg.solve(expected, self._moved)) < CHI2:
            return self._known
        return self._known + np.outer(self._moved, self._moved)


class PoseUncertainty:
    """Covariances (3, 3), frame of the anchor, of the pose relative to several earlier poses.

    Since the last match, the last map update, and the anchor keyframe. A match measures the pose
    relative to the local map. A scan that is added to the map adds its own pose error to it. These
    errors accumulate along the path until a loop closure corrects them.

    The systematic error of the odometry is one error in all steps. Where the scans do not measure
    the pose, it adds up along the path: the covariance is P + S C S', with P of independent errors,
    C of the calibration, and S the derivative of the pose by it.

    T_moved: pose (3,) after the last motion, relative to the anchor.
    """

    def __init__(self, T_anchor_base: Array) -> None:
        self.since_match = np.zeros((3, 3))  # motion since the last good match: the next prior
        self.since_map_update = np.zeros((3, 3))  # pose since the last map update
        self.motion_part: Array = np.zeros((3, 3))  # share of since_map_update from the motion
        self._since_keyframe = np.zeros((3, 3))
        self._map_update_covariance = np.zeros((3, 3))  # last update, not in _since_keyframe
        # Since the walls in view were drawn, which matches measure; and besides, from the anchor.
        self._systematic_in_view = NO_SHARE.derivative
        self._systematic_of_step = NO_SHARE.derivative
        self._contradiction = Contradiction()
        self.T_moved = T_anchor_base

    def place(self, T_anchor_base: Array, covariance: Array) -> None:
        """Set the pose (3,) and its covariance (3, 3), without any motion."""
        own = 0.5 * (covariance + covariance.T) + _MIN_STEP
        self.T_moved = T_anchor_base
        self.since_match = own
        self.since_map_update = own
        self._since_keyframe = np.zeros((3, 3))
        self._map_update_covariance = np.zeros((3, 3))
        self._systematic_in_view = NO_SHARE.derivative
        self._systematic_of_step = NO_SHARE.derivative
        self._contradiction.add_jump(own + UNKNOWN)

    def predict(
        self, before: Array, prior: Array, Q: Array, is_stationary: bool, by_calibration: Array
    ) -> None:
        """Propagate by a motion from a pose (3,) to the prior (3,), with covariance Q (3, 3).

        by_calibration (3, 4): derivative of the motion by the calibration.
        """
        self.since_match = propagated_covariance(self.since_match, prior[:2] - before[:2]) + Q
        if not is_stationary:
            lever = prior[:2] - self.T_moved[:2]
            self._since_keyframe = propagated_covariance(self._since_keyframe, lever)
            self.since_map_update = propagated_covariance(self.since_map_update, lever)
            self._systematic_of_step = carried(self._systematic_of_step, lever)
            self._systematic_in_view = carried(self._systematic_in_view, lever) + by_calibration

    def is_stationary(self, T_anchor_base: Array, slip: Array) -> bool:
        """Whether a pose (3,) differs from the last moved one by at most the slip (3,)."""
        return bool((np.abs(se2.pose_difference(T_anchor_base, self.T_moved)) <= slip).all())

    def coast(self, T_anchor_base: Array, Q: Array, is_stationary: bool) -> None:
        """Use the predicted pose (3,) of this step, without a match."""
        if not is_stationary:
            self.since_map_update = self.since_map_update + Q
            self.T_moved = T_anchor_base
        self.motion_part = self.since_map_update

    def update(self, match: Match, prior: Array, Q: Array, fits: bool, is_stationary: bool) -> None:
        """Update by a match with a prior (3,); fits: whether enough points are inliers."""
        self._contradiction.add(se2.pose_difference(match.pose, prior), self.since_match)
        self.since_match = np.zeros((3, 3)) if fits else match.covariance
        if is_stationary:
            return
        motion_part = inverse(self.since_map_update + Q)
        self.since_map_update = inverse(motion_part + match.scan_information)
        unmeasured = self.since_map_update @ motion_part  # share of the prior: I - K
        self.motion_part = unmeasured @ self.since_map_update
        self._systematic_in_view = unmeasured @ self._systematic_in_view
        self.T_moved = match.pose

    def is_unexpected(self, match: Match, prior: Array) -> bool:
        """Whether the innovation of a match from its prior (3,) exceeds the 99 % gate."""
        off = se2.pose_difference(match.pose, prior)
        return float(off @ np.linalg.solve(self.since_match, off)) > CHI2

    def map_updated(self, share: float) -> None:
        """Account for a map update; share: of the scan's error that is independent of the last.

        It is also the share of the walls in view that the scan draws.
        """
        scan_part = self.scan_part
        self._since_keyframe = self._since_keyframe + self.motion_part + share * scan_part
        self._map_update_covariance = (1.0 - share) * scan_part
        self.since_map_update = np.zeros((3, 3))
        self.motion_part = np.zeros((3, 3))
        drawn = share * self._systematic_in_view
        self._systematic_of_step = self._systematic_of_step + drawn
        self._systematic_in_view = self._systematic_in_view - drawn

    @property
    def scan_part(self) -> Array:
        """Share (3, 3) of `since_map_update` that is due to the scan."""
        return self.since_map_update - self.motion_part

    def start_submap(self, T_anchor_base: Array, covariance: Array) -> None:
        """Start a submap at a pose (3,), with covariance (3, 3) relative to the previous one."""
        self._contradiction.add_jump(covariance)
        self._since_keyframe = self._since_keyframe + covariance
        self.since_match = np.zeros((3, 3))
        self.T_moved = T_anchor_base

    def step(self) -> tuple[Array, Array]:
        """Covariance (3, 3) of the step from the anchor, and that of its jumps (3, 3)."""
        return self._since_keyframe + _MIN_STEP, self._contradiction.covariance

    def start_step(self, T_old_new: Array) -> None:
        """Make a pose (3,), the current one, the anchor: its step covariance restarts at 0."""
        yaw = -float(T_old_new[2])
        self.T_moved = se2.between(T_old_new, self.T_moved)
        self.since_match = rotated_covariance(self.since_match, yaw)
        self.since_map_update = rotated_covariance(self.since_map_update, yaw)
        self.motion_part = rotated_covariance(self.motion_part, yaw)
        self._since_keyframe = np.zeros((3, 3))
        self._map_update_covariance = np.zeros((3, 3))
        self._systematic_in_view = rotation(yaw) @ self._systematic_in_view
        # What a match takes off the part in view is then taken off the new step.
        self._systematic_of_step = -self._systematic_in_view
        self._contradiction = Contradiction()

    @property
    def systematic(self) -> Array:
        """Derivative (3, 4) of the pose relative to the anchor by the calibration."""
        return self._systematic_of_step + self._systematic_in_view

    @property
    def since_anchor(self) -> Array:
        """Covariance (3, 3) of the independent errors of the pose relative to the anchor."""
        # A match cannot be more accurate than the scan that was last added to the map.
        return self._since_keyframe + max(
            self._map_update_covariance, self.since_map_update, key=np.trace
        )
