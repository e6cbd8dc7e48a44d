"""A topological map that is edited: straight edges, and new nodes with their clearances."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.free_space import column_distance, squared_clearance
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap
from thinmap_ros.jit import kernel

Mask = NDArray[np.bool_]
_KINDS = (NodeKind.END, NodeKind.END, NodeKind.CORNER)  # by degree; else branch


class EditedGraph:
    """A map, and the cells on which its edges may run.

    ends: ids of the nodes at which the map ended before it was edited.
    """

    def __init__(
        self, topology: TopologicalMap, frame: GridFrame, standing: Mask, known: Mask
    ) -> None:
        """Edit a map: standing (H, W), traversable cells; known (H, W), cells that are free."""
        self.map = topology
        self.frame = frame
        self.standing = standing
        self.ends = {n.id for n in topology.nodes.values() if n.kind is NodeKind.END}
        self._distance = column_distance(known)
        self._next_id = 1 + max([0, *topology.nodes, *topology.edges])

    def cell(self, node_id: int) -> tuple[int, int]:
        """Row and column of a node."""
        row, col = self.frame.cells_of(self.map.nodes[node_id].position)[0].tolist()
        return row, col

    def is_clear(self, a: tuple[int, int], b: tuple[int, int]) -> bool:
        """Whether a robot can drive straight from the centre of a cell to that of another."""
        return bool(is_drivable(self.standing, *a, *b))

    def put_straight(self, edge_id: int, a: int, b: int) -> None:
        """Put a straight edge between two nodes; id 0: a new one."""
        start = self.map.nodes[a].position
        end = self.map.nodes[b].position
        steps = math.ceil(math.dist(start, end) / self.frame.resolution) + 1
        self._put_edge(edge_id or self._new_id(), a, b, np.linspace(start, end, max(steps, 2)))

    def put_node(self, xy: Array) -> int:
        """Put a node at a point (2,), m; returns its id."""
        clearance = float(self._clearances(xy[None])[0])
        node = Node(self._new_id(), NodeKind.CORNER, float(xy[0]), float(xy[1]), clearance)
        self.map.put_node(node)
        return node.id

    def split(self, edge: Edge, node_id: int) -> int:
        """Replace an edge by two straight ones over a node; returns the id of the second one."""
        self.map.drop_edge(edge.id)
        self.put_straight(edge.id, edge.a, node_id)
        self.put_straight(0, node_id, edge.b)
        return self._next_id - 1

    def with_kinds(self) -> TopologicalMap:
        """The map, its nodes with the kinds that they have now."""
        for node in list(self.map.nodes.values()):
            degree = sum(1 + (edge.a == edge.b) for edge in self.map.edges_at(node.id))
            kind = _KINDS[degree] if degree < len(_KINDS) else NodeKind.BRANCH
            self.map.put_node(replace(node, kind=kind))
        return self.map

    def _put_edge(self, edge_id: int, a: int, b: int, path: Array) -> None:
        length = float(np.hypot(*np.diff(path, axis=0).T).sum())
        clearance = float(self._clearances(path).min())
        self.map.put_edge(Edge(edge_id, a, b, path, length, clearance))

    def _clearances(self, points: Array) -> Array:
        squared = squared_clearance(self._distance, self.frame.cells_of(points))
        return np.asarray(np.sqrt(squared) * self.frame.resolution)

    def _new_id(self) -> int:
        self._next_id += 1
        return self._next_id - 1


@kernel
def is_drivable(standing: Mask, row: int, col: int, to_row: int, to_col: int) -> bool:
    """Whether all cells on the straight line between the centres of two cells are traversable.

    standing (H, W): traversable cells. As in the graph, a line over the corner of four cells needs
    none of the two beside it.
    """
    rows = abs(to_row - row)
    cols = abs(to_col - col)
    up = 1 if to_row > row else -1
    right = 1 if to_col > col else -1
    i = 0
    j = 0
    while standing[row + up * i, col + right * j]:
        if i == rows and j == cols:
            return True
        side = (1 + 2 * j) * rows - (1 + 2 * i) * cols
        i += side >= 0
        j += side <= 0
    return False
