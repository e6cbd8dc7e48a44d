"""Belief about a candidate: the probability that nothing is hidden behind it, and the area if not.

The paper's threshold on a probability remains; the probability itself comes from the map:

- the length of the frontier, the unknown area in line of sight behind it, and how deep the unknown
  is: inside of a wall it is two or three cells;
- each visit that showed nothing.

Distance and angles of observations, the paper's D and A, add nothing to these.

Source: exploration paper section 3.2; the constants are fitted, see `benchmarks/exploration/`.
"""

import bisect
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

WORTH_SEEING_M2 = 0.5  # a smaller hidden area counts as nothing
_LOG_ODDS_LIMIT = 14.0
_MIN_LENGTH_M = 0.1
_MIN_M2 = 0.05
_MIN_DEPTH_M = 0.05
_DEVIATIONS = 1.645  # of a normal distribution at 95 %


@dataclass(frozen=True)
class BeliefModel:
    """Fitted constants of the belief.

    log_odds: that nothing is hidden behind a frontier of 1 m, 1 m deep, with 1 m2 in line of sight;
    length, hidden, depth: added per natural logarithm of the length, m, of the area in line of
    sight, m2, and of the depth, m, of the unknown straight behind; visit: added for each visit that
    showed nothing. area_limits_m2, mean_area_m2: mean hidden area, if there is any, where less than
    a limit is in line of sight; the last one, where more is.
    """

    log_odds: float
    length: float
    hidden: float
    depth: float
    visit: float
    area_limits_m2: tuple[float, ...]
    mean_area_m2: tuple[float, ...]

    def probability(
        self, length_m: float, hidden_m2: float, depth_m: float, visits: int = 0
    ) -> float:
        """Probability that nothing worth seeing is behind a frontier."""
        log_odds = (
            self.log_odds
            + self.length * math.log(max(length_m, _MIN_LENGTH_M))
            + self.hidden * math.log(max(hidden_m2, _MIN_M2))
            + self.depth * math.log(max(depth_m, _MIN_DEPTH_M))
            + self.visit * visits
        )
        return 1.0 / (1.0 + math.exp(-min(max(log_odds, -_LOG_ODDS_LIMIT), _LOG_ODDS_LIMIT)))

    def mean_area(self, hidden_m2: float) -> float:
        """Mean area, m2, behind a frontier if something is."""
        return self.mean_area_m2[bisect.bisect(self.area_limits_m2, hidden_m2)]


class MissingArea(NamedTuple):
    """Free area, m2, that an exploration has not seen: expected, and its 95 % bound."""

    expected_m2: float
    bound_m2: float


def missing_area(hidden: Iterable[tuple[float, float]]) -> MissingArea:
    """Area behind candidates, of each its probability that nothing is behind, and the mean if not.

    Each hides nothing, or an exponentially distributed area. The bound is that of the gamma
    distribution with the mean and the variance of their sum.
    Source: Wilson and Hilferty, "The distribution of chi-square", 1931 (quantile of a gamma
    distribution).
    """
    mean = 0.0
    variance = 0.0
    for probability, area_m2 in hidden:
        share = 1.0 - probability
        mean += share * area_m2
        variance += share * (2.0 - share) * area_m2**2
    if mean <= 0.0:
        return MissingArea(0.0, 0.0)
    per_shape = variance / mean**2
    root = 1.0 - per_shape / 9.0 + _DEVIATIONS * math.sqrt(per_shape) / 3.0
    return MissingArea(mean, mean * max(root, 0.0) ** 3)
