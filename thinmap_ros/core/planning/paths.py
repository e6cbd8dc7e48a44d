"""Paths in a map: in a window near by, along the topological map far away."""

import heapq
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.errors import InputError, require_type
from thinmap_ros.core.grid.fields import nearest_true
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.grid_search import distance_field_from, path_collides
from thinmap_ros.core.planning.wavefront import (
    Obstacles,
    WavefrontConfig,
    cost_of_cells,
    find_path,
    start_escape_m,
)
from thinmap_ros.core.se2 import Array, Cells, Mask, Place, lengths_along, path_length
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.jit import kernel

_GAP_M = TopologyConfig().max_unknown_gap_m

# Of the window in which a short path is planned.
_ROOM_M = 3.0  # around start and goal
_ROOM_SHARE = 0.5  # of the distance between them, in addition
_MAX_SHARE = 0.5  # of the map: a larger window saves nothing

# Straight distance from which the wavefront in a band costs less than the wavefront alone.
LONG_PATH_M = 20.0
_BAND_M = 3.0  # half of its width: wide enough for the shortest path through most halls
_ACCESS_M = 6.0  # the graph is looked for so far from either end; in halls twice that, and so on
_MAX_ROUTES = 6  # that are tried, each without the contradicted edges of those before


@dataclass(frozen=True, eq=False)
class _Window:
    """Part of a map; row, col: its first cell; bound_m: least length of a path that leaves it."""

    patch: GridPatch
    row: int
    col: int
    bound_m: float

    def cells(self, cells: Cells) -> Cells:
        """Those of the map's cells (N, 2) that lie in the window, as its own cells (M, 2)."""
        moved = cells - (self.row, self.col)
        return moved[np.all((moved >= 0) & (moved < self.patch.shape), axis=1)]


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
        inside = window.cells(trail)
        found = find_path(window.patch, start_xy, goal_xy, config, obstacles, inside)
        if found is not None and found.is_exact and found.cost_m <= window.bound_m:
            return found.points
    found = find_path(patch, start_xy, goal_xy, config, obstacles, trail)
    return None if found is None else found.points


def _window(
    patch: GridPatch,
    start_xy: Place,
    goal_xy: Place,
    config: WavefrontConfig,
    obstacles: Obstacles | None,
) -> _Window | None:
    """Window around start and goal; None where it is no smaller than most of the map."""
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
    row, col = (int(first) for first in low)
    cells = np.ascontiguousarray(patch.cells[row : high[0], col : high[1]])
    bound_m = _least_detour(ends, low + rim, high - 1 - rim, low > 0, high < shape) * resolution
    return _Window(GridPatch(patch.frame.with_origin_at(row, col), cells), row, col, bound_m)


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
    goal_xy: tuple[float, float],
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
    along = lengths_along(edge.path)
    ends: dict[int, float] = {}
    for node_id, length in ((edge.a, along[index]), (edge.b, along[-1] - along[index])):
        ends[node_id] = min(ends.get(node_id, np.inf), approach + float(length))
    return ends


def path_points(topology: TopologicalMap, route: Route) -> Array:
    """Points (K, 2) of a route from its first to its last node, m, map frame, no duplicates."""
    first = topology.nodes[route.node_ids[0]]
    parts = [np.array([[first.x, first.y]])]
    for node_id, edge_id in zip(route.node_ids, route.edge_ids, strict=False):
        parts.append(topology.edges[edge_id].path_from(node_id)[1:])
    return np.concatenate(parts)


def _away(topology: TopologicalMap, node_id: int, xy: tuple[float, float]) -> float:
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


@dataclass(frozen=True, eq=False)
class _Approach:
    """A path from a point to a node: along an edge from one of its path points.

    length_m: to the node; path (K, 2): the part of the edge.
    """

    node_id: int
    length_m: float
    path: Array


@dataclass(frozen=True, eq=False)
class _Entry:
    """The point of an edge's path that is nearest to a point over traversable cells."""

    edge_id: int
    index: int
    length_m: float


@dataclass(frozen=True, eq=False)
class _Surroundings:
    """Path lengths, m, to the cells (H, W) around a point; row, col: of the first cell."""

    row: int
    col: int
    lengths_m: Array


