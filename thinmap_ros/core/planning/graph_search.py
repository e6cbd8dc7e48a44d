"""A* on the topological map, between any two points.

Source: topological map paper section 3.2: the length of the edges is the cost of a path.
"""

import heapq
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import Edge, TopologicalMap


@dataclass(frozen=True)
class Route:
    """A path along edges: the nodes in order, the edges between them, and its length in m."""

    node_ids: tuple[int, ...]
    edge_ids: tuple[int, ...]
    cost_m: float


@dataclass(frozen=True)
class GraphAccess:
    """Where a point connects to the graph: the nearest edge and index into its path, or a node.

    approach_m: straight distance from the point to the graph; to_node_m: distance from the point,
    by this connection, to each node.
    """

    edge_id: int | None
    index: int
    approach_m: float
    to_node_m: dict[int, float]


def shortest_path(topology: TopologicalMap, start_id: int, goal_id: int) -> Route | None:
    """Shortest route between two nodes, by A*; None if no edges connect them.

    The heuristic is the straight distance to the goal. It is admissible because no edge is shorter
    than the distance between its nodes.
    """
    goal = topology.nodes[goal_id]
    reached_by: dict[int, tuple[int, int]] = {}
    costs = {start_id: 0.0}
    open_nodes = [(0.0, start_id)]
    closed: set[int] = set()
    while open_nodes:
        _, node_id = heapq.heappop(open_nodes)
        if node_id == goal_id:
            return _route(start_id, goal_id, reached_by, costs[goal_id])
        if node_id in closed:
            continue
        closed.add(node_id)
        for edge in topology.edges_at(node_id):
            other = edge.other(node_id)
            cost = costs[node_id] + edge.length_m
            if cost < costs.get(other, np.inf):
                costs[other] = cost
                reached_by[other] = (node_id, edge.id)
                there = topology.nodes[other]
                rest = ((there.x - goal.x) ** 2 + (there.y - goal.y) ** 2) ** 0.5
                heapq.heappush(open_nodes, (cost + rest, other))
    return None


def access(topology: TopologicalMap, x: float, y: float) -> GraphAccess | None:
    """How a point (m, map frame) connects to the graph; None if the map is empty."""
    found = topology.nearest_edge_point(x, y)
    node = topology.nearest_node(x, y)
    if node is None:
        return None
    to_node = ((node.x - x) ** 2 + (node.y - y) ** 2) ** 0.5
    if found is None or to_node < found[2] - 1e-9:
        return GraphAccess(None, 0, to_node, {node.id: to_node})
    edge_id, index, approach = found
    edge = topology.edges[edge_id]
    along = _along(edge)
    ends: dict[int, float] = {}
    for node_id, length in ((edge.a, along[index]), (edge.b, along[-1] - along[index])):
        ends[node_id] = min(ends.get(node_id, np.inf), approach + float(length))
    return GraphAccess(edge_id, index, approach, ends)


def path_lengths_to_nodes(topology: TopologicalMap, x: float, y: float) -> dict[int, float]:
    """Length of the shortest path from a point (m, map frame) to every reachable node, m."""
    start = access(topology, x, y)
    if start is None:
        return {}
    costs = dict(start.to_node_m)
    open_nodes = [(cost, node_id) for node_id, cost in costs.items()]
    heapq.heapify(open_nodes)
    closed: set[int] = set()
    while open_nodes:
        cost, node_id = heapq.heappop(open_nodes)
        if node_id in closed:
            continue
        closed.add(node_id)
        for edge in topology.edges_at(node_id):
            other = edge.other(node_id)
            if cost + edge.length_m < costs.get(other, np.inf):
                costs[other] = cost + edge.length_m
                heapq.heappush(open_nodes, (costs[other], other))
    return costs


