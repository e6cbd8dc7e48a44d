"""A* on the topological map, between any two points.

Source: topological map paper section 3.2: the length of the edges is the cost of a path.
"""

import heapq
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.errors import InputError, require_type
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import Edge, TopologicalMap


@dataclass(frozen=True)
class Route:
    """A path along edges: the nodes in order, the edges between them, and its length in m."""

    node_ids: tuple[int, ...]
    edge_ids: tuple[int, ...]
    cost_m: float


def shortest_path(topology: TopologicalMap, start_id: int, goal_id: int) -> Route | None:
    """Shortest route between two nodes, by A*; None if no edges connect them.

    Raises InputError where the graph has no such node.
    """
    require_type('topology', topology, TopologicalMap)
    for node_id in (start_id, goal_id):
        require_type('node', node_id, int)
        if node_id not in topology.nodes:
            raise InputError(f'node {node_id}: expected a node of {topology!r}')
    goal = topology.nodes[goal_id]
    return shortest_route(topology, {start_id: 0.0}, {goal_id: 0.0}, (goal.x, goal.y))


def shortest_route(
    topology: TopologicalMap,
    starts: Mapping[int, float],
    goals: Mapping[int, float],
    goal_xy: tuple[float, float],
    avoided: Collection[int] = (),
) -> Route | None:
    """Shortest route from a point to another, by A*; None if no edges connect them.

    starts, goals: length of the path from each node to the point at this end, m. avoided: ids of
    edges that the route must not use.
    The heuristic is the straight distance to the goal. It is admissible because no edge is shorter
    than the distance between its nodes.
    """
    reached_by: dict[int, tuple[int, int]] = {}
    costs = dict(starts)
    open_nodes = [(cost + _away(topology, i, goal_xy), i) for i, cost in costs.items()]
    heapq.heapify(open_nodes)
    closed: set[int] = set()
    last_id = 0
    best_m = np.inf
    while open_nodes:
        at_least_m, node_id = heapq.heappop(open_nodes)
        if at_least_m >= best_m:
            break
        if node_id in closed:
            continue
        closed.add(node_id)
        total_m = costs[node_id] + goals.get(node_id, np.inf)
        if total_m < best_m:
            best_m = total_m
            last_id = node_id
        for edge in topology.edges_at(node_id):
            other = edge.other(node_id)
            cost = costs[node_id] + edge.length_m
            if edge.id not in avoided and cost < costs.get(other, np.inf):
                costs[other] = cost
                reached_by[other] = (node_id, edge.id)
                heapq.heappush(open_nodes, (cost + _away(topology, other, goal_xy), other))
    return _route(last_id, reached_by, best_m) if last_id else None


def path_lengths_to_nodes(topology: TopologicalMap, x: float, y: float) -> dict[int, float]:
    """Length of the shortest path from a point (m, map frame) to every reachable node, m."""
    costs = _lengths_to_next_nodes(topology, x, y)
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


def _lengths_to_next_nodes(topology: TopologicalMap, x: float, y: float) -> dict[int, float]:
    """Length to each node of the edge that is nearest to a point, or to a node that is nearer, m.

    Empty if the map is.
    """
    found = topology.nearest_edge_point(x, y)
    node = topology.nearest_node(x, y)
    if node is None:
        return {}
    to_node = ((node.x - x) ** 2 + (node.y - y) ** 2) ** 0.5
    if found is None or to_node < found[2] - 1e-9:
        return {node.id: to_node}
    edge_id, index, approach = found
    edge = topology.edges[edge_id]
    along = _along(edge)
    ends: dict[int, float] = {}
    for node_id, length in ((edge.a, along[index]), (edge.b, along[-1] - along[index])):
        ends[node_id] = min(ends.get(node_id, np.inf), approach + float(length))
    return ends


def path_points(topology: TopologicalMap, route: Route) -> Array:
    """Points (K, 2) of a route from its first to its last node, m, map frame, no duplicates."""
    first = topology.nodes[route.node_ids[0]]
    parts = [np.array([[first.x, first.y]])]
    for node_id, edge_id in zip(route.node_ids, route.edge_ids, strict=False):
        parts.append(_leaving(topology.edges[edge_id], node_id)[1:])
    return np.concatenate(parts)


def _leaving(edge: Edge, node_id: int) -> Array:
    return edge.path if node_id == edge.a else edge.path[::-1]


def _along(edge: Edge) -> Array:
    """Length of the path from its start to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(edge.path, axis=0).T))])


def _away(topology: TopologicalMap, node_id: int, xy: tuple[float, float]) -> float:
    """Straight distance from a node to a point, m."""
    node = topology.nodes[node_id]
    return math.hypot(node.x - xy[0], node.y - xy[1])


def _route(last_id: int, reached_by: dict[int, tuple[int, int]], cost: float) -> Route:
    nodes = [last_id]
    edges = []
    while nodes[-1] in reached_by:
        node_id, edge_id = reached_by[nodes[-1]]
        nodes.append(node_id)
        edges.append(edge_id)
    return Route(tuple(nodes[::-1]), tuple(edges[::-1]), cost)
