"""Rings round small obstacles are opened: one path round is left, the wider one."""

import heapq
import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import Edge
from thinmap_ros.core.topology.routes.editing import EditedGraph
from thinmap_ros.jit import kernel

Box = tuple[float, float, float, float]  # smallest x and y, largest x and y, m


def open_rings(graph: EditedGraph, known: NDArray[np.bool_], detail_m: float) -> None:
    """Drop the narrowest edge of each ring round an obstacle smaller than detail_m.

    known (H, W): free cells; all others within a ring are the obstacle. The narrowest edges are
    dropped first, so that obstacles with narrow gaps between them become one, and a large one has
    paths round it.
    """
    boxes = {edge.id: _box(edge.path) for edge in graph.map.edges.values()}
    order = sorted(graph.map.edges.values(), key=lambda e: (e.clearance_m, -e.length_m, e.id))
    most = int(detail_m / graph.frame.resolution + 1e-6)
    for edge in order:
        ring = _ring(graph, edge, boxes, detail_m)
        if ring is not None and _enclosed(known, graph.frame.cells_of(ring)) <= most:
            graph.map.drop_edge(edge.id)


def fits(box: Box, side_m: float) -> bool:
    """Whether a box fits into a square of a side."""
    return box[2] - box[0] <= side_m and box[3] - box[1] <= side_m


def _ring(graph: EditedGraph, edge: Edge, boxes: dict[int, Box], detail_m: float) -> Array | None:
    """Points (K, 2) of the shortest ring of an edge and others no narrower; None if it is large.

    An obstacle touches the largest discs round the points of a ring: no ring round a small one has
    a box larger than the obstacle by more than twice the largest clearance.
    """
    nodes = graph.map.nodes
    room_m = max(nodes[edge.a].clearance_m, nodes[edge.b].clearance_m)
    costs = {edge.b: 0.0}
    boxed = {edge.b: (boxes[edge.id], room_m)}
    came_by: dict[int, Edge] = {}
    open_nodes = [(0.0, edge.b)]
    while open_nodes:
        cost, node_id = heapq.heappop(open_nodes)
        if node_id == edge.a:
            return _points(edge, came_by)
        for other in graph.map.edges_at(node_id):
            to = other.other(node_id)
            reached = cost + other.length_m
            if other.id == edge.id or other.clearance_m < edge.clearance_m:
                continue
            box = _joined(boxed[node_id][0], boxes[other.id])
            room_m = max(boxed[node_id][1], nodes[to].clearance_m)
            if reached < costs.get(to, math.inf) and fits(box, detail_m + 2.0 * room_m):
                costs[to] = reached
                boxed[to] = (box, room_m)
                came_by[to] = other
                heapq.heappush(open_nodes, (reached, to))
    return None


def _points(edge: Edge, came_by: dict[int, Edge]) -> Array:
    """Points (K, 2) of an edge and of the edges by which its start was reached from its end."""
    parts = [edge.path]
    node_id = edge.a
    while node_id != edge.b:
        parts.insert(1, came_by[node_id].path_from(node_id)[::-1])
        node_id = came_by[node_id].other(node_id)
    return np.concatenate(parts)


def _box(path: Array) -> Box:
    """The box of a path (K, 2)."""
    low = path.min(axis=0)
    high = path.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _joined(one: Box, other: Box) -> Box:
    low_x = min(one[0], other[0])
    low_y = min(one[1], other[1])
    return low_x, low_y, max(one[2], other[2]), max(one[3], other[3])


@kernel
def _enclosed(known: NDArray[np.bool_], ring: NDArray[np.int64]) -> int:
    """Rows or columns, whichever are more, of the cells within a ring (K, 2) that are not free."""
    crossings = np.empty(len(ring))
    low_row = known.shape[0]
    high_row = -1
    low_col = known.shape[1]
    high_col = -1
    for row in range(ring[:, 0].min(), ring[:, 0].max() + 1):
        count = 0
        for k in range(len(ring)):
            a = ring[k - 1]
            b = ring[k]
            if (a[0] > row) != (b[0] > row):
                crossings[count] = a[1] + (row - a[0]) * (b[1] - a[1]) / (b[0] - a[0])
                count += 1
        ordered = np.sort(crossings[:count])
        for k in range(0, count - 1, 2):
            for col in range(int(math.ceil(ordered[k])), int(ordered[k + 1]) + 1):
                if not known[row, col]:
                    low_row = min(low_row, row)
                    high_row = max(high_row, row)
                    low_col = min(low_col, col)
                    high_col = max(high_col, col)
    return int(max(high_row - low_row, high_col - low_col) + 1)
