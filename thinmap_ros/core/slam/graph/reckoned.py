"""Whether a piece of map that is apart lies where dead reckoning has it.

Each match of the piece with the map, near where dead reckoning has both, is a look. It lies near
that place if the robot is there, and anywhere in the search if it is elsewhere.
"""

import math
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.se2 import Array, propagated_covariance
from thinmap_ros.core.slam.graph.pose_graph import Edge

# Log odds with which a piece returns to the map: one look at a place that is alike is too little.
RETURNS = 8.0
# Of the points of a look that the map contradicts, where the robot is elsewhere.
CONTRARY_RATIO = 0.1

_FITS_HERE = 0.5  # share of looks that fit, in a crowd or after a change
_FITS_ELSEWHERE = 0.2  # and somewhere within the search, wherever the robot is
_ALIGNED = 0.3  # share of these with the same heading: walls are parallel all over a building
_CAREFUL = 0.05  # share of looks that fit elsewhere in the search though the robot is here
_MOST_OF_A_LOOK = 6.0  # nats, as of a view in recognition
_LATE_M = 8.0  # of path, within which a kidnapped robot is noticed
_LOOK_M = 1.0  # looks nearer to each other count once, by the best
_CONTRARY = math.log(0.2 / 0.5)  # share of looks that contradict the map here, and elsewhere

# By which the errors of both maps grow beyond the covariance of dead reckoning, m, m, rad.
_GROWN = np.array([0.1, 0.1, 0.03])
_GROWN_PER_M = np.array([0.01, 0.01, 0.001])


@dataclass(frozen=True, eq=False)
class Search:
    """How far a look has searched to either side, m and rad."""

    reach_m: float
    reach_rad: float


@dataclass(frozen=True, eq=False)
class _Look:
    """A look from a place (2,), m; log_ratio: of here to elsewhere; edge: its match, or None."""

    place: Array
    log_ratio: float
    edge: Edge | None


def look_log_ratio(off: Array, covariance: Array, search: Search) -> float:
    """Log likelihood ratio, of here to elsewhere, of a match that is off (3,) dead reckoning.

    covariance (3, 3): of dead reckoning and of the match.
    """
    density = math.exp(-0.5 * float(off @ np.linalg.solve(covariance, off)))
    density /= math.sqrt((2.0 * math.pi) ** 3 * float(np.linalg.det(covariance)))
    turn = math.exp(-0.5 * float(off[2]) ** 2 / float(covariance[2, 2]))
    turn /= math.sqrt(2.0 * math.pi * float(covariance[2, 2]))
    elsewhere = 1.0 - _ALIGNED + _ALIGNED * turn * 2.0 * search.reach_rad
    volume = 4.0 * search.reach_m**2 * 2.0 * search.reach_rad  # of all poses that were searched
    likelihood = (1.0 - _CAREFUL) * density * volume / elsewhere + _CAREFUL
    return min(math.log(_FITS_HERE / _FITS_ELSEWHERE * likelihood), _MOST_OF_A_LOOK)


class Reckoned:
    """Log odds that a piece lies where dead reckoning has it, from those with which it began.

    Each place counts once, by its best look.
    """

    def __init__(
        self, log_odds: float, T_map_base: Array, covariance: Array, path_m: float
    ) -> None:
        """log_odds: at the pose (3,) with covariance (3, 3), map frame, where the piece begins.

        path_m: length of the path up to there.
        """
        self._prior = min(log_odds, 0.0)  # a piece that begins is never sure of its place
        self._begin_m = path_m
        self._begin = T_map_base
        self._covariance = covariance
        self._looks: list[_Look] = []

    @property
    def edges(self) -> list[Edge]:
        """The matches that speak for it."""
        return [look.edge for look in self._looks if look.edge is not None and look.log_ratio > 0.0]

    @property
    def log_odds(self) -> float:
        """Log odds of here to elsewhere."""
        return self._prior + sum(look.log_ratio for look in self._looks)

    def within(self, outer: 'Reckoned') -> 'Reckoned':
        """Of a piece that begins in another one that is apart: either may be elsewhere."""
        log_odds = -float(np.logaddexp(-outer.log_odds, -self._prior))
        covariance = outer._covariance_at(self._begin[:2]) + self._covariance
        return Reckoned(log_odds, self._begin, covariance, self._begin_m)

    def is_told_by(self, path_m: float) -> bool:
        """Whether a keyframe of the map at some length of the path, m, tells anything.

        Those just before the piece begins may be of the place of the piece: it was noticed late.
        """
        return path_m <= self._begin_m - min(_LATE_M, 0.5 * self._begin_m)

    def has_looked_from(self, place: Array) -> bool:
        """Whether a look from near a place (2,), m, is counted already."""
        return bool(self._near(place))

    def add_contrary(self, place: Array) -> None:
        """Add a look from a place (2,), m, that finds nothing of the map, and contradicts it."""
        self._count(_Look(place, _CONTRARY, None))

    def add(self, place: Array, edge: Edge, off: Array, own: Array, search: Search) -> None:
        """Add a match from a place (2,), m, off (3,) with covariance `own` (3, 3), map frame."""
        expected = self._covariance_at(place) + own
        self._count(_Look(place, look_log_ratio(off, expected, search), edge))

    def _count(self, look: _Look) -> None:
        """Keep a look instead of those near it that tell less; none if one of these tells more."""
        near = self._near(look.place)
        if all(each.log_ratio <= look.log_ratio for each in near):
            self._looks = [each for each in self._looks if each not in near]
            self._looks.append(look)

    def _near(self, place: Array) -> list[_Look]:
        return [each for each in self._looks if math.dist(each.place, place) < _LOOK_M]

    def _covariance_at(self, place: Array) -> Array:
        """Covariance (3, 3) of the piece at a place (2,), m, that lies away from its beginning.

        By the distance and not by the path: the loops of a piece are closed.
        """
        from_begin = place - self._begin[:2]
        carried = propagated_covariance(self._covariance, from_begin)
        grown = np.diag(np.square(_GROWN + _GROWN_PER_M * math.hypot(*from_begin)))
        return np.asarray(carried + grown)
