"""Belief about a candidate: the probability that nothing is hidden behind it, and the area if not.

The form is the paper's: a prior, Bayes' rule with the reliability R = max(D, A), and a visit only
below a threshold. Two things differ, because a calibrated probability needs them:

- the prior, 0.5 in the paper, comes from the map: the length of the open frontier, and the unknown
  area in line of sight behind it;
- R counts once, not with each view: D and A are already the best of all views, so that each further
  update would count the same evidence again.

Source: exploration paper section 3.2, equations (5) to (10); the prior is fitted, see
`benchmarks/exploration/`.
"""

import bisect
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.exploration.belief.evidence import Evidence
from thinmap_ros.core.se2 import Array

WORTH_SEEING_M2 = 0.5  # a smaller hidden area counts as nothing
HIDDEN_REACH_M = 4.0  # to which unknown area counts as in line of sight
_CLOSED = 0.999  # probability of an end node without a frontier
_CLOSED_AREA_M2 = 1.0
_R_LIMIT = 0.02  # R stays this far from 0 and 1, as one view is never certain
_LOG_ODDS_LIMIT = 14.0
_SHORTEST_M = 0.1
_MIN_M2 = 0.05
_SAMPLES = 200
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class BeliefModel:
    """Fitted constants of the belief.

    log_odds: that nothing is hidden behind a frontier of 1 m with 1 m2 in line of sight; length,
    hidden: added per natural logarithm of the length, m, and of the area in line of sight, m2;
    reliability: weight of the log odds of R; visit: added for each visit that showed nothing.
    area_limits_m2, mean_area_m2: mean hidden area, if there is any, where less than a limit is in
    line of sight; the last one, where more is.
    """

    log_odds: float
    length: float
    hidden: float
    reliability: float
    visit: float
    area_limits_m2: tuple[float, ...]
    mean_area_m2: tuple[float, ...]

    def probability(self, evidence: Evidence, length_m: float, hidden_m2: float) -> float:
        """Probability that nothing worth seeing is behind a frontier; length 0: there is none."""
        if length_m <= 0.0:
            return _CLOSED
        reliability = min(max(evidence.reliability, _R_LIMIT), 1.0 - _R_LIMIT)
        log_odds = (
            self.log_odds
            + self.length * math.log(max(length_m, _SHORTEST_M))
            + self.hidden * math.log(max(hidden_m2, _MIN_M2))
            + self.reliability * math.log(reliability / (1.0 - reliability))
            + self.visit * evidence.visits
        )
        return 1.0 / (1.0 + math.exp(-min(max(log_odds, -_LOG_ODDS_LIMIT), _LOG_ODDS_LIMIT)))

    def mean_area(self, length_m: float, hidden_m2: float) -> float:
        """Mean area, m2, behind a frontier if something is."""
        if length_m <= 0.0:
            return _CLOSED_AREA_M2
        return self.mean_area_m2[bisect.bisect(self.area_limits_m2, hidden_m2)]


class MissingArea(NamedTuple):
    """Free area, m2, that an exploration has not seen: expected, and its 95 % bound."""

    expected_m2: float
    bound_m2: float


def missing_area(probabilities: Array, mean_areas_m2: Array) -> MissingArea:
    """Area behind candidates (N,), by the probability that nothing is behind, and the mean if not.

    Each hides nothing, or an exponentially distributed area.
    """
    expected = float(((1.0 - probabilities) * mean_areas_m2).sum())
    if len(probabilities) == 0:
        return MissingArea(0.0, 0.0)
    rng = np.random.default_rng(0)  # the same for the same candidates
    shape = (_SAMPLES, len(probabilities))
    is_hiding: NDArray[np.bool_] = rng.random(shape) >= probabilities
    areas = np.where(is_hiding, rng.exponential(mean_areas_m2, shape), 0.0).sum(axis=1)
    return MissingArea(expected, float(np.quantile(areas, _CONFIDENCE)))