def path_lengths_to_goals(
    topology: TopologicalMap, from_pose: Array, goals: dict[int, Array]
) -> dict[int, float]:
    """Length of the shortest path on the graph from a pose to each reachable goal (x, y, ...), m.

    The id of a goal is that of its node, if the map has this node.
    """
    to_nodes = path_lengths_to_nodes(topology, float(from_pose[0]), float(from_pose[1]))
    costs = {}
    for goal_id, goal in goals.items():
        x = float(goal[0])
        y = float(goal[1])
        joins = None if goal_id in topology.nodes else access(topology, x, y)
        ends = {goal_id: 0.0} if joins is None else joins.to_node_m
        lengths = [to_nodes[i] + rest for i, rest in ends.items() if i in to_nodes]
        if lengths:
            costs[goal_id] = min(lengths)
    return costs


def path_points(topology: TopologicalMap, route: Route) -> Array:
    """Points (K, 2) of a route from its first to its last node, m, map frame, no duplicates."""
    first = topology.nodes[route.node_ids[0]]
    parts = [np.array([[first.x, first.y]])]
    for node_id, edge_id in zip(route.node_ids, route.edge_ids, strict=False):
        parts.append(_leaving(topology.edges[edge_id], node_id)[1:])
    return np.concatenate(parts)


def route_path(
    topology: TopologicalMap, start_xy: tuple[float, float], goal_xy: tuple[float, float]
) -> Array | None:
    """Path (K, 2) along edges between any two points, m, map frame.

    It leads straight from each point to the nearest edge. None if the map is empty or does not
    connect the points.
    """
    start = access(topology, *start_xy)
    goal = access(topology, *goal_xy)
    if start is None or goal is None:
        return None
    best: tuple[float, Array] | None = None
    for cost, points in _candidate_paths(topology, start, goal):
        if best is None or cost < best[0]:
            best = (cost, points)
    if best is None:
        return None
    return np.concatenate([[start_xy], best[1], [goal_xy]])


def _candidate_paths(
    topology: TopologicalMap, start: GraphAccess, goal: GraphAccess
) -> Iterator[tuple[float, Array]]:
    """Length and points of a path for each pair of nodes at the start and the goal.

    Also the path along a common edge.
    """
    if start.edge_id is not None and start.edge_id == goal.edge_id:
        edge = topology.edges[start.edge_id]
        piece = _piece(edge, start.index, goal.index)
        yield start.approach_m + goal.approach_m + _length(piece), piece
    for a, to_a in start.to_node_m.items():
        for b, to_b in goal.to_node_m.items():
            route = shortest_path(topology, a, b)
            if route is not None:
                parts = [
                    _to_node(topology, start, a),
                    path_points(topology, route),
                    _to_node(topology, goal, b)[::-1],
                ]
                yield to_a + route.cost_m + to_b, np.concatenate(parts)


def _to_node(topology: TopologicalMap, point: GraphAccess, node_id: int) -> Array:
    """Path points from a connection on an edge to one of its nodes, without the node."""
    if point.edge_id is None:
        return np.empty((0, 2))
    edge = topology.edges[point.edge_id]
    last = 0 if node_id == edge.a else len(edge.path) - 1
    if edge.a == edge.b and point.index > len(edge.path) // 2:
        last = len(edge.path) - 1
    return _piece(edge, point.index, last)[:-1]


def _piece(edge: Edge, first: int, last: int) -> Array:
    """Path points from one index to another, both included, in that order."""
    return edge.path[first : last + 1] if first <= last else edge.path[last : first + 1][::-1]


def _leaving(edge: Edge, node_id: int) -> Array:
    return edge.path if node_id == edge.a else edge.path[::-1]


def _along(edge: Edge) -> Array:
    """Length of the path from its start to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(edge.path, axis=0).T))])


def _length(points: Array) -> float:
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


def _route(
    start_id: int, goal_id: int, reached_by: dict[int, tuple[int, int]], cost: float
) -> Route:
    nodes = [goal_id]
    edges = []
    while nodes[-1] != start_id:
        node_id, edge_id = reached_by[nodes[-1]]
        nodes.append(node_id)
        edges.append(edge_id)
    return Route(tuple(nodes[::-1]), tuple(edges[::-1]), cost)
