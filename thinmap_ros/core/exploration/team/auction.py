"""The auction: who explores what, decided by each robot alone from the claims of all.

Pairs of robot and candidate are formed, the shortest path first, one candidate for each robot. A
robot keeps what it has claimed unless another one is clearly nearer.
Sources: Zlot et al., "Multi-robot exploration controlled by a market economy", 2002; Werger and
Mataric, "Broadcast of local eligibility", 2000.
"""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array

NOTHING = -1
_TIE_M = 0.1  # paths that differ less are equally long


def auction(
    lengths_m: Array, claimed: NDArray[np.int64], told_m: Array, margin_m: float
) -> NDArray[np.int64]:
    """Candidate (R,) that each robot explores, NOTHING where there are fewer candidates.

    lengths_m (R, N): path length from each robot to each candidate, robots in the order in which
    ties are decided; claimed (R,): the candidate that each has claimed, or NOTHING; told_m (R,):
    path length to it of which each has told the others; margin_m: a claimed candidate counts as so
    much nearer.
    """
    robots, count = lengths_m.shape
    bids = np.round(lengths_m / _TIE_M)
    holders = [r for r in range(robots) if _holds(r, claimed, told_m)]
    bids[holders, claimed[holders]] -= margin_m / _TIE_M
    won = np.full(robots, NOTHING, dtype=np.int64)
    for _ in range(min(robots, count)):
        # Of equal bids the first robot's.
        robot, candidate = np.unravel_index(int(bids.argmin()), bids.shape)
        won[robot] = candidate
        bids[robot, :] = np.inf
        bids[:, candidate] = np.inf
    return won


def _holds(robot: int, claimed: NDArray[np.int64], told_m: Array) -> bool:
    """Whether a robot's claim counts: of several on one candidate only that of the nearest robot.

    The nearest by what they have told: each knows its own pose sooner than those of the others, and
    would take itself for the nearest.
    """
    candidate = int(claimed[robot])
    if candidate == NOTHING:
        return False
    rivals = np.flatnonzero(claimed == candidate)
    return int(rivals[told_m[rivals].argmin()]) == robot
