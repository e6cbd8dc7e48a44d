"""Paths in a map: in a window near by, along the topological map far away."""

import heapq
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.errors import InputError, require_type
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.planning.grid_search import path_collides
from thinmap_ros.core.planning.wavefront import (
    Obstacles,
    WavefrontConfig,
    find_path,
    start_escape_m,
)
from thinmap_ros.core.se2 import Array, Cells, Mask, Place, lengths_along, path_length
from thinmap_ros.core.topology.graph import Edge, TopologicalMap, TopologyConfig
from thinmap_ros.jit import kernel

_GAP_M = TopologyConfig().max_unknown_gap_m

# Of the window in which a short path is planned.
_ROOM_M = 3.0  # around start and goal
_ROOM_SHARE = 0.5  # of the distance between them, in addition
_MAX_SHARE = 0.5  # of the map: a larger window saves nothing

# Straight distance from which the wavefront in a band costs less than the wavefront alone.
LONG_PATH_M = 20.0
_BAND_M = 3.0  # half of its width: wide enough for the shortest path through most halls
_ACCESS_M = 8.0  # the same around both ends: from a room to the corridor beside it
# How many of the path points nearest to an end are tried, and one of how many of these is: they are
# a cell apart.
_TRIED = 2000
_STRIDE = 8
_MAX_ROUTES = 6  # that are tried, each without the contradicted edges of those before


def plan_short_path(
    patch: GridPatch,
    start_xy: Place,
    goal_xy: Place,
    config: WavefrontConfig,
    obstacles: Obstacles | None,
    trail: Cells,
) -> Array | None:
    """Path (K, 2) from start to goal, m, map frame; None: no path.

    It is planned in a window of the map, so that the cost does not grow with the map. The window
    holds start and goal with some room around. A path that leaves it is at least as long as the way
    to the rim and on to the goal; a cheaper one in the window is the best of the whole map. In all
    other cases the wavefront plans on the whole map.
    obstacles: points that the map need not contain; trail: cells (N, 2) of the recent path.
    """
    window = _window(patch, start_xy, goal_xy, config, obstacles)
    if window is not None:
        part, bound_m = window
        moved = trail - patch.offset_of(part)
        inside = moved[np.all((moved >= 0) & (moved < part.shape), axis=1)]
        found = find_path(part, start_xy, goal_xy, config, obstacles, inside)
        if found is not None and found.is_exact and found.cost_m <= bound_m:
            return found.points
    found = find_path(patch, start_xy, goal_xy, config, obstacles, trail)
    return None if found is None else found.points


def _window(
    patch: GridPatch,
    start_xy: Place,
    goal_xy: Place,
    config: WavefrontConfig,
    obstacles: Obstacles | None,
) -> tuple[GridPatch, float] | None:
    """Window around start and goal, and the least length of a path that leaves it, m.

    None where it is no smaller than most of the map.
    """
    resolution = patch.frame.resolution
    ends = patch.frame.cells_of(np.array([start_xy, goal_xy]))
    shape = np.array(patch.shape)
    if np.any(ends < 0) or np.any(ends >= shape):
        return None
    rim = _rim_cells(resolution, config, obstacles)
    room_m = _ROOM_M + _ROOM_SHARE * math.dist(start_xy, goal_xy)
    room = rim + math.ceil(room_m / resolution)
    low = np.maximum(ends.min(axis=0) - room, 0)
    high = np.minimum(ends.max(axis=0) + room + 1, shape)
    if np.prod(high - low) > _MAX_SHARE * np.prod(shape):
        return None
    bound_m = _least_detour(ends, low + rim, high - 1 - rim, low > 0, high < shape) * resolution
    part = patch.part((*low.tolist(), *high.tolist()))
    return GridPatch(part.frame, np.ascontiguousarray(part.cells)), bound_m


def _least_detour(
    ends: Cells, low: Cells, high: Cells, opens_below: Mask, opens_above: Mask
) -> float:
    """Least length, cells, of a path between two cells (2, 2) over the rim of a window.

    low, high (2,): rows and columns of the rim; opens_below, opens_above (2,): whether the map
    continues beyond it.
    """
    lengths = [math.inf]
    for axis in (0, 1):
        along = float(np.ptp(ends[:, 1 - axis]))
        if opens_below[axis]:
            lengths.append(math.hypot(along, float((ends[:, axis] - low[axis]).sum())))
        if opens_above[axis]:
            lengths.append(math.hypot(along, float((high[axis] - ends[:, axis]).sum())))
    return min(lengths)


