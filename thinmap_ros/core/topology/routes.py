"""The graph of a saved map, reduced for a route server."""

import heapq
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from thinmap_ros.core.grid.fields import counts_of, label, looked_up, squared_distance, strips
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.se2 import Array, Cells, Mask, distances_from_line, path_length
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.thinning import (
    VIEW_M,
    known_free,
    standing_room,
    view_ends,
    view_from,
)
from thinmap_ros.jit import inlined, kernel

DETAIL_M = 1.2  # a small table; nodes are as far apart, unless another spacing is given
MIN_NODE_SPACING_M = 0.05  # a cell of most maps

_DIRECTIONS = 72  # of straight lines from a cell

_LATTICE_M = 0.5  # between the places that should see a node
_SIGHT_REACH_M = 10.0  # a node that is farther off is out of sight
_MIN_GAIN = 3  # places that a node must show
_NODE_REACH_M = 6.0  # of a place from an edge on which a node may show it
_SPLIT_STEP_M = 0.25  # between the points on edges where nodes may be put
_REACH = 3.0  # of places from a node, in node spacings
_DETOUR = 1.2  # of a route between nodes that see each other, relative to the line

Box = tuple[float, float, float, float]  # smallest x and y, largest x and y, m


class EditedGraph:
    """A map that gets straight edges, and new nodes, and the cells on which its edges may run.

    ends: ids of the nodes at which the map ended before it was edited.
    """

    def __init__(
        self, topology: TopologicalMap, frame: GridFrame, standing: Mask, known: Mask
    ) -> None:
        """Edit a map: standing (H, W), traversable cells; known (H, W), cells that are free."""
        self.map = topology
        self.frame = frame
        self.standing = standing
        self.ends = {n.id for n in topology.nodes.values() if n.kind is NodeKind.END}
        self._squared = squared_distance(~known, is_rim_marked=True)
        self._next_id = 1 + max([0, *topology.nodes, *topology.edges])

    def cell(self, node_id: int) -> tuple[int, int]:
        """Row and column of a node."""
        node = self.map.nodes[node_id]
        return self.frame.cell_at(node.x, node.y)

    def is_clear(self, a: tuple[int, int], b: tuple[int, int]) -> bool:
        """Whether a robot can drive straight from the centre of a cell to that of another."""
        return bool(is_drivable(self.standing, *a, *b))

    def put_straight(self, edge_id: int, a: int, b: int) -> None:
        """Put a straight edge between two nodes; id 0: a new one."""
        start = self.map.nodes[a].position
        end = self.map.nodes[b].position
        steps = math.ceil(math.dist(start, end) / self.frame.resolution) + 1
        path = np.linspace(start, end, max(steps, 2))
        clearance = float(self.clearances(path).min())
        self.map.put_edge(Edge(edge_id or self._new_id(), a, b, path, path_length(path), clearance))

    def put_node(self, xy: Array) -> int:
        """Put a node at a point (2,), m; returns its id."""
        clearance = float(self.clearances(xy[None])[0])
        node = Node(self._new_id(), NodeKind.CORNER, float(xy[0]), float(xy[1]), clearance)
        self.map.put_node(node)
        return node.id

    def split(self, edge: Edge, node_id: int) -> int:
        """Replace an edge by two straight ones over a node; returns the id of the second one."""
        self.map.drop_edge(edge.id)
        self.put_straight(edge.id, edge.a, node_id)
        self.put_straight(0, node_id, edge.b)
        return self._next_id - 1

    def with_kinds(self) -> TopologicalMap:
        """The map, its nodes with the kinds that they have now."""
        for node in list(self.map.nodes.values()):
            self.map.put_node(replace(node, kind=self.map.kind_at(node.id)))
        return self.map

    def clearances(self, points: Array) -> Array:
        """Distance of points (N, 2) to the nearest cell that is not free, m."""
        squared = self._squared[tuple(self.frame.cells_of(points).T)]
        return np.asarray(np.sqrt(squared) * self.frame.resolution)

    def _new_id(self) -> int:
        self._next_id += 1
        return self._next_id - 1