class _Checked:
    """A topological map, and what the grid and scan points say about its edges."""

    def __init__(
        self,
        topology: TopologicalMap,
        patch: GridPatch,
        config: WavefrontConfig,
        obstacles: Obstacles | None,
    ) -> None:
        self.topology = topology
        self.patch = patch
        self.config = config
        self._obstacles = obstacles
        edges = list(topology.edges.values())
        self._points = np.concatenate([edge.path for edge in edges])
        self._ids = np.array([edge.id for edge in edges])
        self._ends = np.cumsum([len(edge.path) for edge in edges])

    def is_drivable(self, path: Array) -> bool:
        """Whether a path (K, 2) keeps its distance from occupied cells and scan points."""
        if path_collides(self.patch, path, self.config.robot_radius_m):
            return False
        if self._obstacles is None or self._obstacles.points.size == 0:
            return True
        radius_m = self._obstacles.radius_m
        points = self._obstacles.points
        low = points.min(axis=0) - radius_m
        near = path[((path >= low) & (path <= points.max(axis=0) + radius_m)).all(axis=1)]
        away = np.hypot(*(near[:, None] - points[None]).transpose(2, 0, 1))
        return not bool((away < radius_m).any())

    def entries(self, around: _Surroundings) -> list[_Entry]:
        """Where each edge that passes through the surroundings of a point is entered."""
        cells = self.patch.frame.cells_of(self._points) - (around.row, around.col)
        inside = ((cells >= 0) & (cells < around.lengths_m.shape)).all(axis=1)
        at = np.flatnonzero(inside)
        lengths = around.lengths_m[cells[at, 0], cells[at, 1]]
        order = np.lexsort((lengths, np.searchsorted(self._ends, at, side='right')))
        edges, first = np.unique(
            np.searchsorted(self._ends, at[order], side='right'), return_index=True
        )
        found = []
        for edge, k in zip(edges.tolist(), order[first].tolist(), strict=True):
            if math.isfinite(lengths[k]):
                begin = int(self._ends[edge - 1]) if edge else 0
                index = int(at[k]) - begin
                found.append(_Entry(int(self._ids[edge]), index, float(lengths[k])))
        return found

    def approaches(self, entries: list[_Entry]) -> dict[int, _Approach]:
        """The shortest approach to each node at the edges that are entered."""
        best: dict[int, _Approach] = {}
        for entry in entries:
            edge = self.topology.edges[entry.edge_id]
            back = edge.path[entry.index :: -1]
            for node_id, path in ((edge.a, back), (edge.b, edge.path[entry.index :])):
                length_m = entry.length_m + path_length(path)
                known = best.get(node_id)
                if (known is None or length_m < known.length_m) and self.is_drivable(path):
                    best[node_id] = _Approach(node_id, length_m, path)
        return best


def route_band(
    topology: TopologicalMap,
    patch: GridPatch,
    start_xy: Place,
    goal_xy: Place,
    config: WavefrontConfig,
    obstacles: Obstacles | None = None,
) -> Band | None:
    """The band around the shortest route on the graph from start to goal (m, map frame).

    A* on the graph finds the route of a long path, the wavefront the path along it: the wave
    spreads only in the band. Its first and last part lead from the robot to the graph and from the
    graph to the goal: the cells there are found on the grid. Edges that the grid or scan points
    contradict are left out. None if the graph does not connect start and goal, or not by edges that
    the grid confirms: the wavefront plans alone then, as for goals that are near.
    Source: topological map paper section 3.2.
    """
    if not topology.edges or not patch.contains(np.array([start_xy, goal_xy])).all():
        return None
    checked = _Checked(topology, patch, config, obstacles)
    ends = []
    for xy, reach_m in (
        (start_xy, start_escape_m(config.robot_radius_m)),
        (goal_xy, config.goal_search_radius_m),
    ):
        entrance = _entrance(checked, xy, reach_m)
        if entrance is None:
            return None
        ends.append(entrance)
    route = _route(checked, ends[0][1], ends[1][1], goal_xy)
    if route is None:
        return None
    path, first_m, last_m = route
    access = [(ends[0][0], first_m), (ends[1][0], last_m)]
    return _band(patch, np.concatenate([[start_xy], path, [goal_xy]]), access, config)


def _entrance(
    checked: _Checked, xy: Place, reach_m: float
) -> tuple[_Surroundings, list[_Entry]] | None:
    """The smallest surroundings of a point through which edges pass, and where these are entered.

    None if the point, or a traversable cell within reach_m, has no path to any edge.
    """
    patch = checked.patch
    size = math.ceil(_ACCESS_M / patch.frame.resolution)
    while True:
        around = _surroundings(patch, xy, reach_m, size, checked.config)
        if around is None:
            return None
        entries = checked.entries(around)
        if entries:
            return around, entries
        if around.lengths_m.shape == patch.shape:
            return None
        size *= 2