def _rim_cells(resolution: float, config: WavefrontConfig, obstacles: Obstacles | None) -> int:
    """Cells at the rim whose cost may differ from that in the map."""
    reach_m = max(config.inflation_radius_m, start_escape_m(config.robot_radius_m))
    if obstacles is not None:
        reach_m = max(reach_m, obstacles.radius_m)
    return math.ceil((reach_m + _GAP_M) / resolution) + 1


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
    goal_xy: Place | Array,
    avoided: Collection[int] = (),
) -> Route | None:
    """Shortest route from a point to another, by A*; None if no edges connect them.

    starts, goals: length of the path from each node to the point at this end, m. avoided: ids of
    edges that the route must not use.
    The heuristic is the straight distance to the goal. It is admissible because no edge is shorter
    than the distance between its nodes.
    Source: topological map paper section 3.2: the length of the edges is the cost of a path.
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
    return _walked(last_id, reached_by, best_m) if last_id else None


def path_lengths_to_nodes(topology: TopologicalMap, x: float, y: float) -> dict[int, float]:
    """Length of the shortest path from a point (m, map frame) to every reachable node, m."""
    return dict(topology.nearest_first(_lengths_to_next_nodes(topology, x, y)))


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
    along = lengths_along(edge.path)
    ends: dict[int, float] = {}
    for node_id, length in ((edge.a, along[index]), (edge.b, along[-1] - along[index])):
        ends[node_id] = min(ends.get(node_id, np.inf), approach + float(length))
    return ends


def _away(topology: TopologicalMap, node_id: int, xy: Place | Array) -> float:
    """Straight distance from a node to a point, m."""
    node = topology.nodes[node_id]
    return math.hypot(node.x - xy[0], node.y - xy[1])


def _walked(last_id: int, reached_by: dict[int, tuple[int, int]], cost: float) -> Route:
    nodes = [last_id]
    edges = []
    while nodes[-1] in reached_by:
        node_id, edge_id = reached_by[nodes[-1]]
        nodes.append(node_id)
        edges.append(edge_id)
    return Route(tuple(nodes[::-1]), tuple(edges[::-1]), cost)


@dataclass(frozen=True, eq=False)
class Band:
    """The part of a map in which a path is looked for, and those of its cells (H, W) that count."""

    patch: GridPatch
    cells: Mask


def route_band(
    topology: TopologicalMap,
    patch: GridPatch,
    start_xy: Place,
    goal_xy: Place,
    config: WavefrontConfig,
    obstacles: Obstacles | None = None,
) -> Band | None:
    """The band around the shortest route on the graph from start to goal (m, map frame).

    A* on the graph finds the route of a long path, from the nearest edge in sight of the start to
    that of the goal; the wavefront finds the path along it: the wave spreads only in the band. It
    is wider around both ends, where the best path may begin in another direction. Edges that the
    grid or scan points contradict are left out. None if the graph does not connect start and goal,
    or not by edges that the grid confirms: the wavefront plans alone then, as for goals that are
    near.
    Source: topological map paper section 3.2.
    """
    ends = np.array([start_xy, goal_xy])
    edges = dict(topology.edges) if patch.contains(ends).all() else {}
    for _ in range(_MAX_ROUTES):
        route = _route(topology, patch, ends, edges)
        closed = [i for i, path in route if not _is_drivable(path, patch, config, obstacles)]
        if not closed:
            return _band(patch, [path for _, path in route], ends, config) if route else None
        for edge_id in closed:
            edges.pop(edge_id, None)
    return None


def _route(
    topology: TopologicalMap, patch: GridPatch, ends: Array, edges: Mapping[int, Edge]
) -> list[tuple[int, Array]]:
    """Edges of the shortest route between two points (2, 2), each with the part (K, 2) driven.

    edges: those that it may use. Empty without a route.
    """
    start, goal = (_entry(patch, xy, edges) for xy in ends)
    if start is None or goal is None:
        return []
    first, begin = start
    last, end = goal
    starts = _parts_from(first, begin)
    goals = _parts_from(last, end)
    avoided = topology.edges.keys() - edges.keys()
    route = shortest_route(topology, _lengths(starts), _lengths(goals), ends[1], avoided)
    if first is last:
        direct = first.path[min(begin, end) : max(begin, end) + 1]
        if route is None or path_length(direct) <= route.cost_m:
            return [(first.id, direct)]
    if route is None:
        return []
    ends_of = [(first.id, starts[route.node_ids[0]]), (last.id, goals[route.node_ids[-1]])]
    return ends_of + [(i, edges[i].path) for i in route.edge_ids]


def _entry(patch: GridPatch, xy: Array, edges: Mapping[int, Edge]) -> tuple[Edge, int] | None:
    """The edge with the nearest point in sight of a place (2,), and the index of that point."""
    points = np.concatenate([np.empty((0, 2)), *(edge.path for edge in edges.values())])
    firsts = np.cumsum([0, *(len(edge.path) for edge in edges.values())])
    cells = patch.frame.cells_of(points)
    row, col = patch.frame.cells_of(xy[None])[0].tolist()
    passable = ~patch.occupied
    for k in np.argsort(np.hypot(*(points - xy).T))[:_TRIED:_STRIDE].tolist():
        if line_is_clear(passable, row, col, *cells[k].tolist()):
            number = int(np.searchsorted(firsts, k, side='right')) - 1
            return list(edges.values())[number], k - int(firsts[number])
    return None


def _parts_from(edge: Edge, index: int) -> dict[int, Array]:
    """The parts of an edge's path from one of its points, by the node at the end of each."""
    back = edge.path[index::-1]
    ahead = edge.path[index:]
    if edge.a == edge.b:
        return {edge.a: min(back, ahead, key=len)}
    return {edge.a: back, edge.b: ahead}


