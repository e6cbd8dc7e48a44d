"""The motion that is expected from one scan to the next, and how uncertain it is.

Two models tell it: the odometry, and the velocity that the last matches gave. How far each was off
what the scans found is remembered, for translation and rotation, and scales the noise that its
model allows. The expectation is the mean of both, weighted by their information. An odometry that
slips, lags or does not turn at all thereby counts less, without any rule for it.
Source: Mehra, "On the identification of variances and adaptive Kalman filtering", 1970;
Siegwart and Nourbakhsh, "Introduction to autonomous mobile robots", for the odometry's noise.
"""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import parameter
from thinmap_ros.core.ekf_slam.models import OdometryConfig, odometry_slip, odometry_variances
from thinmap_ros.core.se2 import Array

_MOST_SIGMAS = 3.0
_LEAST_SHARE = 1.0  # of the variance that the model allows: good wheels slip, too


@dataclass(frozen=True)
class MotionConfig(OdometryConfig):
    """Noise of the motion, 1 sigma, as it is taken to be before the scans have told."""

    acceleration_m_s2: float = parameter(
        0.5, 'change of velocity in a second, m/s', low=0.01, high=50.0
    )
    acceleration_rad_s2: float = parameter(
        1.0, 'change of turn rate in a second, rad/s', low=0.01, high=50.0
    )
    noise_memory: float = parameter(
        20.0, 'scans after which an error of odometry is forgotten', low=1.0, high=1e4
    )


@dataclass(frozen=True, eq=False)
class Motion:
    """Increment (3,) and its variances (3,), in the robot frame before it.

    stands: whether it is no more than the slip of a robot that stands.
    """

    increment: Array
    variances: Array
    stands: bool


class _Model:
    """One way to tell the motion: its increment (3,), variances (3,), and how true they are."""

    def __init__(self) -> None:
        self.increment: Array = np.zeros(3)
        self.allowed: Array = np.full(3, np.inf)
        self.share: Array = np.ones(2)  # of these variances, of translation and rotation

    @property
    def variances(self) -> Array:
        return self.allowed * self.share[[0, 0, 1]]


class MotionModel:
    """Expects the motion between two scans, and learns from where they were matched."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._odometry, self._velocity = _Model(), _Model()
        self._moved: Array | None = None  # at which velocity, m/s, m/s, rad/s
        self._seconds = 0.0
        self._seconds_moved = 0.0
        self._expected: Array = np.zeros(3)
        self._variances: Array = np.ones(3)

    def expect(self, increment: Array, seconds: float) -> Motion:
        """Motion since the scan before, which was so many seconds ago.

        increment (3,): of the odometry.
        """
        config = self._config
        slip = odometry_slip(config)
        self._odometry.increment = increment
        self._odometry.allowed = odometry_variances(increment, config)
        self._seconds = seconds
        self._velocity.allowed = np.full(3, np.inf)
        if self._moved is not None and seconds > 0.0:
            self._velocity.increment = self._moved * seconds
            jitter = 1.0 + seconds / self._seconds_moved
            sigma_m = jitter * config.odom_slip_m + config.acceleration_m_s2 * seconds**2
            sigma_rad = jitter * config.odom_slip_rad + config.acceleration_rad_s2 * seconds**2
            self._velocity.allowed = np.square([sigma_m, sigma_m, sigma_rad])
        by_odometry, by_velocity = 1.0 / self._odometry.variances, 1.0 / self._velocity.variances
        variances = 1.0 / (by_odometry + by_velocity)
        difference = _difference(self._velocity.increment, increment)
        self._expected = increment + variances * by_velocity * difference
        self._variances = variances
        moves = np.abs(self._expected) > _MOST_SIGMAS * slip
        return Motion(self._expected, variances, not moves.any())

    def learn(self, found: Array, by_scan: Array) -> None:
        """A scan found the motion (3,) to be that, with information (3, 3), robot frame."""
        variance = 1.0 / np.maximum(np.diag(by_scan), 1e-12)  # of the motion as the scan tells it
        K = self._variances / (self._variances + variance)
        off = _difference(found, self._expected)
        gain = 1.0 / self._config.noise_memory
        for model in (self._odometry, self._velocity):
            if np.isfinite(model.allowed).all():
                # K times the innovation, as the match has taken that share of it.
                innovation = off + K * _difference(self._expected, model.increment)
                excess = np.maximum(np.square(innovation) - K * K * variance, 0.0) / model.allowed
                usual = K * K * model.share[[0, 0, 1]]
                # What is farther off has slipped once, and says no more than this of the noise.
                change = np.minimum(excess, _MOST_SIGMAS**2 * usual) - usual
                model.share[0] += gain * 0.5 * (change[0] + change[1])
                model.share[1] += gain * change[2]
                np.maximum(model.share, _LEAST_SHARE, out=model.share)
        self._moved = found / self._seconds if self._seconds > 0.0 else None
        self._seconds_moved = self._seconds

    def interrupt(self) -> None:
        """The next motion begins from somewhere else: there is no velocity to go on with."""
        self._moved = None


def _difference(a: Array, b: Array) -> Array:
    """Motion a less motion b, (3,) each, the turn wrapped."""
    off = a - b
    off[2] = se2.wrap(float(off[2]))
    return off
