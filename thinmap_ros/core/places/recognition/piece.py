"""A piece of map: its keyframes, grid and topological map, and what recognition needs of them."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.places.recognition.constellations import ConstellationIndex
from thinmap_ros.core.places.recognition.drift import are_same
from thinmap_ros.core.places.recognition.landmarks import Landmarks, landmarks_of
from thinmap_ros.core.places.views import PlacedScan, View, views_of
from thinmap_ros.core.places.wall_field import WallField
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap


class MapPiece:
    """A piece of map in which views of another one are looked for, or whose views these are.

    What the search needs is made when it is first used; it does not change with the piece.
    """

    def __init__(
        self,
        keyframes: Sequence[PlacedScan],
        patch: GridPatch,
        graph: TopologicalMap,
        views: list[View] | None = None,
    ) -> None:
        """keyframes: in the order of the path; all in the frame of the piece.

        views: along the keyframes, if they are made already.
        """
        self.keyframes = keyframes
        self._views = views
        self.patch = patch
        self.graph = graph

    @property
    def free_area_m2(self) -> float:
        """Area of the free cells."""
        return float(np.count_nonzero(self.patch.free)) * self.patch.frame.resolution**2

    @cached_property
    def field(self) -> WallField:
        """Distances to its walls."""
        poses = np.array([frame.T_map_base for frame in self.keyframes]).reshape(-1, 3)
        return WallField(self.patch, poses[:, :2])

    @cached_property
    def landmarks(self) -> Landmarks:
        """Branch nodes of its topological map."""
        return landmarks_of(self.graph)

    @cached_property
    def index(self) -> ConstellationIndex:
        """Pairs of its landmarks."""
        return ConstellationIndex(self.landmarks)

    @cached_property
    def views(self) -> list[View]:
        """Views along its keyframes."""
        return views_of(self.keyframes) if self._views is None else self._views

    def find(self, view: View, landmarks: Landmarks, count: int) -> Array:
        """The best places, distinct poses (N, 3), of a view of another piece with its landmarks."""
        poses = self.index.candidates(landmarks)
        if not len(poses):
            return poses
        rough, fits = self.field.refined_widely(view, poses)
        kept = _distinct(rough[np.argsort(-fits, kind='stable')], count)
        return np.array([self.field.refined(view, T)[0] for T in kept])


def _distinct(poses: Array, count: int) -> Array:
    """The first poses (N, 3) that differ from all before them."""
    kept = poses[:0]
    for T in poses:
        if not are_same(kept, T).any():
            kept = np.vstack([kept, T])
        if len(kept) == count:
            break
    return kept
