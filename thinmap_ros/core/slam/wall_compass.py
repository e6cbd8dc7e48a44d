"""Heading by the walls: those of most buildings stand parallel or square to each other.

Where a robot comes round a corner into a hall, a scan may show nothing that the map knows: the
wheels alone then say how it is turned, and all that is drawn from there on is turned with it. What
was learned of the walls so far tells better: how many metres of them were seen in which direction,
modulo a right angle. Only where most stand in one it is believed, and walls that stand otherwise
say nothing.
Source: Coughlan and Yuille, "Manhattan world: compass direction from a single image by Bayesian
inference", 1999.
"""

import math
from typing import NamedTuple

import numpy as np

from thinmap_ros.core.ekf_slam.line_extraction import Lines
from thinmap_ros.core.se2 import Array

_QUARTER = 0.5 * math.pi
_BINS = 180  # of half a degree
_NEAR_BINS = 3  # to either side of the fullest: walls of its direction
_AROUND = np.arange(-_NEAR_BINS, _NEAR_BINS + 1)
_BESIDE = (np.arange(_BINS)[:, None] + [-1, 0, 1]) % _BINS  # each bin with its neighbours
_LEAST_M = 60.0  # of wall, scan by scan, before a direction is believed
_MOST = 0.7  # share of them that stands in it
# The heading is surest where the map begins: after so much way a wall weighs half as much, and in
# the end this much.
_FADES_M = 20.0
_LEAST_WEIGHT = 0.02
_ASKEW_RAD = 0.003  # by which walls are built askew, 1 sigma
_GATE_SIGMAS = 3.0
_WIDEST_RAD = 0.35
_SHORTEST_M = 1.5  # of wall in a scan that tells a heading


class Heading(NamedTuple):
    """Heading in the map, rad, and its variance."""

    yaw: float
    variance: float


class WallCompass:
    """Metres of wall by direction in the map, and what the walls of a scan say of the heading."""

    def __init__(self) -> None:
        # By direction: metres of wall, weighted, and these times where in the bin the walls stand
        # on an average.
        self._metres = np.zeros(_BINS)
        self._places = np.zeros(_BINS)

    def learn(self, lines: Lines, yaw: float, way_m: float) -> None:
        """Take in the walls of a scan made with a heading, rad, so far along the way, m."""
        at = (lines.z[:, 1] + yaw) % _QUARTER / _QUARTER * _BINS
        bins = at.astype(np.int64)
        weights = _lengths(lines) * max(1.0 / (1.0 + (way_m / _FADES_M) ** 2), _LEAST_WEIGHT)
        np.add.at(self._metres, bins % _BINS, weights)
        np.add.at(self._places, bins % _BINS, weights * (at - bins))

    @property
    def direction(self) -> float | None:
        """That of most walls, rad, from 0 to a right angle; None where there is none."""
        total = float(self._metres.sum())
        if total < _LEAST_M:
            return None
        fullest = int(np.argmax(self._metres[_BESIDE].sum(axis=1)))
        near = (fullest + _AROUND) % _BINS
        metres = float(self._metres[near].sum())
        if metres < _MOST * total:
            return None
        mean = (self._places[near].sum() + self._metres[near] @ _AROUND) / metres
        return float((fullest + mean) * _QUARTER / _BINS) % _QUARTER

    def read(self, lines: Lines, yaw: float, variance: float) -> Heading | None:
        """The heading, near one (rad) known to a variance, at which the lines stand as walls do.

        None where the building has no such direction, or these lines do not tell it.
        """
        direction = self.direction
        lengths = _lengths(lines)
        if direction is None:
            return None
        off = (lines.z[:, 1] + yaw - direction + 0.5 * _QUARTER) % _QUARTER - 0.5 * _QUARTER
        sigmas = np.sqrt(variance + _ASKEW_RAD**2 + lines.covariances[:, 1, 1])
        near = np.abs(off) < np.minimum(_GATE_SIGMAS * sigmas, _WIDEST_RAD)
        if lengths[near].sum() < max(_MOST * lengths.sum(), _SHORTEST_M):
            return None
        weights = lengths[near] / lengths[near].sum()
        seen = float(np.square(weights) @ lines.covariances[near, 1, 1])
        return Heading(yaw - float(weights @ off[near]), _ASKEW_RAD**2 + seen)


def _lengths(lines: Lines) -> Array:
    """Lengths (K,) of line segments, m."""
    return np.asarray(np.hypot(*(lines.ends[:, 1] - lines.ends[:, 0]).T))
