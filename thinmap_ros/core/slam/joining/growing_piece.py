"""A piece of map that grows keyframe by keyframe, with all that recognition needs of it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.places.piece import SAME_M, Landmarks, MapPiece, landmarks_around
from thinmap_ros.core.places.views import View, ViewBuilder
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import TopologyBuilder

# Coarser than the map: recognition compares pieces, and nobody sees them.
_CELL_M = 0.1


class GrowingPiece:
    """Keyframes in the frame of the first of them, with their grid, graph and views.

    numbers: of the keyframes in the pose graph.
    """

    def __init__(self) -> None:
        self.numbers: list[int] = []
        self.frames: list[Keyframe] = []
        self.views: list[View] = []
        self._origin = np.zeros(3)
        self._grid = OccupancyGrid(OccupancyConfig(resolution_m=_CELL_M))
        self._topology = TopologyBuilder(TopologyConfig())
        self._views = ViewBuilder()

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def path_m(self) -> float:
        """Length of the path, m."""
        return self.frames[-1].path_m - self.frames[0].path_m if self.frames else 0.0

    def add(self, number: int, frame: Keyframe) -> None:
        """Add a keyframe of the pose graph; it is left out where it fits into no map."""
        if not self.frames:
            self._origin = frame.T_map_base
        own = replace(frame, T_map_base=se2.between(self._origin, frame.T_map_base))
        try:
            self._grid.add_scan(own.scan, own.T_map_base)
        except InputError:
            return
        self.numbers.append(number)
        self.frames.append(own)
        changes = self._grid.take_changes()
        if changes is not None:
            self._topology.update(changes, own.T_map_base)
        self.views += self._views.add(own)

    def end_path(self) -> None:
        """Make the views at the end of the path, after the last keyframe."""
        self.views += self._views.finish()

    def map_piece(self) -> MapPiece:
        """The piece as it is now."""
        return MapPiece(self.frames, self._grid.known_area(), self._topology.map, self.views)

    def landmarks(self, view: View) -> Landmarks:
        """Landmarks around a view of this piece."""
        return landmarks_around(self._topology.map, view)

    def is_bent(self, frames: Sequence[Keyframe]) -> bool:
        """Whether a correction has moved its keyframes relative to each other since they came.

        frames: of the pose graph.
        """
        if not self.frames:
            return False
        poses = np.array([frames[number].T_map_base for number in self.numbers])
        own = np.array([frame.T_map_base for frame in self.frames])
        moved = np.array([se2.between(poses[0], T) for T in poses])
        return bool(np.hypot(*(moved - own)[:, :2].T).max() > SAME_M)
