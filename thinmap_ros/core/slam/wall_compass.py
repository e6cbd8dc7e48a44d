"""Manhattan-world heading prior: most walls are parallel or perpendicular to each other.

Behind a corner a scan may have no overlap with the map. Then only odometry predicts the heading,
and its error rotates everything that is mapped from there on. A histogram of wall lengths by
direction, modulo a right angle, measures the heading better. It is used only if most walls share
one direction; walls in other directions are ignored.
Source: Coughlan and Yuille, "Manhattan world: compass direction from a single image by Bayesian
inference", 1999.
"""

import math
from typing import NamedTuple

import numpy as np

from thinmap_ros.core.ekf_slam.features import Lines
from thinmap_ros.core.se2 import BOUND_SIGMAS, Array
from thinmap_ros.core.slam.graph.pose_graph import Systematic

_QUARTER = 0.5 * math.pi
_BINS = 180  # of half a degree
_NEAR_BINS = 3  # bins to either side of the peak that belong to its direction
_AROUND = np.arange(-_NEAR_BINS, _NEAR_BINS + 1)
_BESIDE = (np.arange(_BINS)[:, None] + [-1, 0, 1]) % _BINS  # each bin with its neighbours


_MIN_TOTAL_M = 60.0  # of wall, summed over scans, for a main direction
_MIN_RATIO = 0.7  # of the walls that are in it
_MIN_LENGTH_M = 1.5  # of wall in a scan
# The heading is most accurate at the start of the map: after this path the weight of a wall is a
# half, and never below the least.
_FADE_M = 20.0
_MIN_WEIGHT = 0.02
_WALL_SIGMA_RAD = 0.003  # of real walls from the main direction
_MAX_OFFSET_RAD = 0.35  # of an inlier


class Reference(NamedTuple):
    """Error of the main wall direction, which all headings that are measured by it share.

    It is that of the headings of the scans whose walls made it. variance: of independent errors,
    rad^2; systematic: share of the odometry, of which only the last row is not zero.
    """

    variance: float
    systematic: Systematic

    def mean(self, other: 'Reference', weight: float) -> 'Reference':
        """Weighted mean with another one; weight: of the other, 0 to 1."""
        a = self.systematic
        b = other.systematic
        return Reference(
            self.variance + weight * (other.variance - self.variance),
            Systematic(
                a.derivative + weight * (b.derivative - a.derivative),
                a.parameters + weight * (b.parameters - a.parameters),
                round(a.spans + weight * (b.spans - a.spans)),
            ),
        )


class Heading(NamedTuple):
    """Heading in the map, rad, and the variance of its measurement by the main wall direction."""

    yaw: float
    variance: float
    reference: Reference

    @property
    def row(self) -> tuple[float, ...]:
        """Yaw, variance, and variance and derivative (4,) of the main direction."""
        by_calibration = self.reference.systematic.derivative[2].tolist()
        return (self.yaw, self.variance, self.reference.variance, *by_calibration)


class WallCompass:
    """Histogram of wall lengths by direction in the map; measures the heading of a scan."""

    def __init__(self) -> None:
        # For each bin: weighted length of the walls (m), and its product with the mean position of
        # their directions in the bin (0 to 1).
        self._metres = np.zeros(_BINS)
        self._places = np.zeros(_BINS)
        self._turned = 0.0  # rotation of the histogram, rad
        self._reference: Reference | None = None

    def add_lines(self, lines: Lines, yaw: float, path_m: float, own: Reference) -> None:
        """Add the walls of a scan with heading yaw (rad), after a path of a length (m).

        own: error of this heading.
        """
        at = (lines.z[:, 1] + yaw - self._turned) % _QUARTER / _QUARTER * _BINS
        bins = at.astype(np.int64)
        fading = 1.0 / (1.0 + (path_m / _FADE_M) ** 2)
        weights = lines.lengths_m * max(fading, _MIN_WEIGHT)
        share = float(weights.sum()) / max(float(self._metres.sum() + weights.sum()), 1e-9)
        self._reference = own if self._reference is None else self._reference.mean(own, share)
        np.add.at(self._metres, bins % _BINS, weights)
        np.add.at(self._places, bins % _BINS, weights * (at - bins))

    @property
    def direction(self) -> float | None:
        """Main direction of the walls, rad, from 0 to a right angle; None if there is none."""
        total = float(self._metres.sum())
        if total < _MIN_TOTAL_M:
            return None
        fullest = int(np.argmax(self._metres[_BESIDE].sum(axis=1)))
        near = (fullest + _AROUND) % _BINS
        metres = float(self._metres[near].sum())
        if metres < _MIN_RATIO * total:
            return None
        mean = (self._places[near].sum() + self._metres[near] @ _AROUND) / metres
        return (float((fullest + mean) * _QUARTER / _BINS) + self._turned) % _QUARTER

    def calibrate(self, parameters: Array) -> None:
        """Turn the main direction as parameters (N, 4) of the calibration have it."""
        if self._reference is not None:
            share = self._reference.systematic
            self._turned += float(share.change(parameters)[2])
            self._reference = self._reference._replace(systematic=share.calibrated(parameters))

    def read(self, lines: Lines, yaw: float, variance: float) -> Heading | None:
        """Measure the heading of a scan by its lines, given a prior yaw (rad) and its variance.

        None if the building has no main direction, or too few lines are inliers to it.
        """
        direction = self.direction
        lengths = lines.lengths_m
        if direction is None or self._reference is None:
            return None
        off = (lines.z[:, 1] + yaw - direction + 0.5 * _QUARTER) % _QUARTER - 0.5 * _QUARTER
        sigmas = np.sqrt(variance + _WALL_SIGMA_RAD**2 + lines.covariances[:, 1, 1])
        near = np.abs(off) < np.minimum(BOUND_SIGMAS * sigmas, _MAX_OFFSET_RAD)
        if lengths[near].sum() < max(_MIN_RATIO * lengths.sum(), _MIN_LENGTH_M):
            return None
        weights = lengths[near] / lengths[near].sum()
        seen = float(np.square(weights) @ lines.covariances[near, 1, 1])
        measured = yaw - float(weights @ off[near])
        return Heading(measured, _WALL_SIGMA_RAD**2 + seen, self._reference)
