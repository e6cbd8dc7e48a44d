"""The topological map as values: nodes, edges, and the same as arrays."""

import heapq
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import errors, snapshot
from thinmap_ros.core.config import Config, parameter, robot_radius
from thinmap_ros.core.errors import InputError, one_line_reason, place_of, quoted
from thinmap_ros.core.grid.fields import SpatialHash
from thinmap_ros.core.se2 import MAX_COORDINATE_M, Array
from thinmap_ros.core.snapshot import Field

Flat = dict[str, NDArray[Any]]

# Nodes are listed by squares, in which one is looked for up to so far away.
_BUCKET_M = 4.0
_FAR_M = 60.0

MAX_ID = 2**32 - 1  # of ids in other messages (EndNode, Region), and in Nav2's route graphs


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
        edges = self.edges
        return [edges[i] for i in self._edges_at[node_id]]

    def kind_at(self, node_id: int) -> NodeKind:
        """Kind of a node by the number of ends of edges there."""
        degree = sum(1 + (edge.a == edge.b) for edge in self.edges_at(node_id))
        if degree == 2:
            return NodeKind.CORNER
        return NodeKind.END if degree < 2 else NodeKind.BRANCH

    def neighbours(self, node_id: int) -> list[int]:
        """Ids of the nodes one edge away, each once."""
        return list(dict.fromkeys([edge.other(node_id) for edge in self.edges_at(node_id)]))

    def nearest_node(
        self, x: float | Sequence[float] | Array, y: float | None = None
    ) -> Node | None:
        """The node with the smallest straight distance to a place (m, map frame).

        It is given as x and y, or as one value (2,). None in an empty map. Raises InputError where
        it is none.
        """
        return self._nearest(*place_of('x, y', x if y is None else (x, y)))

    def _nearest(self, x: float, y: float) -> Node | None:
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

    def nearest_first(
        self, starts: Mapping[int, float], most_m: float = math.inf
    ) -> Iterator[tuple[int, float]]:
        """Nodes that can be reached, and the lengths of the shortest paths to them, m, in order.

        starts: length of the path to each node to begin at; most_m: others are nearer.
        """
        lengths = dict(starts)
        open_nodes = [(length, node_id) for node_id, length in lengths.items()]
        heapq.heapify(open_nodes)
        while open_nodes:
            length, node_id = heapq.heappop(open_nodes)
            if length > lengths[node_id]:
                continue
            yield node_id, length
            for edge in self.edges_at(node_id):
                other = edge.other(node_id)
                if length + edge.length_m < lengths.get(other, most_m):
                    lengths[other] = length + edge.length_m
                    heapq.heappush(open_nodes, (lengths[other], other))

    def components(self) -> list[set[int]]:
        """Node ids of each connected part, the largest part first."""
        parts: list[set[int]] = []
        left = dict.fromkeys(self.nodes)
        while left:
            part = {node_id for node_id, _ in self.nearest_first({next(iter(left)): 0.0})}
            left = {node_id: None for node_id in left if node_id not in part}
            parts.append(part)
        return sorted(parts, key=len, reverse=True)


