"""What odometry errs by all the time: wheels of another size than thought, unequal ones, a laser mounted askew.

A match with the map takes an error of the prediction back only in part: the rest is drawn into the map where it grows,
and bends it. What can be known beforehand is therefore taken off beforehand. The model is that of UMBmark, learned
while driving: of the way as odometry tells it, each metre is `scale` metres in a direction that is `askew` radians off
the heading of the scans, and each radian `turn_scale` radians with `drift` radians to each metre. Source: Borenstein
and Feng, "Measurement and correction of systematic odometry errors in mobile robots", 1996.
"""

import math

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array

_PRIOR_SIGMAS = (0.05, 0.1, 0.1, 0.05)  # of what is known before the first span
_WANDER_SIGMAS = (0.001, 0.001, 0.001, 0.0002)  # in a metre or radian: floors and loads change
_SPAN_M, _SPAN_RAD = 1.0, 1.0  # what is compared: long enough for the doubt of its two ends to be small beside it
_SIGMA_M, _SIGMA_RAD = 0.02, 0.02  # of a span: of its ends, and of what the wheels err by on it at random
_GATE_SIGMAS = 4.0  # what is farther off has slipped


class OdometryCalibration:
    """Compares spans of odometry with where the scans say that the robot went; takes the systematic part off."""

    def __init__(self) -> None:
        # scale, drift in rad/m, turn_scale, askew in rad
        self.known = np.array([1.0, 0.0, 1.0, 0.0])
        self._covariance = np.diag(np.square(_PRIOR_SIGMAS))
        self._begin: Array | None = None
        self.interrupt()

    def interrupt(self) -> None:
        """Compare nothing across this moment: the pose was not found but put, moved or lost."""
        self._begin, self._expected = None, np.zeros(3)
        self._way_m = self._turned_rad = 0.0

    def corrected(self, increment: Array) -> tuple[Array, Array]:
        """An increment (3,) of odometry, robot frame, without its systematic error, and what is left of that (3, 3)."""
        way, turned = _way(increment), float(increment[2])
        scale, drift, turn_scale, askew = self.known
        turn = turn_scale * turned + drift * way
        bent = askew + 0.5 * (turn - turned)  # the chord of an arc lies half of its turn off
        c, s = scale * math.cos(bent), scale * math.sin(bent)
        x, y = c * increment[0] - s * increment[1], s * increment[0] + c * increment[1]
        self._way_m += way
        self._turned_rad += turned
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

    def follow(self, T_map_base: Array) -> None:
        """Hear where the robot was found (3,) after the increments so far."""
        if self._begin is not None:
            if abs(self._way_m) < _SPAN_M and abs(self._turned_rad) < _SPAN_RAD:
                return
            self._learn(se2.between(self._begin, T_map_base))
        self.interrupt()
        self._begin = T_map_base

    def _learn(self, found: Array) -> None:
        """Kalman updates with a span's turn, and with its length along where it was expected to lead."""
        moved = abs(self._way_m) + abs(self._turned_rad)
        self._covariance += np.diag(np.square(_WANDER_SIGMAS)) * moved
        off_turn = float(se2.wrap(float(found[2] - self._expected[2])))
        self._update(off_turn, np.array([0.0, self._way_m, self._turned_rad, 0.0]), _SIGMA_RAD)
        length = math.hypot(self._expected[0], self._expected[1])
        if length > 0.5 * _SPAN_M:
            x, y = self._expected[:2] / length
            dx, dy = found[:2] - self._expected[:2]
            self._update(x * dx + y * dy, np.array([length / self.known[0], 0.0, 0.0, 0.0]), _SIGMA_M)
            # Half of what it turned too far has led it aside as well.
            aside = x * dy - y * dx - 0.5 * length * off_turn
            self._update(aside, np.array([0.0, 0.0, 0.0, length]), _SIGMA_M)

    def _update(self, off: float, H: Array, sigma: float) -> None:
        """One scalar update of what is known; what is too far off to be systematic is left out."""
        along = self._covariance @ H
        variance = float(H @ along) + sigma * sigma
        if off * off > _GATE_SIGMAS**2 * variance:
            return
        gain = along / variance
        self.known = self.known + gain * off
        self._covariance -= np.outer(gain, along)


def _way(increment: Array) -> float:
    """Signed length of an increment (3,): negative where the robot drove backwards."""
    chord, half = math.hypot(increment[0], increment[1]), 0.5 * float(increment[2])
    return -chord if increment[0] * math.cos(half) + increment[1] * math.sin(half) < 0.0 else chord
