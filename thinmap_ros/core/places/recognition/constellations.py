"""Pose candidates of a view by constellations: pairs of landmarks, of which each gives a pose."""

import math

import numpy as np

from thinmap_ros.core.places.recognition import constellation_kernels
from thinmap_ros.core.places.recognition.drift import SAME_M, SAME_RAD
from thinmap_ros.core.places.recognition.landmarks import Landmarks
from thinmap_ros.core.se2 import Array, wrap

_HEADING_BINS = math.ceil(2.0 * math.pi / SAME_RAD)
_CANDIDATES = 60


class ConstellationIndex:
    """Pairs of the landmarks of a map, sorted by what does not depend on where they lie."""

    def __init__(self, landmarks: Landmarks) -> None:
        self._landmarks = landmarks
        keys, first, second = constellation_kernels.pairs_of(landmarks.xy, landmarks.clearances)
        order = np.argsort(keys, kind='stable')
        self._keys = keys[order]
        self._first = first[order]
        self._second = second[order]

    def __len__(self) -> int:
        return len(self._keys)

    def candidates(self, own: Landmarks) -> Array:
        """Poses (N, 3) in the map of a view with landmarks of its own, the likeliest first."""
        poses, weights = constellation_kernels.poses_by_pairs(
            own.xy,
            own.clearances,
            self._landmarks.xy,
            self._keys,
            self._first,
            self._second,
        )
        return _peaks(poses, weights) if len(poses) else poses


def _peaks(poses: Array, weights: Array) -> Array:
    """Weighted means (N, 3) of the bins of poses that have the most votes with their neighbours."""
    votes, means = _counted(poses, weights)
    kept = np.empty((0, 3))
    for T in means[np.argsort(-votes, kind='stable')]:
        off = np.abs(kept - T)
        turn = np.abs(wrap(off[:, 2])) * _HEADING_BINS / (2.0 * math.pi)
        if np.any((off[:, :2].max(axis=1) <= SAME_M) & (turn <= 2.0)):
            continue
        kept = np.vstack([kept, T])
        if len(kept) == _CANDIDATES:
            break
    return kept


def _counted(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Votes (B,) of each bin and its 26 neighbours, and weighted mean poses (B, 3) of the bins."""
    cells = np.floor(poses[:, :2] / SAME_M).astype(np.int64)
    cells -= cells.min(axis=0) - 1
    turns = np.floor((poses[:, 2] / (2.0 * math.pi) + 0.5) * _HEADING_BINS).astype(np.int64)
    width, height = (cells.max(axis=0) + 2).tolist()
    layer = width * height
    keys = turns % _HEADING_BINS * layer + cells[:, 1] * width + cells[:, 0]
    bins, owner = np.unique(keys, return_inverse=True)
    own = np.bincount(owner, weights)
    columns = [poses[:, 0], poses[:, 1], np.cos(poses[:, 2]), np.sin(poses[:, 2])]
    x, y, cos, sin = (np.bincount(owner, weights * column) / own for column in columns)
    votes = np.zeros(len(bins))
    for turn in (-1, 0, 1):
        beside = (bins // layer + turn) % _HEADING_BINS * layer + bins % layer
        for offset in (dy * width + dx for dy in (-1, 0, 1) for dx in (-1, 0, 1)):
            at = np.minimum(np.searchsorted(bins, beside + offset), len(bins) - 1)
            votes += np.where(bins[at] == beside + offset, own[at], 0.0)
    return votes, np.column_stack([x, y, np.arctan2(sin, cos)])
