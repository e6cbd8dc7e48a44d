"""What odometry errs by all the time.

Wheels of another size than thought, unequal ones, a laser mounted askew.

A match with the map takes an error of the prediction back only in part: the rest is drawn into the
map where it grows, and bends it. What can be known beforehand is therefore taken off beforehand.
The model is that of UMBmark, learned while driving: of the way as odometry tells it, each metre is
`scale` metres in a direction that is `askew` radians off the heading of the scans, and each radian
`turn_scale` radians with `drift` radians to each metre. Source: Borenstein and Feng, "Measurement
and correction of systematic odometry errors in mobile robots", 1996.
"""

import math

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.models import rotation
from thinmap_ros.core.se2 import Array

_PRIOR_SIGMAS = (0.02, 0.02, 0.05, 0.02)  # of what is known before the first span
_WANDER_SIGMAS = (0.001, 0.001, 0.001, 0.0002)  # in a metre or radian: floors and loads change
# What is compared: long enough for the doubt of its two ends to be small beside it.
_SPAN_M = 1.0
_SPAN_RAD = 1.0
# Of a span, besides the doubt of its ends and of the wheels: matches err together.
_SIGMA_M = 0.02
_SIGMA_RAD = 0.02
_LEAST_INFORMATION = (1e-2, 1e-2, 1e-2)  # for what the map leaves open, as along a corridor
_GATE_SIGMAS = 4.0  # what is farther off has slipped


class OdometryCalibration:
    """Compares spans of odometry with where the scans say that the robot went.

    Takes the systematic part off.
    """

    def __init__(self) -> None:
        # scale, drift in rad/m, turn_scale, askew in rad
        self.known = np.array([1.0, 0.0, 1.0, 0.0])
        self._covariance = np.diag(np.square(_PRIOR_SIGMAS))
        self._begin: Array | None = None
        self._doubt: Array = np.zeros((3, 3))  # of where a span begins, map frame
        self.reset_segment()

    def reset_segment(self) -> None:
        """Compare nothing across this moment: the pose was not found but put, moved or lost."""
        self._begin = None
        self._expected = np.zeros(3)
        self._way_m = self._turned_rad = 0.0
        self._random = np.zeros(2)

    def corrected(self, increment: Array, variances: Array) -> tuple[Array, Array]:
        """Odometry increment (3,), robot frame, without its systematic error.

        Also returns the covariance (3, 3) of what is left of that error.

        variances (2,): of its chord, m^2, and of its turn, rad^2, by what it errs by at random.
        """
        way = _way(increment)
        turned = float(increment[2])
        scale, drift, turn_scale, askew = self.known
        turn = turn_scale * turned + drift * way
        bent = askew + 0.5 * (turn - turned)  # the chord of an arc lies half of its turn off
        c = scale * math.cos(bent)
        s = scale * math.sin(bent)
        x = c * increment[0] - s * increment[1]
        y = s * increment[0] + c * increment[1]
        self._way_m += way
        self._turned_rad += turned
        self._random = self._random + variances
        found = np.array([x, y, turn])
        self._expected = se2.compose(self._expected, found)
        G = np.array(
            [
                [x / scale, -0.5 * y * way, -0.5 * y * turned, -y],
                [y / scale, 0.5 * x * way, 0.5 * x * turned, x],
                [0.0, way, turned, 0.0],
            ]
        )
        return found, G @ self._covariance @ G.T

    def update(self, T_map_base: Array, by_map: Array) -> None:
        """Hear where the robot was found (3,) after the increments so far, map frame.

        by_map (3, 3): with what information. Of this only what the map has said: what the wheels
        themselves said proves nothing about them.
        """
        if (
            self._begin is not None
            and abs(self._way_m) < _SPAN_M
            and abs(self._turned_rad) < _SPAN_RAD
        ):
            return
        doubt: Array = np.linalg.inv(by_map + np.diag(_LEAST_INFORMATION)).astype(np.float64)
        if self._begin is not None:
            turn = rotation(float(self._begin[2]))
            self._learn(se2.between(self._begin, T_map_base), turn.T @ (doubt + self._doubt) @ turn)
        self.reset_segment()
        self._begin = T_map_base
        self._doubt = doubt

    def _learn(self, found: Array, doubt: Array) -> None:
        """Kalman updates with a span's turn, and its length along where it should have led.

        found (3,), doubt (3, 3): of the span's end, seen from its beginning.
        """
        moved = abs(self._way_m) + abs(self._turned_rad)
        self._covariance += np.diag(np.square(_WANDER_SIGMAS)) * moved
        off_turn = float(se2.wrap(float(found[2] - self._expected[2])))
        variance = _SIGMA_RAD**2 + self._random[1] + float(doubt[2, 2])
        self._update(off_turn, np.array([0.0, self._way_m, self._turned_rad, 0.0]), variance)
        length = math.hypot(self._expected[0], self._expected[1])
        if length > 0.5 * _SPAN_M:
            x, y = self._expected[:2] / length
            dx, dy = found[:2] - self._expected[:2]
            along = np.array([x, y])
            across = np.array([-y, x])
            variance = _SIGMA_M**2 + self._random[0] + float(along @ doubt[:2, :2] @ along)
            self._update(
                x * dx + y * dy, np.array([length / self.known[0], 0.0, 0.0, 0.0]), variance
            )
            # Half of what it turned too far has led it aside as well.
            aside = x * dy - y * dx - 0.5 * length * off_turn
            variance = (
                _SIGMA_M**2
                + 0.25 * length**2 * self._random[1]
                + float(across @ doubt[:2, :2] @ across)
            )
            self._update(aside, np.array([0.0, 0.0, 0.0, length]), variance)

    def _update(self, off: float, H: Array, noise: float) -> None:
        """One scalar update of what is known; what is too far off to be systematic is left out.

        noise: variance of off.
        """
        along = self._covariance @ H
        variance = float(H @ along) + noise
        if off * off > _GATE_SIGMAS**2 * variance:
            return
        gain = along / variance
        self.known = self.known + gain * off
        self._covariance -= np.outer(gain, along)


def _way(increment: Array) -> float:
    """Signed length of an increment (3,): negative where the robot drove backwards."""
    chord = math.hypot(increment[0], increment[1])
    half = 0.5 * float(increment[2])
    return -chord if increment[0] * math.cos(half) + increment[1] * math.sin(half) < 0.0 else chord
