"""How the places of a map have moved: each as the pose nearest to it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array


@dataclass(frozen=True, eq=False)
class MapMotion:
    """Poses (N >= 1, 3) of places in a map, before and after it was moved or bent."""

    before: Array
    after: Array

    @staticmethod
    def rigid(T: Array) -> 'MapMotion':
        """The motion of a map whose frame comes to a pose (3,)."""
        return MapMotion(np.zeros((1, 3)), T[None])

    def moved(self, points: Array) -> Array:
        """Where points (M, 2) of the map are afterwards."""
        return _transformed(self._forward[_nearest(self.before, points)], points)

    def undone(self, points: Array, moved_as: NDArray[np.int64]) -> Array:
        """Where points (M, 2) were before; moved_as (M,): the pose as which each was moved."""
        return _transformed(self._backward[moved_as], points)

    def nearest_after(self, points: Array) -> NDArray[np.int64]:
        """The pose nearest to each of the points (M, 2) afterwards, (M,)."""
        return _nearest(self.after, points)

    @cached_property
    def _forward(self) -> Array:
        pairs = zip(self.before, self.after, strict=True)
        return np.array([se2.compose(after, se2.invert(before)) for before, after in pairs])

    @cached_property
    def _backward(self) -> Array:
        return np.array([se2.invert(T) for T in self._forward])


def _nearest(poses: Array, points: Array) -> NDArray[np.int64]:
    if len(poses) == 1:
        return np.zeros(len(points), dtype=np.int64)
    # Imported here: maps that do not bend need no tree.
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(poses[:, :2]).query(points)[1], dtype=np.int64)


def _transformed(poses: Array, points: Array) -> Array:
    """Points (M, 2), each by a pose of its own (M, 3)."""
    c = np.cos(poses[:, 2])
    s = np.sin(poses[:, 2])
    x = poses[:, 0] + c * points[:, 0] - s * points[:, 1]
    y = poses[:, 1] + s * points[:, 0] + c * points[:, 1]
    return np.column_stack([x, y])
