"""Evidence of a view for a place in a map, against the other places of the map."""

import math
from typing import NamedTuple

import numpy as np

from thinmap_ros.core.places.recognition.drift import DRIFT, agree
from thinmap_ros.core.places.recognition.piece import MapPiece
from thinmap_ros.core.places.recognition.views import View
from thinmap_ros.core.se2 import Array

# Share of its walls that a view finds again at the right place, in the map of another visit.
# Measured: median 0.80, 5 % quantile 0.54.
_FOUND = 0.8
_FOUND_SIGMA = 0.12
_MIN_KNOWN = 0.3  # share of its walls of which the map must tell
_OTHER_PLACES = 40
_MIN_OTHER_PLACES = 6
_BASIN_M = 0.6  # distance from which a refinement finds a wall
_MAX_STARTS = 3  # to either side


class Evidence(NamedTuple):
    """Log likelihood ratio of a place against other places, and the share of walls found there."""

    log_ratio: float
    found: float


NONE = Evidence(0.0, 0.0)


class ViewJudge:
    """Tells how likely it is that views of another piece were taken at places of a map."""

    def __init__(self, piece: MapPiece, rng: np.random.Generator) -> None:
        self._field = piece.field
        self._rng = rng
        self._elsewhere: dict[int, tuple[float, float] | None] = {}  # by the number of the view

    def evidence(self, view: View, T_map_view: Array) -> Evidence:
        """Evidence of a view for a pose (3,) in the map.

        A view that was taken there finds its walls again. One that was not finds as many as at
        other places of this very map: those are measured for each view.
        """
        found, known = self._field.agreement(view, T_map_view)
        elsewhere = self._found_elsewhere(view)
        if known < _MIN_KNOWN or elsewhere is None:
            return NONE
        mean, sigma = elsewhere
        right = -0.5 * (min(found - _FOUND, 0.0) / _FOUND_SIGMA) ** 2 - math.log(_FOUND_SIGMA)
        wrong = -0.5 * (max(found - mean, 0.0) / sigma) ** 2 - math.log(sigma)
        return Evidence(known * (right - wrong), found)

    def best_near(self, view: View, T_map_view: Array, path_m: float) -> tuple[Array, Evidence]:
        """The best pose (3,) within the drift from a predicted one, and the evidence for it.

        path_m: length of the path over which the pose is predicted.
        """
        starts = _starts(T_map_view, path_m)
        rough, fits = self._field.refined_widely(view, starts)
        T, _, _ = self._field.refined(view, rough[int(fits.argmax())])
        if not agree(T, T_map_view, path_m):
            T = T_map_view
        evidence = self.evidence(view, T)
        if evidence.log_ratio > 0.0:  # the best of several
            log_ratio = max(evidence.log_ratio - math.log(len(starts)), 0.0)
            evidence = evidence._replace(log_ratio=log_ratio)
        return T, evidence

    def _found_elsewhere(self, view: View) -> tuple[float, float] | None:
        """Mean and standard deviation of the share of walls found at random places of the map.

        None if the map tells of too few places.
        """
        if view.number not in self._elsewhere:
            self._elsewhere[view.number] = self._measured(view)
        return self._elsewhere[view.number]

    def _measured(self, view: View) -> tuple[float, float] | None:
        poses, _ = self._field.refined_widely(
            view, self._field.random_poses(_OTHER_PLACES, self._rng)
        )
        shares = [
            found
            for found, known in (self._field.agreement(view, T) for T in poses)
            if known >= _MIN_KNOWN
        ]
        if len(shares) < _MIN_OTHER_PLACES:
            return None
        return float(np.mean(shares)), max(float(np.std(shares)), _FOUND_SIGMA)


def _starts(T: Array, path_m: float) -> Array:
    """Poses (N, 3) from which refinements reach all that drift over a path makes possible."""
    count = min(int(DRIFT.reach_m(path_m) / _BASIN_M), _MAX_STARTS)
    steps = np.arange(-count, count + 1) * _BASIN_M
    x, y = np.meshgrid(steps, steps)
    offsets = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return np.asarray(T + offsets)
