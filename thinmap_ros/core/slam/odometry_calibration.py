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
from thinmap_ros.core.ekf_slam.models import rotation
from thinmap_ros.core.se2 import Array


@dataclass(frozen=True)
class CalibrationConfig:
    """Noise of the calibration.

    prior_sigmas: of scale, drift, turn_scale and askew before the first span; walk_sigmas: their
    random walk per m or rad, as floor and load change. span_m, span_rad: smallest span to compare,
    so long that the covariance of its two ends is small beside it; noise_m, noise_rad: of a span,
    besides that of its ends and of the odometry, as errors of matches are correlated;
    min_information: for directions without information, as in a corridor; gate_sigmas: a larger
    innovation is wheel slip.
    """

    prior_sigmas: tuple[float, ...] = (0.02, 0.02, 0.05, 0.02)
    walk_sigmas: tuple[float, ...] = (0.001, 0.001, 0.001, 0.0002)
    span_m: float = 1.0
    span_rad: float = 1.0
    noise_m: float = 0.02
    noise_rad: float = 0.02
    min_information: float = 1e-2
    gate_sigmas: float = 4.0


class OdometryCalibration:
    """Estimates the systematic odometry error from scan matches, and removes it."""

    def __init__(self, config: CalibrationConfig | None = None) -> None:
        self._config = config or CalibrationConfig()
        # Estimated parameters: scale, drift in rad/m, turn_scale, askew in rad.
        self.parameters = np.array([1.0, 0.0, 1.0, 0.0])
        self._covariance = np.diag(np.square(self._config.prior_sigmas))
        self._begin: Array | None = None
        self._begin_covariance: Array = np.zeros((3, 3))  # of the pose _begin, map frame
        self.reset_segment()

    def reset_segment(self) -> None:
        """Discard the current span, after a pose that is not due to matching: set or lost."""
        self._begin = None
        self._expected = np.zeros(3)
        self._travelled_m = self._turned_rad = 0.0
        self._random = np.zeros(2)

    def corrected(self, increment: Array, variances: Array) -> tuple[Array, Array]:
        """Odometry increment (3,), robot frame, without its systematic error.

        Also returns the covariance (3, 3) of the residual systematic error.

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
        self._expected = se2.compose(self._expected, found)
        G = np.array(
            [
                [x / scale, -0.5 * y * length, -0.5 * y * turned, -y],
                [y / scale, 0.5 * x * length, 0.5 * x * turned, x],
                [0.0, length, turned, 0.0],
            ]
        )
        return found, G @ self._covariance @ G.T

    def update(self, T_map_base: Array, by_map: Array) -> None:
        """Update the calibration by a matched pose (3,), map frame, after the increments so far.

        by_map (3, 3): information of the scan alone. The odometry prior must not be part of it,
        because it is not independent of the increments.
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
        if self._begin is not None:
            R = rotation(float(self._begin[2]))
            found = se2.between(self._begin, T_map_base)
            self._update_span(found, R.T @ (covariance + self._begin_covariance) @ R)
        self.reset_segment()
        self._begin = T_map_base
        self._begin_covariance = covariance

    def _update_span(self, found: Array, covariance: Array) -> None:
        """Kalman updates by the turn of a span, its length, and its lateral offset.

        found (3,), covariance (3, 3): measured end of the span, in the frame of its start.
        """
        moved = abs(self._travelled_m) + abs(self._turned_rad)
        self._covariance += np.diag(np.square(self._config.walk_sigmas)) * moved
        off_turn = float(se2.wrap(float(found[2] - self._expected[2])))
        variance = self._config.noise_rad**2 + self._random[1] + float(covariance[2, 2])
        self._update(off_turn, np.array([0.0, self._travelled_m, self._turned_rad, 0.0]), variance)
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
            self._update(
                x * dx + y * dy, np.array([length / self.parameters[0], 0.0, 0.0, 0.0]), variance
            )
            # The lateral offset contains half of the turn error.
            aside = x * dy - y * dx - 0.5 * length * off_turn
            variance = (
                self._config.noise_m**2
                + 0.25 * length**2 * self._random[1]
                + float(across @ covariance[:2, :2] @ across)
            )
            self._update(aside, np.array([0.0, 0.0, 0.0, length]), variance)

    def _update(self, off: float, H: Array, noise: float) -> None:
        """Scalar Kalman update by an innovation `off`; an innovation outside the gate is ignored.

        noise: variance of the measurement.
        """
        along = self._covariance @ H
        variance = float(H @ along) + noise
        if off * off > self._config.gate_sigmas**2 * variance:
            return
        gain = along / variance
        self.parameters = self.parameters + gain * off
        self._covariance -= np.outer(gain, along)


def _signed_length(increment: Array) -> float:
    """Signed length of an increment (3,): negative where the robot drove backwards."""
    chord = math.hypot(increment[0], increment[1])
    half = 0.5 * float(increment[2])
    return -chord if increment[0] * math.cos(half) + increment[1] * math.sin(half) < 0.0 else chord