def _surroundings(
    patch: GridPatch, xy: Place, reach_m: float, size: int, config: WavefrontConfig
) -> _Surroundings | None:
    """Path lengths within `size` cells of a point, or of the nearest traversable cell in reach."""
    resolution = patch.frame.resolution
    row, col = patch.frame.cells_of(np.array([xy]))[0].tolist()
    part = patch.part((max(row - size, 0), max(col - size, 0), row + size + 1, col + size + 1))
    first_row = max(row - size, 0)
    first_col = max(col - size, 0)
    allowed = np.isfinite(cost_of_cells(part, config))
    start = nearest_true(allowed, (row - first_row, col - first_col), reach_m / resolution)
    if start is None:
        return None
    lengths = distance_field_from(allowed, start) * resolution
    return _Surroundings(first_row, first_col, lengths)


def _route(
    checked: _Checked, starts: list[_Entry], goals: list[_Entry], goal_xy: Place
) -> tuple[Array, float, float] | None:
    """Points (K, 2) on edges of the shortest drivable route, and its lengths to and from them."""
    first = checked.approaches(starts)
    last = checked.approaches(goals)
    direct = _on_one_edge(checked, starts, goals)
    topology = checked.topology
    avoided: set[int] = set()
    for _ in range(_MAX_ROUTES):
        route = shortest_route(
            topology,
            {i: approach.length_m for i, approach in first.items()},
            {i: approach.length_m for i, approach in last.items()},
            goal_xy,
            avoided,
        )
        if direct is not None and (route is None or direct[0] <= route.cost_m):
            return direct[1:]
        if route is None:
            return None
        paths = {i: topology.edges[i].path for i in route.edge_ids}
        closed = {i for i, path in paths.items() if not checked.is_drivable(path)}
        if not closed:
            begin = first[route.node_ids[0]]
            end = last[route.node_ids[-1]]
            parts = [begin.path, path_points(topology, route), end.path[::-1]]
            return (
                np.concatenate(parts),
                begin.length_m - path_length(begin.path),
                end.length_m - path_length(end.path),
            )
        avoided |= closed
    return None


def _on_one_edge(
    checked: _Checked, starts: list[_Entry], goals: list[_Entry]
) -> tuple[float, Array, float, float] | None:
    """Length and points of the shortest drivable path along an edge that passes both ends."""
    best: tuple[float, Array, float, float] | None = None
    by_edge = {entry.edge_id: entry for entry in goals}
    for start in starts:
        goal = by_edge.get(start.edge_id)
        if goal is None:
            continue
        low = min(start.index, goal.index)
        path = checked.topology.edges[start.edge_id].path[low : max(start.index, goal.index) + 1]
        length_m = start.length_m + path_length(path) + goal.length_m
        if (best is None or length_m < best[0]) and checked.is_drivable(path):
            ordered = path if start.index <= goal.index else path[::-1]
            best = (length_m, ordered, start.length_m, goal.length_m)
    return best


def _band(
    patch: GridPatch,
    path: Array,
    access: list[tuple[_Surroundings, float]],
    config: WavefrontConfig,
) -> Band:
    """Cells within _BAND_M of a path, and those between the ends and the graph."""
    resolution = patch.frame.resolution
    at = patch.frame.cells_of(path)
    # The costs of its cells depend on obstacles beside the band.
    beside_m = max(config.inflation_radius_m, config.robot_radius_m)
    margin = math.ceil((_BAND_M + beside_m) / resolution) + 1
    first = np.array([(around.row, around.col) for around, _ in access])
    last = first + [around.lengths_m.shape for around, _ in access]
    low = np.maximum(np.minimum(at.min(axis=0) - margin, first.min(axis=0)), 0)
    high = np.minimum(np.maximum(at.max(axis=0) + margin + 1, last.max(axis=0)), patch.shape)
    part = patch.part((*low.tolist(), *high.tolist()))
    cells = np.zeros(part.shape, dtype=np.bool_)
    _paint_discs(cells, at - low, _BAND_M / resolution)
    for around, length_m in access:
        rows, cols = around.lengths_m.shape
        row = around.row - int(low[0])
        col = around.col - int(low[1])
        cells[row : row + rows, col : col + cols] |= around.lengths_m <= length_m
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
