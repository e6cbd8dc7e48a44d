"""Topological maps from serialized messages.

rclpy converts a message to Python in one call, in which no other thread runs: the graph of a large
building, or that of a peer that means harm, would stop the commands of a navigator in the same
process. Here other threads run between nodes and edges, and paths are arrays from the beginning.
"""

import struct
from collections.abc import Iterator

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

from thinmap_msgs.msg import TopologicalMap as TopologicalMapMsg
from thinmap_ros.core import validation
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap

_LITTLE_ENDIAN = b'\x00\x01'  # CDR of DDS 1.1, as rmw_fastrtps and rmw_cyclonedds write it
_BIG_ENDIAN = b'\x00\x00'
_ENCAPSULATION = 4  # bytes
_COUNT = struct.Struct('<I')
_ID_KIND = struct.Struct('<IB')
_PLACE = struct.Struct('<dddfI')  # x, y, z, clearance_m, number of feature_ids
_EDGE = struct.Struct('<IIIffI')  # id, ends, length_m, clearance_m, number of points
_MAP_ID = struct.Struct('<Q')
_POINT = np.dtype('<f4')


def read_topology(data: bytes) -> TopologicalMap:
    """Topological map of a serialized thinmap_msgs/TopologicalMap.

    Raises InputError where it is truncated, a kind is unknown, an edge has no node, an id occurs
    twice, a number is not finite, or a length is negative.
    """
    if data[:2] != _LITTLE_ENDIAN:
        return _read_other(data)
    reader = _Reader(memoryview(data)[_ENCAPSULATION:])
    try:
        reader.skip_header()
        nodes = list(reader.nodes())
        edges = list(reader.edges())
        reader.skip_map_id()
    except (struct.error, ValueError) as error:
        raise InputError(f'topology of {len(data)} bytes: {error}: expected a whole one') from error
    _check(nodes, edges)
    return TopologicalMap(nodes, edges)


def topology_from_msg(message: TopologicalMapMsg) -> TopologicalMap:
    """Topological map of a message. Raises InputError as `read_topology`."""
    return read_topology(serialize_message(message))


def _read_other(data: bytes) -> TopologicalMap:
    """Topological map of a message in another encoding."""
    if data[:2] != _BIG_ENDIAN:
        raise InputError(f'topology: encoding {data[:2].hex()}: expected CDR')
    return topology_from_msg(deserialize_message(data, TopologicalMapMsg))


class _Reader:
    """Reads the fields in their order; numbers lie at multiples of their size."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._at = 0

    def skip_header(self) -> None:
        """Skip stamp and frame."""
        self._at = 8
        length = self._count()
        self._at += length

    def nodes(self) -> Iterator[Node]:
        """Yield the nodes. Raises InputError for an unknown kind."""
        for _ in range(self._count()):
            self._align(4)
            number, kind = _ID_KIND.unpack_from(self._data, self._at)
            self._at += _ID_KIND.size
            self._align(8)
            x, y, _, clearance_m, features = _PLACE.unpack_from(self._data, self._at)
            self._at += _PLACE.size + 4 * features
            if kind not in _KINDS:
                raise InputError(f'node {number}: kind {kind}: expected one of {list(_KINDS)}')
            yield Node(number, _KINDS[kind], x, y, clearance_m)

    def edges(self) -> Iterator[Edge]:
        """Yield the edges. Raises InputError for an empty path."""
        for _ in range(self._count()):
            self._align(4)
            number, a, b, length_m, clearance_m, points = _EDGE.unpack_from(self._data, self._at)
            self._at += _EDGE.size
            if points == 0:
                raise InputError(f'edge {number}: empty path: expected points')
            path = np.frombuffer(self._data, _POINT, 3 * points, self._at).reshape(-1, 3)
            self._at += path.nbytes
            yield Edge(number, a, b, path[:, :2].astype(np.float64), length_m, clearance_m)

    def skip_map_id(self) -> None:
        """Skip the id of the map. Raises struct.error where it is missing."""
        self._align(8)
        _MAP_ID.unpack_from(self._data, self._at)

    def _count(self) -> int:
        self._align(4)
        (count,) = _COUNT.unpack_from(self._data, self._at)
        self._at += _COUNT.size
        return int(count)

    def _align(self, size: int) -> None:
        self._at += -self._at % size


_KINDS = {int(kind): kind for kind in NodeKind}


def _check(nodes: list[Node], edges: list[Edge]) -> None:
    validation.require_unique('nodes', [node.id for node in nodes])
    validation.require_unique('edges', [edge.id for edge in edges])
    known = {node.id for node in nodes}
    for node in nodes:
        validation.require_bounded(f'node {node.id}', (node.x, node.y))
        validation.require_lengths(f'node {node.id}: clearance', (node.clearance_m,))
    for edge in edges:
        if edge.a not in known or edge.b not in known:
            raise InputError(
                f'edge {edge.id} from node {edge.a} to {edge.b}: expected nodes of this map'
            )
        lowest_highest = map(float, (edge.path.min(), edge.path.max()))
        validation.require_bounded(f'edge {edge.id}', lowest_highest)
        lengths = (edge.length_m, edge.clearance_m)
        validation.require_lengths(f'edge {edge.id}: length, clearance', lengths)
