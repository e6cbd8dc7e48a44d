"""The topological map as flat arrays, the fields of thinmap_msgs/TopologicalMap, and back."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import errors
from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap

Flat = dict[str, NDArray[Any]]
Mask = NDArray[np.bool_]

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
_KINDS = {int(kind): kind for kind in NodeKind}
_MAX_ID = 2**32 - 1  # of ids in other messages (EndNode, Region), and in Nav2's route graphs


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
    return [Node(number, _KINDS[kind], x, y, clearance) for number, kind, (x, y), clearance in rows]


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
    for i in _first(~np.isin(kinds, list(_KINDS))):
        raise InputError(f'node {ids[i]}: kind {kinds[i]}: expected one of {list(_KINDS)}')
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
    for i in _first((numbers < 1) | (numbers > _MAX_ID)):
        raise InputError(f'{what} id {ids[i]}: expected 1 to {_MAX_ID}')
    errors.require_unique(f'{what}s', ids)
    return ids


def _is_unbounded(places: NDArray[Any]) -> Mask:
    """For each place (K, 2) whether it is not finite or too far away."""
    is_far: Mask = np.any(~(np.abs(places) <= errors.MAX_COORDINATE_M), axis=1)
    return is_far


def _is_no_length(lengths: NDArray[Any]) -> Mask:
    return ~((lengths >= 0.0) & (lengths <= errors.MAX_COORDINATE_M))


def _first(bad: Mask) -> list[int]:
    """Index of the first one that is bad; empty where none is."""
    return [int(index) for index in np.flatnonzero(bad)[:1]]