@kernel
def is_drivable(standing: Mask, row: int, col: int, to_row: int, to_col: int) -> bool:
    """Whether all cells on the straight line between the centres of two cells are traversable.

    standing (H, W): traversable cells. As in the graph, a line over the corner of four cells needs
    none of the two beside it.
    """
    rows = abs(to_row - row)
    cols = abs(to_col - col)
    up = 1 if to_row > row else -1
    right = 1 if to_col > col else -1
    i = 0
    j = 0
    while standing[row + up * i, col + right * j]:
        if i == rows and j == cols:
            return True
        side = (1 + 2 * j) * rows - (1 + 2 * i) * cols
        i += side >= 0
        j += side <= 0
    return False


@kernel
def _are_drivable(standing: Mask, cells: Cells, ends: Cells) -> Mask:
    """Of each of the cells (N, 2) whether it is drivable straight from there to its end (N, 2)."""
    found = np.empty(len(cells), dtype=np.bool_)
    for i in range(len(cells)):
        found[i] = is_drivable(standing, cells[i, 0], cells[i, 1], ends[i, 0], ends[i, 1])
    return found


def split_parallels(graph: EditedGraph) -> None:
    """Make all edges straight, as they are driven; two between the same nodes get a corner node.

    Length and clearance become those of the line. The longer one of two, and one whose line is
    blocked, leads over a corner where it is farthest from the line; where no such corner clears it,
    it goes.
    """
    known: set[tuple[int, int]] = set()
    edges = sorted(graph.map.edges.values(), key=lambda edge: (edge.length_m, edge.id))
    for edge in edges:
        ends = (min(edge.a, edge.b), max(edge.a, edge.b))
        if ends in known or edge.a == edge.b or not graph.is_clear(*map(graph.cell, ends)):
            _lead_over_corner(graph, edge)
        else:
            graph.put_straight(edge.id, edge.a, edge.b)
        known.add(ends)


def _lead_over_corner(graph: EditedGraph, edge: Edge) -> None:
    corner = edge.path[int(distances_from_line(edge.path).argmax())]
    cell = graph.frame.cell_at(*corner.tolist())
    ends = {graph.cell(edge.a), graph.cell(edge.b)}
    if len(ends) == 2 and all(cell != at and graph.is_clear(cell, at) for at in ends):
        graph.split(edge, graph.put_node(corner))
    else:
        graph.map.drop_edge(edge.id)


def give_edges(graph: EditedGraph) -> None:
    """Lead an edge from each node without one to the farthest place on a straight line."""
    for node in list(graph.map.nodes.values()):
        if graph.map.edges_at(node.id):
            continue
        cell = graph.cell(node.id)
        place = _farthest(graph.standing, *cell, _DIRECTIONS)
        if place != cell:
            other = graph.put_node(graph.frame.centres_of(np.array([place]))[0])
            graph.put_straight(0, node.id, other)


@kernel
def _farthest(standing: Mask, row: int, col: int, directions: int) -> tuple[int, int]:
    """The traversable cell that is farthest from one on a straight line over such cells."""
    best = (row, col)
    best_away = 0.0
    for k in range(directions):
        angle = 2.0 * math.pi * k / directions
        away = 0.0
        at = (row, col)
        to = at
        while _is_true(standing, to[0], to[1]):
            at = to
            away += 0.5
            to = (
                int(math.floor(row + 0.5 + away * math.sin(angle))),
                int(math.floor(col + 0.5 + away * math.cos(angle))),
            )
        if away > best_away and is_drivable(standing, row, col, at[0], at[1]):
            best = at
            best_away = away
    return best


