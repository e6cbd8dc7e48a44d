"""Few nodes: one for several, and one more where places would not see the nearest."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import Edge
from thinmap_ros.core.topology.routes.editing import EditedGraph
from thinmap_ros.core.topology.routes.rings import fits
from thinmap_ros.core.topology.routes.sight import Sight

Cells = NDArray[np.int64]
_REACH_M = 6.0  # of a place from an edge on which a node may show it
_SPLIT_STEP_M = 0.25  # between the points on edges where nodes may be put


def merge_nodes(graph: EditedGraph, sight: Sight, node_spacing_m: float, detail_m: float) -> None:
    """Let nodes stand for others, as long as as many places see the node nearest to them.

    A node goes, the one with the least clearance first, if a neighbour sees all of its other
    neighbours and can have its edges: one nearer than node_spacing_m or the clearance of either,
    any of two neighbours (a straight edge stays), or the only one where a ring was opened. Both
    paths round an obstacle of detail_m or more stay.
    """
    order = sorted(graph.map.nodes.values(), key=lambda node: (-node.clearance_m, node.id))
    open_ids = dict.fromkeys(node.id for node in order)
    while open_ids:
        number, _ = open_ids.popitem()
        around = graph.map.neighbours(number)
        heir = _heir(graph, number, node_spacing_m, detail_m)
        if heir and sight.drop(graph.map.nodes[number], graph.map):
            _move_edges(graph, number, heir)
            open_ids |= dict.fromkeys(around)


def _heir(graph: EditedGraph, number: int, node_spacing_m: float, detail_m: float) -> int:
    """The nearest neighbour that can have the edges of a node; 0: none."""
    node = graph.map.nodes[number]
    around = [i for i in graph.map.neighbours(number) if i != number]
    is_opened = len(around) == 1 and number not in graph.ends
    is_chain = len(around) == 2 and len(graph.map.edges_at(number)) == 2
    by_distance = sorted((math.dist(node.position, graph.map.nodes[i].position), i) for i in around)
    for away_m, other in by_distance:
        room_m = max(node_spacing_m, node.clearance_m, graph.map.nodes[other].clearance_m)
        if not (is_opened or is_chain or away_m <= room_m):
            continue
        rest = [i for i in around if i != other]
        seen = all(graph.is_clear(graph.cell(i), graph.cell(other)) for i in rest)
        if seen and not _ends_ring(graph, number, other, detail_m):
            return other
    return 0


def _ends_ring(graph: EditedGraph, number: int, heir: int, detail_m: float) -> bool:
    """Whether two paths would become one that are farther apart than detail_m and their room."""
    both = set(graph.map.neighbours(number)) & set(graph.map.neighbours(heir))
    edges = [e for i in (number, heir) for e in graph.map.edges_at(i) if e.other(i) in both]
    clearance_m = min((edge.clearance_m for edge in edges), default=0.0)
    for other in both - {number, heir}:
        corners = np.array([graph.map.nodes[i].position for i in (number, heir, other)])
        low_x, low_y = corners.min(axis=0).tolist()
        high_x, high_y = corners.max(axis=0).tolist()
        if not fits((low_x, low_y, high_x, high_y), detail_m + 2.0 * clearance_m):
            return True
    return False


def _move_edges(graph: EditedGraph, number: int, heir: int) -> None:
    """Drop a node, and lead its edges to another one on straight lines."""
    known = {heir, number, *graph.map.neighbours(heir)}
    moved = {edge.other(number): edge.id for edge in graph.map.edges_at(number)}
    graph.map.drop_node(number)
    for other, edge_id in moved.items():
        if other not in known:
            graph.put_straight(edge_id, heir, other)


class _EdgePoints:
    """Points along straight edges, at which these can be split: cells (N, 2), edge of each."""

    def __init__(self, graph: EditedGraph) -> None:
        cells = [np.empty((0, 2), dtype=np.int64)]
        owners = [np.empty(0, dtype=np.int64)]
        for edge in graph.map.edges.values():
            ends = np.array([graph.map.nodes[i].position for i in (edge.a, edge.b)])
            count = int(math.dist(*ends) / _SPLIT_STEP_M)
            inner = graph.frame.cells_of(np.linspace(ends[0], ends[1], count + 1)[1:-1])
            cells.append(inner.reshape(-1, 2))
            owners.append(np.full(len(inner), edge.id))
        self.cells = np.concatenate(cells)
        self.edges = np.concatenate(owners)
        self._tree = cKDTree(graph.frame.centres_of(self.cells))

    def near(self, xy: Array) -> Cells:
        """Indices of the points within reach of a place (2,), m, the nearest first."""
        found = np.array(self._tree.query_ball_point(xy, _REACH_M), dtype=np.int64)
        away = np.hypot(*(self._tree.data[found] - xy).T)
        return found[np.argsort(away, kind='stable')]

    def split(self, point: int, second: int) -> None:
        """The points behind one belong to another edge now, and it to none."""
        behind = np.flatnonzero(self.edges == self.edges[point])
        self.edges[behind[behind > point]] = second
        self.edges[point] = 0


def show_places(graph: EditedGraph, sight: Sight) -> None:
    """Put nodes on edges from which places are in sight that do not see their nearest node."""
    points = _EdgePoints(graph)
    for place in sight.unseen().tolist():
        if sight.is_seen(place) or not len(points.cells):
            continue
        near = points.near(sight.position(place))
        first = sight.first_seeing(place, points.cells[near])
        edge_id = int(points.edges[near[first]]) if first >= 0 else 0
        if edge_id and _can_split(graph, graph.map.edges[edge_id], points.cells[near[first]]):
            node_id = graph.put_node(graph.frame.centres_of(points.cells[near[first]][None])[0])
            if sight.add(graph.map.nodes[node_id]):
                points.split(int(near[first]), graph.split(graph.map.edges[edge_id], node_id))
            else:
                graph.map.drop_node(node_id)


def _can_split(graph: EditedGraph, edge: Edge, cell: Cells) -> bool:
    at = (int(cell[0]), int(cell[1]))
    return all(graph.is_clear(at, graph.cell(i)) for i in (edge.a, edge.b))
