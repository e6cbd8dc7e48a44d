"""Landmarks of a topological map: its branch nodes.

They are found again in the map of another visit. Of end and corner nodes a tenth are.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.places.recognition.constellation_kernels import MAX_LENGTH_M
from thinmap_ros.core.places.views import View
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import Node, NodeKind, TopologicalMap


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Landmarks at xy (N, 2), m, with clearances (N,), m."""

    xy: Array
    clearances: Array

    def __len__(self) -> int:
        return len(self.xy)

    def around(self, view: View) -> 'Landmarks':
        """Those within reach of a view of the same piece, in the frame of the view."""
        near = np.hypot(*(self.xy - view.T_piece_view[:2]).T) < MAX_LENGTH_M
        xy = se2.transform_points(se2.invert(view.T_piece_view), self.xy[near])
        return Landmarks(xy, self.clearances[near])


def landmarks_of(graph: TopologicalMap) -> Landmarks:
    """Landmarks of a topological map."""
    return _landmarks(graph.nodes.values())


def landmarks_around(graph: TopologicalMap, view: View) -> Landmarks:
    """Landmarks around a view of the same piece, in its frame; as fast in a large graph."""
    x, y, _ = view.T_piece_view.tolist()
    return _landmarks(graph.nodes_near(x, y, MAX_LENGTH_M)).around(view)


def _landmarks(nodes: Iterable[Node]) -> Landmarks:
    branches = [node for node in nodes if node.kind is NodeKind.BRANCH]
    xy = np.array([node.position for node in branches]).reshape(-1, 2)
    return Landmarks(xy, np.array([node.clearance_m for node in branches]))