@inlined
def _is_true(mask: Mask, row: int, col: int) -> bool:
    """Whether a cell lies in a mask (H, W) and is true."""
    return bool(0 <= row < mask.shape[0] and 0 <= col < mask.shape[1] and mask[row, col])


def drop_rays(topology: TopologicalMap, patch: GridPatch) -> None:
    """Drop ends that see more of the unknown than of walls, back to the first node that does not.

    Such a branch is a ray: space that a laser saw through glass, without walls around.
    A node without edges counts as an end, unless nothing else is left.
    """
    ends = view_ends(patch)
    reach = VIEW_M / patch.frame.resolution
    open_ids = [number for number in topology.nodes if len(topology.edges_at(number)) < 2]
    while open_ids and len(topology.nodes) > 1:
        number = open_ids.pop()
        edges = topology.edges_at(number) if number in topology.nodes else []
        if number not in topology.nodes or len(edges) > 1:
            continue
        node = topology.nodes[number]
        cell = patch.frame.cell_at(node.x, node.y)
        walls, unknown = view_from(ends, *cell, reach, _DIRECTIONS)
        if unknown > walls:
            open_ids += [edge.other(number) for edge in edges if edge.a != edge.b]
            topology.drop_node(number)


@dataclass(frozen=True)
class Coverage:
    """Shares of the reachable floor that a reduced graph does not cover.

    Reachable are the free cells at least a robot's radius from all walls, in one part with
    traversable cells. unknown: those that a robot on a traversable cell does not touch, as unknown
    cells are too near. rays: of the others, those nearest to a path that `drop_rays` drops.
    """

    unknown: float
    rays: float

    @property
    def covered(self) -> float:
        """Share of the reachable floor that the graph covers."""
        return 1.0 - self.unknown - self.rays


def coverage(
    whole: TopologicalMap, patch: GridPatch, standing: Mask, config: TopologyConfig
) -> Coverage:
    """What the reduced graph of a skeleton covers; standing (H, W): as of `route_graph`.

    whole: with at least one node.
    """
    radius = config.robot_radius_m / patch.frame.resolution
    room = known_free(patch, config) & standing_room(~patch.occupied, radius)
    cells = _some_of(
        _touched(room, standing), max(round(_SPLIT_STEP_M / patch.frame.resolution), 1) ** 2
    )
    beyond = standing_room(~standing, radius)[cells[:, 0], cells[:, 1]]
    kept = whole.copy()
    drop_rays(kept, patch)
    parts = [(edge.path, edge.id in kept.edges) for edge in whole.edges.values()]
    parts += [(node.position[None], node.id in kept.nodes) for node in whole.nodes.values()]
    is_kept = np.concatenate([np.full(len(points), is_kept) for points, is_kept in parts])
    tree = cKDTree(np.concatenate([points for points, _ in parts]))
    dropped = 0
    if not is_kept.all():
        nearest = tree.query(patch.frame.centres_of(cells[~beyond]))[1]
        dropped = int(np.count_nonzero(~is_kept[nearest]))
    return Coverage(float(beyond.mean()), dropped / len(cells))


def _touched(cells: Mask, others: Mask) -> Mask:
    """Parts of a mask (H, W) that have a cell in common with another."""
    labels, sizes = label(cells)
    common = counts_of(labels, others, len(sizes))
    common[0] = 0
    return looked_up(common > 0, labels)


def _some_of(cells: Mask, step: int) -> Cells:
    """Each so manieth of the true cells (N, 2) of a mask (H, W).

    Not those on a lattice: all of its lines may miss a narrow corridor.
    """
    found = []
    first = 0
    for strip in strips(len(cells)):
        there = np.argwhere(cells[strip])
        found.append(there[first::step] + (strip.start, 0))
        first = (first - len(there)) % step
    return np.concatenate(found)


