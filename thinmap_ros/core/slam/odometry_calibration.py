"""Online calibration of the systematic odometry error.

Its causes are wheels of an unexpected size, unequal wheels, and a laser that is mounted askew.

A match corrects only a part of the prediction error. The rest enters the map and bends it.
Therefore the systematic part is estimated and removed from the prediction. The model is that of
UMBmark, estimated by a Kalman filter while driving. A metre of odometry is `scale` metres, in a
direction that is `askew` radians off the heading of the scans. A radian of odometry is `turn_scale`
radians, and each metre adds `drift` radians. Source: Borenstein and Feng, "Measurement and
correction of systematic odometry errors in mobile robots", 1996.
"""

import math
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array, carried, rotation
from thinmap_ros.core.slam.graph.rows import Rows
from thinmap_ros.jit import kernel

_OUTLIER_SIGMAS = 3.0  # beyond which all innovations teach the same


@dataclass(frozen=True)
class CalibrationConfig:
    """Noise of the calibration.

    prior_sigmas: of scale, drift, turn_scale and askew before the first span; walk_sigmas: their
    random walk per m or rad, as floor and load change. span_m, span_rad: smallest span to compare,
    so long that the covariance of its two ends is small beside it; noise_m, noise_rad: of a span,
    besides that of its ends and of the odometry, as errors of matches are correlated;
    min_information: for directions without information, as in a corridor; gate_sigmas: a larger
    innovation is wheel slip. The noise is scaled by the innovations of noise_window spans.
    """

    prior_sigmas: tuple[float, ...] = (0.02, 0.02, 0.05, 0.02)
    walk_sigmas: tuple[float, ...] = (0.001, 0.001, 0.001, 0.0002)
    span_m: float = 1.0
    span_rad: float = 1.0
    noise_m: float = 0.02
    noise_rad: float = 0.02
    min_information: float = 1e-2
    gate_sigmas: float = 4.0
    noise_window: float = 20.0


@dataclass(frozen=True, eq=False)
class _MatchedPose:
    """Pose (3,), its covariance (3, 3) by the scan, and derivative (3, 4) by the parameters.

    All in the map frame.
    """

    T_map_base: Array
    covariance: Array
    systematic: Array


class OdometryCalibration:
    """Estimates the systematic odometry error from scan matches, and removes it."""

    def __init__(self, config: CalibrationConfig | None = None) -> None:
        self._config = config or CalibrationConfig()
        # Estimated parameters: scale, drift in rad/m, turn_scale, askew in rad.
        self.parameters = np.array([1.0, 0.0, 1.0, 0.0])
        self.covariance: Array = np.diag(np.square(self._config.prior_sigmas))  # (4, 4)
        self._spans = _Spans(self.parameters, self.covariance)
        # Of turn, length and lateral offset of a span.
        self._noises = [_Noise(self._config.noise_window) for _ in range(3)]
        self.applied = self.parameters  # as the map contains them
        self._begin: _MatchedPose | None = None
        self.reset_segment()

    def reset_segment(self) -> None:
        """Discard the current span, after a pose that is not due to matching: set or lost."""
        self._begin = None
        self._expected = np.zeros(3)
        self._by_parameters = np.zeros((3, 4))  # derivative of _expected
        self._travelled_m = self._turned_rad = 0.0
        self._random = np.zeros(2)

    def begin_with(self, parameters: Array, covariance: Array) -> None:
        """Begin with parameters (4,) and covariance (4, 4) that were found before."""
        self.parameters = parameters
        self.covariance = covariance
        self._spans = _Spans(parameters, covariance)
        self.applied = parameters

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
            and abs(self._travelled_m) < self._config.span_m
            and abs(self._turned_rad) < self._config.span_rad
        ):
            return
        covariance: Array = np.linalg.inv(by_map + self._config.min_information * np.eye(3)).astype(
            np.float64
        )
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
        self.covariance = self.covariance + np.diag(np.square(self._config.walk_sigmas)) * moved
        predicted = self.covariance
        off_turn = float(se2.wrap(float(found[2] - self._expected[2])))
        variance = self._config.noise_rad**2 + self._random[1] + float(covariance[2, 2])
        self._update(off_turn, H[2], variance, self._noises[0])
        length = math.hypot(self._expected[0], self._expected[1])
        if length > 0.5 * self._config.span_m:
            x, y = self._expected[:2] / length
            dx, dy = found[:2] - self._expected[:2]
            along = np.array([x, y])
            across = np.array([-y, x])
            variance = (
                self._config.noise_m**2
                + self._random[0]
                + float(along @ covariance[:2, :2] @ along)
            )
            self._update(x * dx + y * dy, along @ H[:2], variance, self._noises[1])
            # The lateral offset contains half of the turn error.
            aside = x * dy - y * dx - 0.5 * length * off_turn
            variance = (
                self._config.noise_m**2
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
        if off * off > self._config.gate_sigmas**2 * variance:
            return
        gain = along / variance
        self.parameters = self.parameters + gain * off
        self.covariance = self.covariance - np.outer(gain, along)


class _Noise:
    """Scale, at least 1, of the modelled variance of a measurement, by its innovations.

    An odometry that slips at single steps, as the motion model has long learned, does so in spans.
    Source: Mehra, "On the identification of variances and adaptive Kalman filtering", 1970.
    """

    def __init__(self, window: float) -> None:
        """window: number of innovations that count."""
        self.scale = 1.0
        self._window = window
        self._learned = 0.0  # innovations so far, by weight

    def learn(self, off: float, known: float, modelled: float) -> None:
        """Adapt to an innovation; variances: known, by the parameters; modelled, by the noise."""
        noise = self.scale * modelled
        beyond = max(off * off - known, 0.0) / modelled
        outlier = _OUTLIER_SIGMAS**2 * self.scale
        weight = noise / (noise + known)  # what the innovation says about the noise
        self._learned += weight
        rate = max(1.0 / self._window, 1.0 / (1.0 + self._learned))
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
        found: Array = _smoothed(self._parameters.values, self._gains.values)
        return found


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
