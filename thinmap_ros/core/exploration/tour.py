"""Which of several places to visit first, when all of them have to be visited.

An open tour from where the robot is.

A place that is left out now costs a return later: a tour weighs both, which "the nearest
first" does not. Source: Kulich, Faigl and Preucil, "On distance utility in the exploration task",
2011; Croes, "A method for solving traveling-salesman problems", 1958 (2-opt); Or, 1976 (moving a
piece elsewhere).
"""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import inlined, kernel

Places = NDArray[np.int64]
_ROUNDS = 10


def tours_by_first(
    from_start: Array, between: Array, wait_weights: Array, waiting_horizon_m: float
) -> Array:
    """Cost of a good open tour through all N places for each of them that could come first, (N,).

    The cost is the tour's length, and for each place its weight times the way until it is reached,
    at most waiting_horizon_m: what lies near is better done now, since what comes to light on the
    way may change the tour. from_start (N,): way from the robot to each place; between (N, N): ways
    between them, symmetric; all finite; wait_weights (N,).
    """
    from_start = np.ascontiguousarray(from_start)
    between = np.ascontiguousarray(between)
    count = from_start.size
    return np.array(
        [
            _best_tour(from_start, between, first, wait_weights, waiting_horizon_m)
            for first in range(count)
        ]
    )


@inlined
def _cost(
    order: Places, from_start: Array, between: Array, weights: Array, horizon: float, most: float
) -> float:
    """Cost of a tour; inf as soon as it is at least `most`."""
    along = from_start[order[0]]
    waits = weights[order[0]] * min(along, horizon)
    for k in range(1, order.size):
        along += between[order[k - 1], order[k]]
        waits += weights[order[k]] * min(along, horizon)
        if along + waits >= most:
            return np.inf
    return float(along + waits)


@inlined
def _turn_piece(order: Places, i: int, j: int, tried: Places) -> None:
    """Write the order with the piece from i to j, i < j, the other way round."""
    tried[:] = order
    for k in range(i, j + 1):
        tried[k] = order[i + j - k]


@inlined
def _move(order: Places, i: int, j: int, tried: Places) -> None:
    """Write the order with the place i moved to j."""
    tried[:] = order
    step = 1 if i < j else -1
    for k in range(i, j, step):
        tried[k] = order[k + step]
    tried[j] = order[i]


@kernel
def _best_tour(
    from_start: Array, between: Array, first: int, weights: Array, horizon: float
) -> float:
    """Begin with the nearest next, always.

    Then turn pieces and move places as long as that helps.
    """
    count = from_start.size
    order = np.empty(count, dtype=np.int64)
    tried = np.empty(count, dtype=np.int64)
    _nearest_next(order, first, between)
    best = _cost(order, from_start, between, weights, horizon, np.inf)
    for _ in range(_ROUNDS):
        before = best
        for i in range(1, count):
            for j in range(1, count):
                for moves in (False, True):
                    if i == j or (i > j and not moves):
                        continue
                    if moves:
                        _move(order, i, j, tried)
                    else:
                        _turn_piece(order, i, j, tried)
                    cost = _cost(tried, from_start, between, weights, horizon, best - 1e-9)
                    if cost < best - 1e-9:
                        best = cost
                        order[:] = tried
        if best >= before:
            break
    return best


@kernel
def _nearest_next(order: Places, first: int, between: Array) -> None:
    """Order the places by the nearest-neighbour rule, from a first one."""
    count = order.size
    left = np.ones(count, dtype=np.bool_)
    order[0] = first
    left[first] = False
    for k in range(1, count):
        best = -1
        for i in range(count):
            if left[i] and (best < 0 or between[order[k - 1], i] < between[order[k - 1], best]):
                best = i
        order[k] = best
        left[best] = False