def open_rings(graph: EditedGraph, known: Mask, detail_m: float) -> None:
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
            if reached >= costs.get(to, math.inf):
                continue
            box = _joined(boxed[node_id][0], boxes[other.id])
            room_m = max(boxed[node_id][1], nodes[to].clearance_m)
            if fits(box, detail_m + 2.0 * room_m):
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
    low_x, low_y = path.min(axis=0).tolist()
    return low_x, low_y, *path.max(axis=0).tolist()


def _joined(one: Box, other: Box) -> Box:
    low = (min(one[0], other[0]), min(one[1], other[1]))
    return *low, max(one[2], other[2]), max(one[3], other[3])


@kernel
def _enclosed(known: Mask, ring: Cells) -> int:
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


class Sight:
    """Places on a lattice of traversable cells, the node nearest to each, and whether it is seen.

    A route server starts at the node nearest to the robot, whatever walls are between. xy (N, 2):
    the places, m; away_m, seen (N,): distance of the nearest node, and whether it is in sight;
    reach_m: how far a node may be that is added.
    """

    def __init__(
        self, frame: GridFrame, standing: Mask, known: Mask, nodes: Iterable[Node]
    ) -> None:
        """Begin with some nodes: standing (H, W), traversable cells; known (H, W), cells seen."""
        step = max(round(_LATTICE_M / frame.resolution), 1)
        self.reach_m = _SIGHT_REACH_M
        self._frame = frame
        self._known = known
        self._cells = np.ascontiguousarray(np.argwhere(standing[::step, ::step]) * step)
        self._step = step
        self._numbers = np.full(standing[::step, ::step].shape, -1, dtype=np.int64)
        self._numbers[tuple((self._cells // step).T)] = np.arange(len(self._cells))
        self.xy = frame.centres_of(self._cells)
        self._tree = cKDTree(self.xy)
        self.away_m = np.full(len(self._cells), np.inf)
        self._owner = np.zeros(len(self._cells), dtype=np.int64)
        self.seen: Mask = np.zeros(len(self._cells), dtype=np.bool_)
        self._places: dict[int, Cells] = {}
        self._assign(list(nodes))

    def drop(self, node: Node, graph: TopologicalMap) -> bool:
        """Leave out a node of a graph, unless fewer places would see the node nearest to them."""
        places = self._places[node.id]
        others = self._candidates(node, graph)
        points = np.array([(other.x, other.y) for other in others])
        cells = self._frame.cells_of(points)
        nearest, away, seen = _nearest_of(
            self._known, self._cells[places], self.xy[places], cells, points
        )
        if np.count_nonzero(seen) < np.count_nonzero(self.seen[places]):
            return False
        self.seen[places] = seen
        self.away_m[places] = away
        for k in np.flatnonzero(np.bincount(nearest, minlength=1)).tolist():
            self._give(others[k].id, places[nearest == k])
        del self._places[node.id]
        return True

    def add(self, node: Node, least_gain: int = _MIN_GAIN) -> bool:
        """Add a node, if so some more places see the node nearest to them."""
        places, away = self._closer(node)
        seen = self._sees(node, places)
        if np.count_nonzero(seen) < np.count_nonzero(self.seen[places]) + least_gain:
            return False
        owners = np.unique(self._owner[places]).tolist()
        self._owner[places] = -1
        for owner in owners:
            had = self._places[owner]
            self._places[owner] = had[self._owner[had] == owner]
        self.seen[places] = seen
        self.away_m[places] = away
        self._give(node.id, places)
        return True

    def farthest(self, gone: list[Node]) -> Cells:
        """Indices of the places, those farthest from a node first, none nearer to one that is gone.

        gone: nodes that were dropped with the places around them.
        """
        order = np.argsort(-self.away_m, kind='stable')
        if not gone:
            return order
        away = cKDTree([node.position for node in gone]).query(self.xy[order])[0]
        return order[away > self.away_m[order]]

    def around(self, place: int, reach_m: float) -> Cells:
        """Places (N, 2), as cells, that see one, within a reach of it."""
        near = self._cells[self._tree.query_ball_point(self.xy[place], reach_m)]
        row, col = self._cells[place].tolist()
        return np.asarray(near[_lines_clear(self._known, row, col, near)])

    def first_seeing(self, place: int, cells: Cells) -> int:
        """Index of the first of some cells (N, 2) that a place sees; -1: none."""
        row, col = self._cells[place].tolist()
        return int(_first_clear(self._known, row, col, cells))

    def _assign(self, nodes: list[Node]) -> None:
        """Find the nearest of the nodes for each place."""
        self._places = {node.id: np.empty(0, dtype=np.int64) for node in nodes}
        if not nodes or not len(self._cells):
            return
        found = cKDTree([(node.x, node.y) for node in nodes]).query(self.xy)
        self.away_m = np.asarray(found[0])
        nearest = np.asarray(found[1])
        order = np.argsort(nearest, kind='stable')
        first = np.searchsorted(nearest[order], np.arange(len(nodes) + 1))
        for k, node in enumerate(nodes):
            places = order[first[k] : first[k + 1]]
            self.seen[places] = self._sees(node, places)
            self._give(node.id, places)

    def _give(self, node_id: int, places: Cells) -> None:
        self._owner[places] = node_id
        had = self._places.get(node_id, places[:0])
        self._places[node_id] = np.concatenate((had, places))

    def _candidates(self, node: Node, graph: TopologicalMap) -> list[Node]:
        """Other nodes that may be nearest to one of the places of a node with a neighbour."""
        around = [graph.nodes[i] for i in graph.neighbours(node.id) if i != node.id]
        reach_m = float(self.away_m[self._places[node.id]].max(initial=0.0))
        nearest_m = min(math.dist((node.x, node.y), (other.x, other.y)) for other in around)
        found = graph.nodes_near(node.x, node.y, 2.0 * reach_m + nearest_m)
        return [other for other in found if other.id != node.id]

    def _closer(self, node: Node) -> tuple[Cells, Array]:
        """Indices of the places within reach to which a node is nearest, and their distances, m."""
        row, col = (index // self._step for index in self._frame.cell_at(node.x, node.y))
        reach = math.ceil(self.reach_m / (self._step * self._frame.resolution)) + 1
        box = np.array([row - reach, col - reach, row + reach + 1, col + reach + 1])
        return _closer(self._numbers, box, self.xy, self.away_m, node.position, self.reach_m)

    def _sees(self, node: Node, places: Cells) -> Mask:
        row, col = self._frame.cell_at(node.x, node.y)
        return np.asarray(_lines_clear(self._known, row, col, self._cells[places]))


@kernel
def _closer(
    numbers: Cells, box: Cells, xy: Array, away: Array, point: Array, reach_m: float
) -> tuple[Cells, Array]:
    """Indices and distances, m, of places (N, 2) within reach, nearer to a point than before.

    numbers (H, W): indices of the places of a lattice, -1: none; box: its first row and column that
    is within reach, and its last ones; away (N,): distances, m, from what was nearest so far.
    """
    most = (box[2] - box[0]) * (box[3] - box[1])
    found = np.empty(most, dtype=np.int64)
    nearer = np.empty(most)
    count = 0
    for row in range(max(box[0], 0), min(box[2], numbers.shape[0])):
        for col in range(max(box[1], 0), min(box[3], numbers.shape[1])):
            place = numbers[row, col]
            if place < 0:
                continue
            distance = math.hypot(xy[place, 0] - point[0], xy[place, 1] - point[1])
            if distance <= reach_m and distance < away[place]:
                found[count] = place
                nearer[count] = distance
                count += 1
    return found[:count].copy(), nearer[:count].copy()


@kernel
def _nearest_of(
    known: Mask, cells: Cells, xy: Array, ends: Cells, points: Array
) -> tuple[Cells, Array, Mask]:
    """Index of the nearest of some points (M, 2) to each place, its distance, m, and if it is seen.

    cells, xy (N, 2): the places; ends (M, 2): cells of the points.
    """
    nearest = np.zeros(len(xy), dtype=np.int64)
    away = np.full(len(xy), np.inf)
    seen = np.zeros(len(xy), dtype=np.bool_)
    for i in range(len(xy)):
        for k in range(len(points)):
            distance = math.hypot(xy[i, 0] - points[k, 0], xy[i, 1] - points[k, 1])
            if distance < away[i]:
                nearest[i] = k
                away[i] = distance
        end = ends[nearest[i]]
        seen[i] = line_is_clear(known, cells[i, 0], cells[i, 1], end[0], end[1])
    return nearest, away, seen


@kernel
def _lines_clear(free: Mask, row: int, col: int, cells: Cells) -> Mask:
    """Whether the straight lines from cells (N, 2) to one are clear, (N,)."""
    found = np.zeros(len(cells), dtype=np.bool_)
    for i in range(len(cells)):
        found[i] = line_is_clear(free, cells[i, 0], cells[i, 1], row, col)
    return found


@kernel
def _first_clear(free: Mask, row: int, col: int, cells: Cells) -> int:
    """Index of the first of cells (N, 2) with a clear straight line to one; -1: none."""
    for i in range(len(cells)):
        if line_is_clear(free, cells[i, 0], cells[i, 1], row, col):
            return i
    return -1


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
    by_distance = []
    for i in around:
        other_node = graph.map.nodes[i]
        away_m = math.dist((node.x, node.y), (other_node.x, other_node.y))
        by_distance.append((away_m, i))
    for away_m, other in sorted(by_distance):
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

    def near(self, xy: Array, reach_m: float) -> Cells:
        """Indices of the points within reach of a place (2,), m, the nearest first."""
        found = np.array(self._tree.query_ball_point(xy, reach_m), dtype=np.int64)
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
    for place in np.flatnonzero(~sight.seen).tolist():
        if not sight.seen[place]:
            _put_on_edge(graph, sight, points, place, _NODE_REACH_M, _MIN_GAIN)


def _put_on_edge(
    graph: EditedGraph,
    sight: Sight,
    points: _EdgePoints,
    place: int,
    reach_m: float,
    least_gain: int,
) -> bool:
    """Put a node on the nearest edge in sight of a place, if so some more places see a node."""
    near = points.near(sight.xy[place], reach_m)
    first = sight.first_seeing(place, points.cells[near])
    edge = graph.map.edges.get(int(points.edges[near[first]])) if first >= 0 else None
    if edge is None:
        return False
    row, col = points.cells[near[first]].tolist()
    if not all(graph.is_clear((row, col), graph.cell(end)) for end in (edge.a, edge.b)):
        return False
    node_id = graph.put_node(graph.frame.centres_of(points.cells[near[first]][None])[0])
    if not sight.add(graph.map.nodes[node_id], least_gain):
        graph.map.drop_node(node_id)
        return False
    points.split(int(near[first]), graph.split(edge, node_id))
    return True


def spread_nodes(graph: EditedGraph, sight: Sight, reach_m: float, gone: list[Node]) -> None:
    """Put nodes where places are farther than a reach from each, those farthest off first.

    On an edge within reach, else in open space that is in sight of a node: `cross_edges` joins it.
    gone: nodes of space that shall have none.
    """
    sight.reach_m = max(sight.reach_m, 2.0 * reach_m)
    for node in graph.map.nodes.values():
        sight.add(node, 0)
    points = _EdgePoints(graph)
    places = sight.farthest(gone)
    count = 0
    while count < len(graph.map.nodes):
        count = len(graph.map.nodes)
        places = places[sight.away_m[places] > reach_m]
        for place in places.tolist():
            if reach_m < sight.away_m[place] < 2.0 * reach_m and not _put_on_edge(
                graph, sight, points, place, reach_m, 0
            ):
                _put_in_space(graph, sight, place, reach_m)


def _put_in_space(graph: EditedGraph, sight: Sight, place: int, reach_m: float) -> None:
    """Put a node where there is most clearance in sight of a place, unless no node is in sight."""
    centres = graph.frame.centres_of(sight.around(place, 0.5 * reach_m))
    xy = centres[int(graph.clearances(centres).argmax())]
    node_id = graph.put_node(xy)
    cell = graph.cell(node_id)
    clear = any(
        0.0 < math.dist((node.x, node.y), xy) <= 2.0 * reach_m
        and graph.is_clear(cell, graph.cell(node.id))
        for node in graph.map.nodes_near(float(xy[0]), float(xy[1]), 2.0 * reach_m)
    )
    if not clear or not sight.add(graph.map.nodes[node_id], 0):
        graph.map.drop_node(node_id)


def cross_edges(graph: EditedGraph, reach_m: float) -> None:
    """Join nodes by straight edges where the route between them is a detour, the nearest first.

    Source: Althöfer et al., "On sparse spanners of weighted graphs", 1993.
    """
    ids = list(graph.map.nodes)
    places = np.array([(node.x, node.y) for node in graph.map.nodes.values()]).reshape(-1, 2)
    pairs = cKDTree(places).query_pairs(reach_m, output_type='ndarray')
    cells = graph.frame.cells_of(places)
    pairs = pairs[_are_drivable(graph.standing, cells[pairs[:, 0]], cells[pairs[:, 1]])]
    away_m = np.hypot(*(places[pairs[:, 0]] - places[pairs[:, 1]]).T)
    for k in np.argsort(away_m, kind='stable').tolist():
        a, b = (ids[i] for i in pairs[k].tolist())
        reached = graph.map.nearest_first({a: 0.0}, _DETOUR * float(away_m[k]))
        if all(node_id != b for node_id, _ in reached):
            graph.put_straight(0, a, b)


def route_graph(
    topology: TopologicalMap,
    patch: GridPatch,
    standing: Mask,
    config: TopologyConfig,
    detail_m: float = DETAIL_M,
    node_spacing_m: float | None = None,
) -> TopologicalMap:
    """The reduced graph of a map; the given one is not changed.

    A robot that maps needs every node: each is an event of its exploration. A route server needs
    few nodes, straight edges, and a node in sight of each place. The reduced graph has

    - no branch into rays that passed through glass;
    - one path, the wider one, round an obstacle smaller than `detail_m`;
    - one node for several that are nearer to each other than `node_spacing_m`, and none on a
      straight line;
    - no two edges along one straight line, and no node without an edge;
    - a node within three spacings of each place, and, where a straight line is free, no route that
      is longer than it by more than a fifth.

    standing (H, W): cells of the patch that a robot can traverse. Each edge is a straight line over
    such cells. detail_m: smaller obstacles are passed on one side only.
    node_spacing_m: nodes nearer to each other than this, or than the clearance of one of them, are
    one where places see it as well; reaches of places and edges are multiples of it; None:
    detail_m.
    """
    known = known_free(patch, config)
    graph = EditedGraph(topology.copy(), patch.frame, standing, known)
    drop_rays(graph.map, patch)
    gone = [node for node in topology.nodes.values() if node.id not in graph.map.nodes]
    open_rings(graph, known, detail_m)
    sight = Sight(patch.frame, standing, known, graph.map.nodes.values())
    spacing_m = detail_m if node_spacing_m is None else node_spacing_m
    merge_nodes(graph, sight, spacing_m, detail_m)
    show_places(graph, sight)
    split_parallels(graph)
    give_edges(graph)
    reach_m = _REACH * max(spacing_m, _LATTICE_M)
    spread_nodes(graph, sight, reach_m, gone)
    cross_edges(graph, 2.0 * reach_m)
    return graph.with_kinds()
