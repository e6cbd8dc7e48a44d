"""How far the pose may be from where the map of points would have it."""

import math
from typing import NamedTuple

import numpy as np

from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.scan_matching import prior_weight

# After so much way a match errs by other points than before.
_SAME_POINTS_M = 1.0
_SAME_POINTS_RAD = 1.0


class Evidence(NamedTuple):
    """Covariance (3, 3) that a match leaves, and information (3, 3) of its prior and of the map."""

    posterior: Array
    by_prior: Array
    by_map: Array


class Doubt:
    """Covariances (3, 3) of the pose, map frame, as if the map of points were the truth.

    since_match: what was added since a scan last fitted.
    on_map: what all matches so far leave open.
    """

    def __init__(self, covariance: Array | None = None) -> None:
        """Begin with the covariance (3, 3) of where the robot is.

        Without one, the map begins there.
        """
        start = np.zeros((3, 3)) if covariance is None else covariance
        self.since_match, self.on_map = start, start

    def move(self, F_x: Array, added: Array) -> None:
        """The robot has moved: Jacobian (3, 3) by the pose, covariance (3, 3) of the increment."""
        self.since_match = F_x @ self.since_match @ F_x.T + added
        self.on_map = F_x @ self.on_map @ F_x.T + added

    def evidence(self, posterior: Array, off: Array) -> Evidence:
        """What speaks for a match with posterior (3, 3) that is off its prior by (3,).

        The covariance of the prior was since_match.
        """
        by_prior = np.asarray(np.linalg.inv(self.since_match), dtype=np.float64)
        held = prior_weight(float(off @ by_prior @ off))
        return Evidence(
            posterior, held * by_prior, _positive(np.linalg.inv(posterior) - held * by_prior)
        )

    def match(self, evidence: Evidence, increment: Array) -> Array:
        """A scan fits: what this step adds to the covariance of the pose in the world, (3, 3).

        Of the error of the prior a match leaves a part, that is new with every step; what the map
        adds is much the same error as in the step before as long as the same points are seen.
        """
        self.since_match = np.zeros((3, 3))
        information = np.linalg.inv(self.on_map) + evidence.by_map
        self.on_map = np.asarray(np.linalg.inv(information), dtype=np.float64)
        way, turn = math.hypot(increment[0], increment[1]), abs(increment[2])
        share = min(1.0, way / _SAME_POINTS_M + turn / _SAME_POINTS_RAD)
        added = evidence.by_prior + share * evidence.by_map
        return np.asarray(evidence.posterior @ added @ evidence.posterior)


def _positive(information: Array) -> Array:
    """The part (3, 3) that is not negative.

    A match far from its prior gives that less weight than it claims.
    """
    values, vectors = np.linalg.eigh(information)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
