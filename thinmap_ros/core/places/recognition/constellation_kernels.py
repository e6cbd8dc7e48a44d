"""Loops over pairs of landmarks.

A pair has a key that does not depend on where the pair lies: bins of its length, and of the
clearances of both landmarks.
"""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import inlined, kernel

MAX_LENGTH_M = 12.0
_MIN_LENGTH_M = 1.0  # a shorter pair hardly has a direction
_LENGTH_BIN_M = 0.3
_CLEARANCE_BIN_M = 0.2
_CLEARANCE_BINS = 20  # the last one holds all larger clearances
_MAX_POSES = 200_000  # the rarest pairs first: bounds the time of a search

Numbers = NDArray[np.int64]


@inlined
def _length(xy: Array, i: int, j: int) -> float:
    return math.hypot(xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1])


@inlined
def _is_pair(xy: Array, i: int, j: int) -> bool:
    """Whether landmarks i and j determine a pose."""
    return _MIN_LENGTH_M <= _length(xy, i, j) <= MAX_LENGTH_M


@inlined
def _room(clearance: float) -> int:
    """Bin of a clearance in bins."""
    return min(max(int(math.floor(clearance)), 0), _CLEARANCE_BINS - 1)


@inlined
def _key(length: int, first: int, second: int) -> int:
    return (length * _CLEARANCE_BINS + first) * _CLEARANCE_BINS + second


@kernel
def pairs_of(xy: Array, clearances: Array) -> tuple[Numbers, Numbers, Numbers]:
    """Keys (P,) of all ordered pairs of landmarks (N, 2), and the first and second of each (P,).

    clearances (N,): of the landmarks, m.
    """
    keys = [0 for _ in range(0)]
    first = [0 for _ in range(0)]
    second = [0 for _ in range(0)]
    for i in range(len(xy)):
        for j in range(len(xy)):
            if not _is_pair(xy, i, j):
                continue
            length = int(_length(xy, i, j) / _LENGTH_BIN_M)
            one = _room(clearances[i] / _CLEARANCE_BIN_M)
            other = _room(clearances[j] / _CLEARANCE_BIN_M)
            keys.append(_key(length, one, other))
            first.append(i)
            second.append(j)
    return np.array(keys), np.array(first), np.array(second)


@kernel
def _neighbour_keys(xy: Array, clearances: Array, i: int, j: int) -> Numbers:
    """Keys that a pair may have in another map: of its own bins, and of the nearest ones."""
    keys = np.empty(8, dtype=np.int64)
    length = int(math.floor(_length(xy, i, j) / _LENGTH_BIN_M - 0.5))
    one = clearances[i] / _CLEARANCE_BIN_M - 0.5
    other = clearances[j] / _CLEARANCE_BIN_M - 0.5
    for k in range(8):
        keys[k] = _key(length + (k & 1), _room(one + (k >> 1 & 1)), _room(other + (k >> 2)))
    return np.unique(keys)


@kernel
def _matching_pairs(xy: Array, clearances: Array, keys: Numbers) -> Numbers:
    """Rows (L, 4) of each pair of landmarks and of sorted keys that it may have.

    Number of keys that are equal, the first of them, and the two landmarks.
    """
    found = np.empty((64, 4), dtype=np.int64)
    count = 0
    for i in range(len(xy)):
        for j in range(len(xy)):
            if not _is_pair(xy, i, j):
                continue
            for key in _neighbour_keys(xy, clearances, i, j):
                low = np.searchsorted(keys, key)
                high = np.searchsorted(keys, key + 1)
                if high == low:
                    continue
                if count == len(found):
                    found = np.concatenate((found, np.empty_like(found)))
                found[count, 0] = high - low
                found[count, 1] = low
                found[count, 2] = i
                found[count, 3] = j
                count += 1
    return found[:count]


@inlined
def _put_pose(pose: Array, a: Array, b: Array, own_a: Array, own_b: Array) -> None:
    """Pose (3,) of the frame in which two points lie at own_a and own_b, if they are at a and b."""
    line = math.atan2(b[1] - a[1], b[0] - a[0])
    turn = line - math.atan2(own_b[1] - own_a[1], own_b[0] - own_a[0])
    c = math.cos(turn)
    s = math.sin(turn)
    x = 0.5 * (own_a[0] + own_b[0])
    y = 0.5 * (own_a[1] + own_b[1])
    pose[0] = 0.5 * (a[0] + b[0]) - (c * x - s * y)
    pose[1] = 0.5 * (a[1] + b[1]) - (s * x + c * y)
    pose[2] = math.atan2(math.sin(turn), math.cos(turn))


@kernel
def poses_by_pairs(
    own_xy: Array, own_clearances: Array, xy: Array, keys: Numbers, first: Numbers, second: Numbers
) -> tuple[Array, Array]:
    """Poses (N, 3) of a view in a map by pairs of landmarks that may be the same, and weights (N,).

    own_xy (V, 2), own_clearances (V,): landmarks of the view; xy (M, 2): of the map; keys, first,
    second (P,): pairs of the map, sorted by key. Rare pairs come first and have a larger weight.
    """
    lists = _matching_pairs(own_xy, own_clearances, keys)
    total = min(int(lists[:, 0].sum()), _MAX_POSES)
    poses = np.empty((total, 3))
    weights = np.empty(total)
    used = 0
    for k in np.argsort(lists[:, 0], kind='mergesort'):
        size, low, i, j = lists[k]
        for m in range(low, low + size):
            if used >= total:
                break
            _put_pose(poses[used], xy[first[m]], xy[second[m]], own_xy[i], own_xy[j])
            weights[used] = 1.0 / size
            used += 1
    return poses, weights
