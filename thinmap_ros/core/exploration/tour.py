"""Which of several places to visit first, when all of them have to be visited: an open tour from where the robot is.

A place that is passed over now has to be come back to: a tour weighs both, which "the nearest first" does not.
Source: Kulich, Faigl and Preucil, "On distance utility in the exploration task", 2011; Croes, "A method for solving
traveling-salesman problems", 1958 (2-opt); Or, 1976 (moving a piece elsewhere).
"""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.jit import kernel
from thinmap_ros.core.se2 import Array

_ROUNDS = 20


def tours_by_first(from_start: Array, between: Array) -> Array:
    """Length of a short open tour through all N places for each of them that could come first, (N,).

    from_start (N,): way from the robot to each place; between (N, N): ways between them, symmetric; all finite.
    """
    return np.asarray(_tours_by_first(np.ascontiguousarray(from_start), np.ascontiguousarray(between)))


@kernel
def _tours_by_first(from_start: Array, between: Array) -> Array:
    count = from_start.size
    lengths = np.empty(count)
    order = np.empty(count, dtype=np.int64)
    for first in range(count):
        _nearest_next(order, first, between)
        for _ in range(_ROUNDS):
            if not (_turn_pieces(order, between) or _move_places(order, between)):
                break
        length = from_start[first]
        for k in range(1, count):
            length += between[order[k - 1], order[k]]
        lengths[first] = length
    return lengths


@kernel
def _nearest_next(order: NDArray[np.int64], first: int, between: Array) -> None:
    """Begin with one place and go on to the nearest that is left, always."""
    count = order.size
    left = np.ones(count, dtype=np.bool_)
    order[0], left[first] = first, False
    for k in range(1, count):
        best = -1
        for i in range(count):
            if left[i] and (best < 0 or between[order[k - 1], i] < between[order[k - 1], best]):
                best = i
        order[k], left[best] = best, False


@kernel
def _turn_pieces(order: NDArray[np.int64], between: Array) -> bool:
    """2-opt: turn pieces round where that shortens the tour; the first place stays."""
    count, better = order.size, False
    for i in range(1, count - 1):
        for j in range(i + 1, count):
            gain = between[order[i - 1], order[i]] - between[order[i - 1], order[j]]
            if j + 1 < count:
                gain += between[order[j], order[j + 1]] - between[order[i], order[j + 1]]
            if gain > 1e-9:
                order[i : j + 1] = order[i : j + 1][::-1].copy()
                better = True
    return better


@kernel
def _move_places(order: NDArray[np.int64], between: Array) -> bool:
    """Move single places to where they are less of a detour; the first place stays."""
    count, better = order.size, False
    for i in range(1, count):
        place = order[i]
        saved = between[order[i - 1], place]
        if i + 1 < count:
            saved += between[place, order[i + 1]] - between[order[i - 1], order[i + 1]]
        best, at = saved - 1e-9, -1
        for j in range(count):
            if j == i or j == i - 1:
                continue
            added = between[order[j], place]
            if j + 1 < count:
                added += between[place, order[j + 1]] - between[order[j], order[j + 1]]
            if added < best:
                best, at = added, j
        if at >= 0:
            # order[at] is the place after which it goes.
            if at > i:
                order[i:at] = order[i + 1 : at + 1].copy()
                order[at] = place
            else:
                order[at + 2 : i + 1] = order[at + 1 : i].copy()
                order[at + 1] = place
            better = True
    return better