# Arrays of thinmap_msgs/TopologicalMap: of nodes, of edges, and of the points of all paths.
FIELDS = {
    'node_ids': Field(np.uint32, ('n',), 1, MAX_ID),
    'node_kinds': Field(np.uint8, ('n',), 0, len(NodeKind) - 1),
    'node_xy': Field(np.float64, ('2n',), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'node_clearance_m': Field(np.float32, ('n',), 0.0, MAX_COORDINATE_M),
    'edge_ids': Field(np.uint32, ('e',), 1, MAX_ID),
    'edge_nodes': Field(np.uint32, ('2e',)),
    'edge_length_m': Field(np.float32, ('e',), 0.0, MAX_COORDINATE_M),
    'edge_clearance_m': Field(np.float32, ('e',), 0.0, MAX_COORDINATE_M),
    'edge_first': Field(np.uint32, ('e',)),
    'edge_xy': Field(np.float32, ('2p',), -MAX_COORDINATE_M, MAX_COORDINATE_M),
}
# Ids of bags of 0.3.0 and before have 64 bits.
_READ = FIELDS | {name: replace(FIELDS[name], dtype=np.uint64) for name in ('node_ids', 'edge_ids')}


def flat_topology(topology: TopologicalMap) -> Flat:
    """Arrays of a topological map by field of thinmap_msgs/TopologicalMap."""
    nodes = list(topology.nodes.values())
    edges = list(topology.edges.values())
    places = {node.id: place for place, node in enumerate(nodes)}
    sizes = [len(edge.path) for edge in edges]
    values = {
        'node_ids': [node.id for node in nodes],
        'node_kinds': [node.kind for node in nodes],
        'node_xy': [(node.x, node.y) for node in nodes],
        'node_clearance_m': [node.clearance_m for node in nodes],
        'edge_ids': [edge.id for edge in edges],
        'edge_nodes': [(places[edge.a], places[edge.b]) for edge in edges],
        'edge_length_m': [edge.length_m for edge in edges],
        'edge_clearance_m': [edge.clearance_m for edge in edges],
        'edge_first': np.cumsum(sizes) - sizes,
        'edge_xy': np.concatenate([edge.path for edge in edges]) if edges else (),
    }
    return {name: np.asarray(values[name], field.dtype).ravel() for name, field in FIELDS.items()}


def topology_from_msg(message: Any) -> TopologicalMap:
    """Topological map of a thinmap_msgs/TopologicalMap, received or decoded from a bag.

    Positions in m, in the frame of the message's header.

    Raises InputError where fields are missing, lengths of arrays contradict each other, an id is
    out of range or occurs twice, a kind is unknown, an edge has no path or no node, a number is not
    finite, or a length is negative.
    """
    flat = snapshot.validate_arrays(_arrays(message), _READ, 'topological map')
    node_ids = flat['node_ids'].tolist()
    edge_ids = flat['edge_ids'].tolist()
    errors.require_unique('nodes', node_ids)
    errors.require_unique('edges', edge_ids)
    nodes = zip(
        node_ids,
        flat['node_kinds'].tolist(),
        flat['node_xy'].reshape(-1, 2).tolist(),
        flat['node_clearance_m'].tolist(),
        strict=True,
    )
    edges = zip(
        edge_ids,
        _ends_of(flat),
        _paths_of(flat),
        flat['edge_length_m'].tolist(),
        flat['edge_clearance_m'].tolist(),
        strict=True,
    )
    return TopologicalMap(
        [Node(number, NodeKind(kind), x, y, room) for number, kind, (x, y), room in nodes],
        [
            Edge(number, node_ids[a], node_ids[b], path, length, room)
            for number, (a, b), path, length, room in edges
        ],
    )


def _arrays(message: Any) -> Flat:
    """Arrays of a message by field. Raises InputError where it is of another layout."""
    try:
        return {
            name: np.asarray(getattr(message, name), field.dtype).ravel()
            for name, field in _READ.items()
        }
    except AttributeError as error:
        raise InputError(
            f'topological map without {error.name}: expected the flat arrays of '
            'thinmap_msgs/TopologicalMap: is it of another version?'
        ) from error
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f'topological map: {one_line_reason(error)}: expected flat arrays'
        ) from error


def _ends_of(flat: Flat) -> list[list[int]]:
    """Indices of the two nodes of each edge."""
    ends = flat['edge_nodes'].reshape(-1, 2)
    count = flat['node_ids'].size
    for edge in np.flatnonzero(np.any(ends >= count, axis=1)).tolist():
        a, b = ends[edge].tolist()
        raise InputError(
            f'edge {flat["edge_ids"][edge]} from node {a} to {b} of {count}, counted from 0: '
            'expected nodes of this map'
        )
    return ends.tolist()


def _paths_of(flat: Flat) -> list[Array]:
    """Path (K, 2) of each edge."""
    points = flat['edge_xy'].astype(np.float64).reshape(-1, 2)
    first = flat['edge_first'].astype(np.int64)
    sizes = np.diff(first, append=len(points))
    if np.any(sizes < 1) or sizes.sum() != len(points):
        raise InputError(
            f'edge_first: {quoted(first.tolist())} of {len(points)} points: expected the first one '
            'of each edge, and one or more for each'
        )
    return np.split(points, first[1:])[: len(first)]


@dataclass(frozen=True)
class TopologyConfig(Config):
    """What counts as free, which branches of the skeleton count, and how local maps are merged."""

    robot_radius_m: float = robot_radius()
    max_unknown_gap_m: float = parameter(
        0.2,
        'Unknown gaps between free cells up to this width count as free (m). Raise it for a laser '
        'with few beams, lower it to keep small unknown regions.',
        low=0.0,
        high=2.0,
    )
    seed_search_radius_m: float = parameter(
        1.5,
        'Largest distance from the robot to the free space that is thinned (m). Raise it if the '
        'graph stays empty where the robot starts beside obstacles.',
        low=0.0,
        high=20.0,
    )
    min_branch_length_m: float = parameter(
        0.6,
        'Shorter branches of the skeleton are pruned (m). Raise it for fewer end nodes, lower it '
        'to keep niches.',
        low=0.0,
        high=10.0,
    )
    min_branch_ratio: float = parameter(
        0.5,
        'Smallest length of a branch towards a known wall, relative to the clearance at its base. '
        'Raise it for fewer end nodes in corners.',
        low=0.0,
        high=5.0,
    )
