"""The topological map as values: nodes, edges, and the same as arrays."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import errors
from thinmap_ros.core.config import Config, parameter, robot_radius
from thinmap_ros.core.errors import InputError, one_line_reason, place_of
from thinmap_ros.core.grid.fields import SpatialHash
from thinmap_ros.core.se2 import MAX_COORDINATE_M, Array, Mask

# Nodes are listed by squares, in which one is looked for up to so far away.
_BUCKET_M = 4.0
_FAR_M = 60.0

# Arrays of thinmap_msgs/TopologicalMap.
FIELDS = {
    'node_ids': np.uint32,
    'node_kinds': np.uint8,
    'node_xy': np.float64,
    'node_clearance_m': np.float32,
    'edge_ids': np.uint32,
    'edge_nodes': np.uint32,
    'edge_length_m': np.float32,
    'edge_clearance_m': np.float32,
    'edge_first': np.uint32,
    'edge_xy': np.float32,
}
# Ids of bags of 0.3.0 and before have 64 bits.
_READ = {'node_ids': np.uint64, 'edge_ids': np.uint64}
_PAIRS = ('node_xy', 'edge_nodes')
_POINTS = 'edge_xy'
MAX_ID = 2**32 - 1  # of ids in other messages (EndNode, Region), and in Nav2's route graphs

Flat = dict[str, NDArray[Any]]


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
    return {name: np.asarray(values[name], dtype).ravel() for name, dtype in FIELDS.items()}


def topology_from_msg(message: Any) -> TopologicalMap:
    """Topological map of a thinmap_msgs/TopologicalMap, received or decoded from a bag.

    Positions in m, in the frame of the message's header.

    Raises InputError where fields are missing, lengths of arrays contradict each other, an id is
    out of range or occurs twice, a kind is unknown, an edge has no path or no node, a number is not
    finite, or a length is negative.
    """
    flat = _arrays(message)
    _check_sizes(flat)
    _check_nodes(flat)
    _check_edges(flat)
    return TopologicalMap(_nodes(flat), _edges(flat))


def _nodes(flat: Flat) -> list[Node]:
    names = ('node_ids', 'node_kinds', 'node_xy', 'node_clearance_m')
    columns = (flat[name].tolist() for name in names)
    rows = zip(*columns, strict=True)
    return [
        Node(number, NodeKind(kind), x, y, clearance) for number, kind, (x, y), clearance in rows
    ]


def _edges(flat: Flat) -> list[Edge]:
    ids, lengths, clearances = (
        flat[name].tolist() for name in ('edge_ids', 'edge_length_m', 'edge_clearance_m')
    )
    ends = flat['node_ids'][flat['edge_nodes']].tolist()
    paths = np.split(flat['edge_xy'].astype(np.float64), flat['edge_first'][1:])[: len(ids)]
    rows = zip(ids, ends, paths, lengths, clearances, strict=True)
    return [Edge(number, a, b, path, length, room) for number, (a, b), path, length, room in rows]


def _arrays(message: Any) -> Flat:
    """Arrays of a message by field. Raises InputError where it is of another layout."""
    try:
        return {
            name: np.asarray(getattr(message, name), _READ.get(name, dtype)).ravel()
            for name, dtype in FIELDS.items()
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


def _check_sizes(flat: Flat) -> None:
    """Raise InputError unless the sizes of all arrays fit; then make pairs of what are pairs."""
    for name, values in flat.items():
        owner = name.partition('_')[0]
        count = flat[f'{owner}_ids'].size
        expected = 2 * count if name in _PAIRS else count
        if values.size != expected and name != _POINTS:
            raise InputError(
                f'{name}: {values.size} values for {count} {owner}s: expected {expected}'
            )
    if flat[_POINTS].size % 2:
        raise InputError(f'{_POINTS}: {flat[_POINTS].size} values: expected x, y of each point')
    for name in (*_PAIRS, _POINTS):
        flat[name] = flat[name].reshape(-1, 2)


def _check_nodes(flat: Flat) -> None:
    ids = _checked_ids('node', flat['node_ids'])
    kinds, places, clearances = (flat[f'node_{name}'] for name in ('kinds', 'xy', 'clearance_m'))
    known = [int(kind) for kind in NodeKind]
    for i in _first(~np.isin(kinds, known)):
        raise InputError(f'node {ids[i]}: kind {kinds[i]}: expected one of {known}')
    for i in _first(_is_unbounded(places)):
        errors.require_bounded(f'node {ids[i]}', places[i].tolist())
    for i in _first(_is_no_length(clearances)):
        errors.require_lengths(f'node {ids[i]}: clearance', clearances[[i]].tolist())


def _check_edges(flat: Flat) -> None:
    ids = _checked_ids('edge', flat['edge_ids'])
    count = flat['node_ids'].size
    for i in _first(np.any(flat['edge_nodes'] >= count, axis=1)):
        a, b = flat['edge_nodes'][i].tolist()
        raise InputError(
            f'edge {ids[i]} from node {a} to {b} of {count}, counted from 0: expected nodes of '
            'this map'
        )
    _check_paths(ids, flat['edge_first'].astype(np.int64), flat[_POINTS])
    lengths = np.column_stack([flat['edge_length_m'], flat['edge_clearance_m']])
    for i in _first(np.any(_is_no_length(lengths), axis=1)):
        errors.require_lengths(f'edge {ids[i]}: length, clearance', lengths[i].tolist())


def _check_paths(ids: list[int], begins: NDArray[np.int64], points: NDArray[np.float32]) -> None:
    """Raise InputError unless each edge has some of the points (K, 2), and each point an edge."""
    if not ids and len(points):
        raise InputError(f'{_POINTS}: {len(points)} points for 0 edges: expected none')
    if ids and begins[0] != 0:
        raise InputError(f'edge_first: {begins[0]} of edge {ids[0]}, the first one: expected 0')
    ends = np.append(begins[1:], len(points))
    for i in _first(ends <= begins):
        raise InputError(
            f'edge {ids[i]}: empty path, from point {begins[i]} to before {ends[i]}: expected '
            'points'
        )
    for i in _first(_is_unbounded(points)):
        edge = int(np.searchsorted(begins, i, side='right')) - 1
        errors.require_bounded(f'edge {ids[edge]}', points[i].tolist())


def _checked_ids(what: str, numbers: NDArray[np.uint64]) -> list[int]:
    """List of ids. Raises InputError where one is out of range or occurs twice."""
    ids: list[int] = numbers.tolist()
    for i in _first((numbers < 1) | (numbers > MAX_ID)):
        raise InputError(f'{what} id {ids[i]}: expected 1 to {MAX_ID}')
    errors.require_unique(f'{what}s', ids)
    return ids


def _is_unbounded(places: NDArray[Any]) -> Mask:
    """For each place (K, 2) whether it is not finite or too far away."""
    return np.asarray(np.any(~(np.abs(places) <= MAX_COORDINATE_M), axis=1))


def _is_no_length(lengths: NDArray[Any]) -> Mask:
    return ~((lengths >= 0.0) & (lengths <= MAX_COORDINATE_M))


def _first(bad: Mask) -> list[int]:
    """Index of the first one that is bad; empty where none is."""
    return [int(index) for index in np.flatnonzero(bad)[:1]]


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