def _lengths(paths: Mapping[int, Array]) -> dict[int, float]:
    return {i: path_length(path) for i, path in paths.items()}


def _is_drivable(
    path: Array, patch: GridPatch, config: WavefrontConfig, obstacles: Obstacles | None
) -> bool:
    """Whether a path (K, 2) keeps its distance from occupied cells and scan points."""
    if path_collides(patch, path, config.robot_radius_m):
        return False
    if obstacles is None or not len(obstacles.points):
        return True
    away = np.hypot(*(path[:, None] - obstacles.points).transpose(2, 0, 1))
    return not bool((away < obstacles.radius_m).any())


def _band(patch: GridPatch, route: list[Array], ends: Array, config: WavefrontConfig) -> Band:
    """Cells within _BAND_M of a route and of the ways to it, and within _ACCESS_M of its ends."""
    resolution = patch.frame.resolution
    points = np.concatenate(route)
    nearest = points[[np.hypot(*(points - end).T).argmin() for end in ends]]
    steps = math.ceil(np.hypot(*(nearest - ends).T).max() / _BAND_M) + 1
    ways = np.linspace(ends, nearest, steps).reshape(-1, 2)
    at = patch.frame.cells_of(np.concatenate([points, ways]))
    # The costs of its cells depend on obstacles beside the band.
    beside_m = max(config.inflation_radius_m, config.robot_radius_m)
    margin = math.ceil((_ACCESS_M + beside_m) / resolution) + 1
    low = np.maximum(at.min(axis=0) - margin, 0)
    high = np.minimum(at.max(axis=0) + margin + 1, patch.shape)
    part = patch.part((*low.tolist(), *high.tolist()))
    cells = np.zeros(part.shape, dtype=np.bool_)
    _paint_discs(cells, at - low, _BAND_M / resolution)
    for end in patch.frame.cells_of(ends) - low:
        _paint_discs(cells, end[None], _ACCESS_M / resolution)
    return Band(part, cells)


@kernel
def _paint_discs(cells: Mask, centres: Cells, radius: float) -> None:
    """Mark the cells (H, W) within a radius, cells, of a path of cells (K, 2).

    Discs lie a third of their radius apart.
    """
    reach = int(radius)
    last_row = -1000000
    last_col = -1000000
    for k in range(centres.shape[0]):
        row = centres[k, 0]
        col = centres[k, 1]
        moved = max(abs(row - last_row), abs(col - last_col))
        if 3 * moved < radius and k < centres.shape[0] - 1:
            continue
        last_row = row
        last_col = col
        for r in range(max(row - reach, 0), min(row + reach + 1, cells.shape[0])):
            half = int(math.sqrt(radius * radius - (r - row) ** 2))
            for c in range(max(col - half, 0), min(col + half + 1, cells.shape[1])):
                cells[r, c] = True
