"""Bytes of a topological map and of a grid map of the same place."""

from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.graph import TopologicalMap

# Little-endian, without padding, with the types of thinmap_msgs; places are float32 as in a path.
_NODE = np.dtype([('id', '<u4'), ('kind', 'u1'), ('xy', '<f4', 2), ('clearance', '<f4')])
_EDGE = np.dtype([('id', '<u4'), ('ends', '<u4', 2), ('length', '<f4'), ('clearance', '<f4')])
_PLACE = np.dtype(('<f4', 2))
_COUNT = np.dtype('<u4')


def graph_in_bytes(graph: TopologicalMap, with_paths: bool) -> bytes:
    """What a robot needs to plan on a topological map.

    A node has 17 bytes: id, kind, x, y, clearance. An edge has 20: id, ids of its nodes, length,
    smallest clearance. with_paths: a count of 4 bytes and the x and y, 8 bytes, of each place of
    its path follow.
    """
    nodes = [(node.id, node.kind, node.position, node.clearance_m) for node in graph.nodes.values()]
    edges = [
        (edge.id, (edge.a, edge.b), edge.length_m, edge.clearance_m)
        for edge in graph.edges.values()
    ]
    parts = [np.array(nodes, dtype=_NODE).tobytes(), np.array(edges, dtype=_EDGE).tobytes()]
    if with_paths:
        for edge in graph.edges.values():
            parts.append(np.array(len(edge.path), dtype=_COUNT).tobytes())
            parts.append(edge.path.astype(_PLACE.base).tobytes())
    return b''.join(parts)


def grid_in_bytes(patch: GridPatch) -> bytes:
    """Cells, a byte each as in nav_msgs/OccupancyGrid, of the smallest rectangle with all known."""
    return _known_cells(patch).tobytes()


def grid_as_png(patch: GridPatch) -> bytes:
    """The same cells as a PNG image of 8 bit."""
    from PIL import Image  # imported here: most processes never write a map

    stream = BytesIO()
    Image.fromarray(_known_cells(patch).view(np.uint8)).save(stream, 'PNG', optimize=True)
    return stream.getvalue()


def _known_cells(patch: GridPatch) -> NDArray[np.int8]:
    known = np.argwhere(patch.cells >= 0)
    if not len(known):
        raise InputError('map without known cells: it has no size')
    low = known.min(axis=0)
    high = known.max(axis=0) + 1
    return np.ascontiguousarray(patch.trinary()[low[0] : high[0], low[1] : high[1]])
