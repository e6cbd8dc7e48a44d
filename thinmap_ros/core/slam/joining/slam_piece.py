"""A piece of map that can be joined: keyframes and edges, grid and topological map."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from thinmap_ros.core.grid.edits import Erasure
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.places.piece import MapPiece, drawn_scans
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.topology.graph import TopologicalMap


@dataclass(frozen=True, eq=False)
class SlamPiece:
    """A piece of map.

    edges: between keyframes, by their numbers; without any the piece is rigid. next_id: smallest
    number that no node or edge of the graph has had. erased: parts of which no earlier scan shows
    anything.
    """

    frames: Sequence[Keyframe]
    edges: Sequence[Edge]
    patch: GridPatch
    graph: TopologicalMap
    next_id: int
    erased: Sequence[Erasure] = ()

    @staticmethod
    def of_bare_map(patch: GridPatch, graph: TopologicalMap, next_id: int = 1) -> 'SlamPiece':
        """A rigid piece: the scans of its keyframes are drawn from its grid."""
        frames = [
            Keyframe(
                drawn.scan,
                surface_points(drawn.scan),
                drawn.T_map_base,
                0.0,
                np.zeros((3, 3)),
                submap=0,
            )
            for drawn in drawn_scans(patch, graph)
        ]
        return SlamPiece(
            frames, [], patch, graph, max([next_id - 1, *graph.nodes, *graph.edges]) + 1
        )

    @property
    def is_rigid(self) -> bool:
        """Whether it has no pose graph."""
        return not self.edges

    @cached_property
    def poses(self) -> Array:
        """Poses (N, 3) of the keyframes."""
        return np.array([frame.T_map_base for frame in self.frames]).reshape(-1, 3)

    @cached_property
    def places(self) -> MapPiece:
        """The piece for recognition."""
        return MapPiece(self.frames, self.patch, self.graph)
