"""The log odds of a place, however it was found: against all others, and against none of them.

Views along a path and samples all over a map propose places. Each look at one is a share of what is
seen that the map shows again. Its worth follows from that share at the right place and at others,
the odds from the number of those others, and from a prior. All in nats.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from thinmap_ros.core.se2 import Array

# Prior log odds that what is looked for is in none of the places of a map, against in one of them.
MAY_BE_ELSEWHERE = 0.0  # a piece of map: nobody says that it is near
IN_THIS_MAP = -math.log(20.0)  # a search that somebody has asked for; it may miss the place as well

# What a robot is sure of where nothing contradicts it: how rarely one is kidnapped, or let out of a
# lift. No more is gained by further looks.
SURE = math.log(1e4)

# Of one look. Neighbouring looks are not independent, and the model may be wrong: with twice as
# much a foreign pair of maps was joined, with half as much a real building was not.
MAX_LOG_RATIO = 6.0

# Places of a map that tell what is found by chance.
OTHER_PLACES = 40

# Share of a look of which the map must tell: of a view along a path, and of a scan from one place.
# With half of a scan, a robot that had left the map was found in it.
MIN_KNOWN = 0.3
_MIN_KNOWN_OF_SCAN = 0.6


class Shares(NamedTuple):
    """Mean and standard deviation of the share of a look that places of one kind show again."""

    mean: float
    sigma: float

    @staticmethod
    def of(shares: Sequence[float], least_sigma: float) -> 'Shares':
        """Those of measured shares (N,); least_sigma: of what was not measured."""
        return Shares(float(np.mean(shares)), max(float(np.std(shares)), least_sigma))


def log_ratios(
    found: Array | float, known: Array | float, here: Shares, elsewhere: Shares
) -> Array:
    """Log likelihood ratios (N,) of looks at the right place, against any other one.

    found (N,): shares of what the map tells of that it shows again; known (N,): shares of the look
    of which it tells. More than usual speaks for the right place, less for another one.
    """
    right = -0.5 * (np.minimum(found - here.mean, 0.0) / here.sigma) ** 2
    wrong = -0.5 * (np.maximum(found - elsewhere.mean, 0.0) / elsewhere.sigma) ** 2
    ratios = known * (right - wrong - math.log(here.sigma / elsewhere.sigma))
    return np.asarray(np.where(known < MIN_KNOWN, 0.0, ratios))


class MissingShares(NamedTuple):
    """Mean shares of a scan that a map leaves unexplained: at the right place, and at look-alikes.

    Both are exponential.
    """

    right: float
    alike: float

    def log_ratios(self, found: Array, known: Array) -> Array:
        """Log likelihood ratios (N,) of the right place, against one that looks alike, limited.

        found (N,): shares of what the map tells of that it explains; known (N,): of how much it
        tells.
        """
        slope = 1.0 / self.right - 1.0 / self.alike
        ratios = math.log(self.alike / self.right) - (1.0 - found) * slope
        return limited(np.where(known < _MIN_KNOWN_OF_SCAN, 0.0, known * ratios))


def limited(log_ratio: Array | float) -> Array:
    """Log likelihood ratios (N,) of single looks, no more than one may tell."""
    return np.clip(log_ratio, -MAX_LOG_RATIO, MAX_LOG_RATIO)


def log_odds_of_first(evidence: Array, alternatives: float, elsewhere: float) -> float:
    """Log odds of the first of some places, against the others and against none of them.

    evidence (H,): sums of log likelihood ratios; alternatives: log of the
    number of places that a look is compared with; elsewhere: prior log odds of none of them, as
    `IN_THIS_MAP`.
    """
    others = np.append(evidence[1:] - alternatives, elsewhere)
    return float(evidence[0]) - alternatives - float(np.logaddexp.reduce(others))


def log_odds_of_any(evidence: Array, alternatives: float, elsewhere: float) -> float:
    """Log odds that one of some places is the right one, against none of them."""
    return float(np.logaddexp.reduce(evidence)) - alternatives - elsewhere


# From which two maps become one.
JOIN_ODDS = 100_000.0


def on_one_storey(log_odds: float, ratio: float, join_odds: float) -> float:
    """Log odds of a place, given those without regard to storeys, and `storey_evidence`.

    The same place on another storey is as rare beforehand as a false join that is accepted.
    """
    return -float(np.logaddexp(-log_odds, -math.log(join_odds) - ratio))
