"""What odometry errs by at random: which share of what the configuration allows for.

That allows for bad wheels. With good ones so wide a prior would let a scan of few points, as at an
open door, turn the pose to where these happen to fit. How far matches are off their priors tells
how good the wheels are, where the map alone decides. Source: innovation-based estimation of process
noise, Mehra, "On the identification of variances and adaptive Kalman filtering", 1970, reduced to a
factor each for distances and turns.
"""

import math

import numpy as np

from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.doubt import Evidence
from thinmap_ros.core.slam.wheel_noise import MotionConfig, odometry_variances

_MEMORY = 0.998  # of what earlier matches said, from one to the next: floors and loads change
_LEAST = 0.1  # wheels that hardly ever err may slip at the next door-sill
_MOST_SIGMAS = 3.0  # what is farther off has slipped, and says no more than this
# The map has to say so much more than the prior, for a match to tell how wrong that was.
_BY_MAP_ALONE = 3.0
_TURN = np.array([0.0, 0.0, 1.0])


class OdometryNoise:
    """Shares (2,), for distances and turns, of the variances that `odometry_variances` gives.

    1 at first, never above.

    It is as if at first a metre and a radian had been driven that erred by as much as is allowed.
    """

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        allowed = np.square(
            [
                config.odom_distance_sigma,
                math.hypot(config.odom_turn_sigma, config.odom_drift_sigma),
            ]
        )
        self._found, self._allowed = allowed.copy(), allowed
        self._moved = np.zeros(2)

    @property
    def share(self) -> Array:
        """Of each variance that is allowed, the share that there is, (2,).

        Never less than a tenth.
        """
        return np.maximum(self.found_share, _LEAST)

    @property
    def found_share(self) -> Array:
        """The same without that bound, (2,): what has been found so far."""
        known = self._allowed > 0.0
        return np.minimum(np.divide(self._found, self._allowed, out=np.ones(2), where=known), 1.0)

    def move(self, increment: Array) -> None:
        """The robot has moved by an increment (3,) of odometry."""
        self._moved = self._moved + odometry_variances(increment, self._config)

    def learn(self, off: Array, evidence: Evidence, heading: float) -> None:
        """A match is off by (3,), map frame, from the pose (heading in rad) the moves led to."""
        allowed, self._moved = self._moved, np.zeros(2)
        ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
        most = _MOST_SIGMAS**2 * allowed * self.share
        for k, direction in enumerate((ahead, _TURN)):
            by_prior, by_map = (
                direction @ part @ direction for part in (evidence.by_prior, evidence.by_map)
            )
            if allowed[k] > 0.0 and by_map > _BY_MAP_ALONE * by_prior:
                self._found[k] = _MEMORY * self._found[k] + min(
                    float(direction @ off) ** 2, most[k]
                )
                self._allowed[k] = _MEMORY * self._allowed[k] + allowed[k]
