"""The topological map: nodes and edges with stable ids, and the questions asked of it."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.core.grid.fields import SpatialHash
from thinmap_ros.core.se2 import Array

# Nodes are listed by squares, in which one is looked for up to so far away.
_BUCKET_M = 4.0
_FAR_M = 60.0


class NodeKind(IntEnum):
    """What a node marks.

    The end of an edge, the meeting of three or more, or a bend that an obstacle forces.
    """

    END = 0
    BRANCH = 1
    CORNER = 2


@dataclass(frozen=True)
class Node:
    """A place: x, y in m in the map frame.

    clearance_m: distance to the nearest cell that is not free.
    """

    id: int
    kind: NodeKind
    x: float
    y: float
    clearance_m: float

    @property
    def position(self) -> Array:
        """Place in the map frame, (2,), m."""
        return np.array([self.x, self.y])


@dataclass(frozen=True, eq=False)
class Edge:
    """A passage between the nodes a and b.

    Path (K, 2) in m in the map frame, from a to b through free cells.

    length_m: along the path; clearance_m: smallest distance from the path to a cell that is not
    free.
    """

    id: int
    a: int
    b: int
    path: Array
    length_m: float
    clearance_m: float

    def other(self, node_id: int) -> int:
        """The node at the edge's other end (the same one for a loop)."""
        return self.b if node_id == self.a else self.a

    def path_from(self, node_id: int) -> Array:
        """Path (K, 2) that starts at the given end."""
        return self.path if node_id == self.a else self.path[::-1]


class TopologicalMap:
    """Nodes and edges by id; ids are positive and unique over nodes and edges together.

    Parallel edges and loops are allowed. `nodes` and `edges` are for reading: change the map by its
    methods.
    Source: topological map paper section 2, exploration paper section 2.2.
    """

    def __init__(self, nodes: Iterable[Node] = (), edges: Iterable[Edge] = ()) -> None:
        self.nodes: dict[int, Node] = {}
        self.edges: dict[int, Edge] = {}
        self._edges_at: dict[int, dict[int, None]] = {}
        self._places = SpatialHash(_BUCKET_M)
        try:
            for node in nodes:
                self.put_node(node)
            for edge in edges:
                self.put_edge(edge)
        except (AttributeError, TypeError) as error:
            raise InputError(f'{one_line_reason(error)}: expected nodes and edges') from error

    def __repr__(self) -> str:
        return f'TopologicalMap({len(self.nodes)} nodes, {len(self.edges)} edges)'

    def copy(self) -> 'TopologicalMap':
        """A map of its own with the same nodes and edges."""
        return TopologicalMap(self.nodes.values(), self.edges.values())

    def put_node(self, node: Node) -> None:
        """Add a node, or replace the one with its id.

        Raises InputError where the id is not positive or belongs to an edge.
        """
        if node.id <= 0 or node.id in self.edges:
            raise InputError(f'node id {node.id}: expected a positive number that no edge has')
        self.nodes[node.id] = node
        self._edges_at.setdefault(node.id, {})
        self._places.insert(node.id, node.x, node.y)

    def put_edge(self, edge: Edge) -> None:
        """Add an edge, or replace the one with its id.

        Raises InputError where the id is not positive or belongs to a node, or an end does not
        exist.
        """
        if edge.id <= 0 or edge.id in self.nodes:
            raise InputError(f'edge id {edge.id}: expected a positive number that no node has')
        if edge.a not in self.nodes or edge.b not in self.nodes:
            raise InputError(
                f'edge {edge.id} from node {edge.a} to {edge.b}: expected nodes of the map'
            )
        if edge.id in self.edges:
            self.drop_edge(edge.id)
        self.edges[edge.id] = edge
        self._edges_at[edge.a][edge.id] = None
        self._edges_at[edge.b][edge.id] = None

    def drop_edge(self, edge_id: int) -> None:
        """Remove an edge."""
        edge = self.edges.pop(edge_id)
        self._edges_at[edge.a].pop(edge_id, None)
        self._edges_at[edge.b].pop(edge_id, None)

    def drop_node(self, node_id: int) -> None:
        """Remove a node and the edges at it."""
        for edge_id in list(self._edges_at[node_id]):
            self.drop_edge(edge_id)
        del self.nodes[node_id], self._edges_at[node_id]
        self._places.remove(node_id)

    def edges_at(self, node_id: int) -> list[Edge]:
        """Edges that begin or end at a node; a loop counts once."""
        return [self.edges[i] for i in self._edges_at[node_id]]

    def neighbours(self, node_id: int) -> list[int]:
        """Ids of the nodes one edge away, each once."""
        return list(dict.fromkeys(edge.other(node_id) for edge in self.edges_at(node_id)))

    def nearest_node(self, x: float, y: float) -> Node | None:
        """The node with the smallest straight distance to a point (m, map frame).

        None in an empty map.
        """
        reach = _BUCKET_M
        while reach <= _FAR_M:
            best = min(
                self.nodes_near(x, y, reach),
                key=lambda n: (n.x - x) ** 2 + (n.y - y) ** 2,
                default=None,
            )
            if best is not None and (best.x - x) ** 2 + (best.y - y) ** 2 <= reach**2:
                return best
            reach *= 2.0
        return min(self.nodes.values(), key=lambda n: (n.x - x) ** 2 + (n.y - y) ** 2, default=None)

    def nodes_near(self, x: float, y: float, reach_m: float) -> list[Node]:
        """All nodes within a reach of a point (m, map frame), by id.

        Some that are farther off may be among them.
        """
        return [self.nodes[i] for i in self._places.query_radius(x, y, reach_m)]

    def nearest_edge_point(self, x: float, y: float) -> tuple[int, int, float] | None:
        """Edge id, index into its path, and distance in m, of the path point nearest to a point.

        None without edges.
        """
        best: tuple[int, int, float] | None = None
        for edge in self.edges.values():
            squared = (edge.path[:, 0] - x) ** 2 + (edge.path[:, 1] - y) ** 2
            index = int(squared.argmin())
            distance = float(np.sqrt(squared[index]))
            if best is None or distance < best[2]:
                best = (edge.id, index, distance)
        return best

    def components(self) -> list[set[int]]:
        """Node ids of each connected part, the largest part first."""
        parts: list[set[int]] = []
        left = set(self.nodes)
        while left:
            part: set[int] = set()
            open_ids = [left.pop()]
            while open_ids:
                node_id = open_ids.pop()
                part.add(node_id)
                found = left.intersection(self.neighbours(node_id))
                left -= found
                open_ids.extend(found)
            parts.append(part)
        return sorted(parts, key=len, reverse=True)
