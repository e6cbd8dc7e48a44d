"""Which poses are the same: near each other, or as far apart as maps drift over a path."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array

# A view tells poses farther apart from each other.
SAME_M = 0.5
SAME_RAD = 0.1


@dataclass(frozen=True)
class Drift:
    """Standard deviations of the relative pose of two maps: of a match, and per metre of path."""

    match_m: float = 0.15
    match_rad: float = 0.02
    path_m: float = 0.02
    path_rad: float = 0.003
    sigmas: float = 3.0

    def reach_m(self, path_m: float) -> float:
        """Largest difference of a position, m."""
        return self.sigmas * (self.match_m + self.path_m * path_m)

    def reach_rad(self, path_m: float) -> float:
        """Largest difference of a heading, rad."""
        return self.sigmas * (self.match_rad + self.path_rad * path_m)


DRIFT = Drift()


def agree(T: Array, T_predicted: Array, path_m: float) -> bool:
    """Whether a pose (3,) is one that was predicted over a path."""
    x, y, turn = se2.between(T_predicted, T).tolist()
    return math.hypot(x, y) < DRIFT.reach_m(path_m) and abs(turn) < DRIFT.reach_rad(path_m)


def are_same(poses: Array, T: Array) -> NDArray[np.bool_]:
    """Which poses (N, 3) a view does not tell from another one, (3,) or (N, 3)."""
    off = np.abs(poses - T)
    is_near = off[:, :2].max(axis=1) <= SAME_M
    return np.asarray(is_near & (np.abs(se2.wrap(off[:, 2])) <= SAME_RAD))
