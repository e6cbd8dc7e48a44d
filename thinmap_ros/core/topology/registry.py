"""The nodes with ids that stay: ends, branches and corners, with their clearances."""

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.se2 import Array, Cells, Mask, distances_from_line, lengths_along, path_length
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.layers.free_space import squared_clearance
from thinmap_ros.core.topology.layers.lattice import Lattice, rows_and_cols
from thinmap_ros.jit import inlined, kernel

# A node that moved less than this while the map grew keeps its id.
MATCH_RADIUS_M = 0.5
_OTHER_KIND = 0.5  # share of MATCH_RADIUS_M by which a node of another kind is farther away
_LONGEST_UNEVEN_M = 8.0
_EVEN_M = 0.5
# Where the path of an edge changes by a cell, its corners may move far along it, but not to the
# next ones.
_CORNER_REACH_M = 0.5 * _LONGEST_UNEVEN_M

EMPTY_BOX = np.array([0, 0, -1, -1])

_Key = tuple[int, int]  # cell; hash of the edge of whose path it is a corner, or 0


def corner_indices(cells: Cells, room: Array) -> Cells:
    """Indices into a chain's cells (K, 2) at which corner nodes stand, in order, without its ends.

    room (K,): how far, in cells, the robot's centre may leave each cell in any direction (clearance
    less radius). Where the straight line between two neighbouring nodes is blocked, the cell
    farthest from it becomes a node, again and again until every line is clear. A line counts as
    clear when each cell it touches lies within `room` of a cell of the very piece it stands for: by
    the triangle inequality the robot then fits everywhere on it, and no grid has to be kept to know
    this. A closed chain is always broken.
    Source: exploration paper section 2.2, Fig. 3(c) and (d).
    """
    return np.flatnonzero(_split(np.ascontiguousarray(cells), np.maximum(room, 0.0)))


def corners_between(cells: Cells, room: Array, stops: Cells) -> Cells:
    """Indices `stops` of a chain's cells (K, 2), and the corners of the pieces between them.

    room (K,): see `corner_indices`.
    """
    found = [stops]
    for first, last in pairwise(stops.tolist()):
        piece = slice(first, last + 1)
        found.append(first + corner_indices(cells[piece], room[piece]))
    return np.unique(np.concatenate(found))


def with_middles(
    cells: Cells, stops: Cells, clearances: Array, longest: float, even: float
) -> Cells:
    """Indices `stops` of a chain's cells (K, 2), and between them those that split long pieces.

    A piece is split into equal parts of at most `longest` cells, unless it is a corridor: as
    straight, and its clearances (K,) as equal, as `even` cells. Elsewhere there are places beside a
    long piece from which the nodes at both of its ends are out of sight.
    """
    places = cells.astype(np.float64)
    path = lengths_along(places)
    middles = [stops]
    for first, last in pairwise(stops.tolist()):
        count = int((path[last] - path[first]) / longest)
        piece = slice(first, last + 1)
        if (
            count == 0
            or max(distances_from_line(places[piece]).max(), np.ptp(clearances[piece])) <= even
        ):
            continue
        shares = np.arange(1, count + 1) / (count + 1)
        middles.append(np.searchsorted(path, path[first] + shares * (path[last] - path[first])))
    return np.unique(np.concatenate(middles))


@inlined
def _held(cells: Cells, room: Array, first: int, last: int, hint: int, row: int, col: int) -> int:
    """A member of the piece within whose room a cell lies, or -1.

    `hint` and those after it are tried first.
    """
    for k in range(hint, last + 1):
        if (cells[k, 0] - row) ** 2 + (cells[k, 1] - col) ** 2 <= room[k] ** 2:
            return k
    for k in range(first, hint):
        if (cells[k, 0] - row) ** 2 + (cells[k, 1] - col) ** 2 <= room[k] ** 2:
            return k
    return -1


@inlined
def _is_clear(cells: Cells, room: Array, first: int, last: int) -> bool:
    """Whether every cell that the line between two members touches is held.

    At a cell's corner, both beside it.
    """
    row = cells[first, 0]
    col = cells[first, 1]
    rows = abs(cells[last, 0] - row)
    cols = abs(cells[last, 1] - col)
    up = 1 if cells[last, 0] > row else -1
    right = 1 if cells[last, 1] > col else -1
    i = j = 0
    hint = first
    while i < rows or j < cols:
        side = (1 + 2 * j) * rows - (1 + 2 * i) * cols
        if side == 0:
            if _held(cells, room, first, last, hint, row + up * (i + 1), col + right * j) < 0:
                return False
            if _held(cells, room, first, last, hint, row + up * i, col + right * (j + 1)) < 0:
                return False
        i += side >= 0
        j += side <= 0
        hint = _held(cells, room, first, last, hint, row + up * i, col + right * j)
        if hint < 0:
            return False
    return True


@inlined
def _farthest(cells: Cells, first: int, last: int) -> int:
    """The member strictly between two others that is farthest from the line between them."""
    d_row = cells[last, 0] - cells[first, 0]
    d_col = cells[last, 1] - cells[first, 1]
    squared = d_row * d_row + d_col * d_col
    best = (first + last) // 2
    best_distance = 1e-9
    for k in range(first + 1, last):
        row = cells[k, 0] - cells[first, 0]
        col = cells[k, 1] - cells[first, 1]
        share = 0.0 if squared == 0 else min(max((row * d_row + col * d_col) / squared, 0.0), 1.0)
        distance = (row - share * d_row) ** 2 + (col - share * d_col) ** 2
        if distance > best_distance + 1e-9:
            best = k
            best_distance = distance
    return best


@kernel
def _split(cells: Cells, room: Array) -> Mask:
    broken = np.zeros(cells.shape[0], dtype=np.bool_)
    stack = np.empty((cells.shape[0] + 1, 2), dtype=np.int64)
    stack[0, 0] = 0
    stack[0, 1] = cells.shape[0] - 1
    count = 1
    while count > 0:
        count -= 1
        first = stack[count, 0]
        last = stack[count, 1]
        if last - first < 2:
            continue
        closed = cells[first, 0] == cells[last, 0] and cells[first, 1] == cells[last, 1]
        if not closed and _is_clear(cells, room, first, last):
            continue
        middle = _farthest(cells, first, last)
        broken[middle] = True
        stack[count, 0] = first
        stack[count, 1] = middle
        stack[count + 1, 0] = middle
        stack[count + 1, 1] = last
        count += 2
    return broken


@kernel
def squared_clearances(lattice: Lattice, cells: Cells) -> Cells:
    """Squared clearance of each cell (K,), in cells."""
    squared = np.empty(cells.size, dtype=np.int64)
    for k in range(cells.size):
        squared[k] = squared_clearance(lattice, cells[k])
    return squared


@kernel
def least_between(squared: Cells, stops: Cells) -> Cells:
    """Smallest squared clearance of each piece of a path between two stops."""
    least = np.empty(stops.size - 1, dtype=np.int64)
    for k in range(stops.size - 1):
        least[k] = squared[stops[k] : stops[k + 1] + 1].min()
    return least


@kernel
def box_of(places: Cells, squared: Cells) -> Cells:
    """First row and column, last row and column of the space around a path (K, 2) of cells."""
    reach = int(np.sqrt(squared.max())) + 3
    rows = places[:, 0]
    cols = places[:, 1]
    return np.array(
        [rows.min() - reach, cols.min() - reach, rows.max() + reach, cols.max() + reach]
    )


@kernel
def touched_boxes(boxes: Cells, places: Cells) -> Mask:
    """Which boxes (N, 4), see `box_of`, hold one of the cells (K, 2)."""
    found = np.zeros(len(boxes), dtype=np.bool_)
    low_row = places[:, 0].min()
    high_row = places[:, 0].max()
    low_col = places[:, 1].min()
    high_col = places[:, 1].max()
    for k in range(len(boxes)):
        if boxes[k, 0] > high_row or boxes[k, 2] < low_row:
            continue
        if boxes[k, 1] > high_col or boxes[k, 3] < low_col:
            continue
        for i in range(len(places)):
            is_row = boxes[k, 0] <= places[i, 0] <= boxes[k, 2]
            if is_row and boxes[k, 1] <= places[i, 1] <= boxes[k, 3]:
                found[k] = True
                break
    return found


class _Limits(NamedTuple):
    """Robot radius, and the longest edge that is not straight and `even` wide, all in cells."""

    radius: float
    longest: float
    even: float


@dataclass(eq=False)
class _Passage:
    """A path between two vertices as published: cells, squared clearances, ids of its edges.

    places (K, 2): rows and columns of the cells; stops: indices of its first cell, of its corners,
    and of its last cell.
    """

    cells: Cells
    places: Cells
    squared: Cells
    stops: Cells
    edges: list[int] = field(default_factory=list)

    @staticmethod
    def of(lattice: Lattice, cells: Cells, limits: _Limits) -> '_Passage':
        # The line test asks whether the line stays in the room around this very path. A line that
        # is clear in the grid is not enough: a path through two rooms would become a line along the
        # corridor.
        squared = squared_clearances(lattice, cells)
        places = rows_and_cols(lattice, cells)
        clearances = np.sqrt(squared)
        room = clearances - limits.radius
        stops = corners_between(places, room, np.array([0, cells.size - 1]))
        if cells.size > limits.longest:
            middles = with_middles(places, stops, clearances, limits.longest, limits.even)
            # The lines to the middles are other lines.
            stops = corners_between(places, room, middles)
        return _Passage(cells, places, squared, stops)

    @property
    def corners(self) -> list[int]:
        """Cells of the corner nodes."""
        return [int(cell) for cell in self.cells[self.stops[1:-1]]]

    @property
    def ends(self) -> tuple[int, int]:
        """Cells of its first and last node."""
        return int(self.cells[0]), int(self.cells[-1])

    def is_same(self, other: '_Passage') -> bool:
        """Whether two measurements of one path publish the same."""
        if not np.array_equal(self.stops, other.stops):
            return False
        if not np.array_equal(self.squared[self.stops], other.squared[other.stops]):
            return False
        own = least_between(self.squared, self.stops)
        return np.array_equal(own, least_between(other.squared, other.stops))


@dataclass(frozen=True, eq=False)
class Changes:
    """Changes of the edges of the skeleton graph, by the hashes of their paths.

    fresh: cells of new paths (one cell: a node without edges); gone: paths that no longer exist;
    places (K, 2): rows and columns of the cells of the grid that changed.
    """

    fresh: dict[int, Cells]
    gone: set[int]
    places: Cells


class Registry:
    """The published map, and which of its ids belong to which paths (by hash) and cells.

    next_id: smallest number that no node or edge has had.
    """

    def __init__(
        self,
        frame: GridFrame,
        config: TopologyConfig,
        predecessor: TopologicalMap | None = None,
        next_id: int = 1,
    ) -> None:
        """predecessor: map whose ids continue, its nodes at the places where they are now."""
        self.map = TopologicalMap()
        self.next_id = next_id
        self._predecessor = predecessor
        self._frame = frame
        lengths_m = (config.robot_radius_m, _LONGEST_UNEVEN_M, _EVEN_M)
        self._limits = _Limits(*(length_m / frame.resolution for length_m in lengths_m))
        self._passages: dict[int, _Passage] = {}
        self._nodes: dict[_Key, int] = {}
        # Of each path the box in which changed cells may concern it.
        self._boxes: dict[int, Cells] = {}

    @property
    def hashes(self) -> set[int]:
        """Hashes of the published paths."""
        return set(self._passages)

    def update(self, lattice: Lattice, changes: Changes) -> bool:
        """Publish the changes; returns whether there were any.

        A new node gets the id of a removed one within MATCH_RADIUS_M, nearest pairs first; a corner
        also that of a corner farther off, as along its edge; and an edge that of a removed one
        between the same nodes.
        """
        new = {
            number: _Passage.of(lattice, cells, self._limits)
            for number, cells in changes.fresh.items()
        }
        new |= self._measured_again(lattice, changes)
        gone = changes.gone | (new.keys() & self._passages.keys())
        if not new and not gone:
            return False
        loose = {cell for number in gone for cell in self._passages[number].ends}
        old_edges = self._remove_edges(gone)
        kept = {cell for passage in new.values() for cell in passage.ends}
        old_nodes = self._remove_nodes(gone, loose - kept)
        reach_m = _CORNER_REACH_M if self._predecessor is None else MATCH_RADIUS_M
        if self._predecessor is not None:
            old_edges += self._predecessor.edges.values()
            old_nodes += self._predecessor.nodes.values()
            self._predecessor = None
        wanted = {(cell, 0) for cell in kept}
        for number, passage in new.items():
            wanted |= {(cell, number) for cell in passage.corners}
        self._put_nodes(lattice, wanted - self._nodes.keys(), old_nodes, reach_m)
        self._put_passages(new, old_edges)
        self._put_vertices(lattice, [cell for cell in loose | kept if (cell, 0) in self._nodes])
        return True

    def _measured_again(self, lattice: Lattice, changes: Changes) -> dict[int, _Passage]:
        """Paths whose corners or clearances are changed by changed cells around them."""
        new: dict[int, _Passage] = {}
        if not len(changes.places):
            return new
        numbers = list(self._boxes)
        boxes = np.concatenate([EMPTY_BOX, *self._boxes.values()]).reshape(-1, 4)[1:]
        for k in np.flatnonzero(touched_boxes(boxes, changes.places)).tolist():
            number = numbers[k]
            if number not in changes.gone:
                again = _Passage.of(lattice, self._passages[number].cells, self._limits)
                if not again.is_same(self._passages[number]):
                    new[number] = again
        return new

    def _remove_edges(self, gone: set[int]) -> list[Edge]:
        """Remove the edges of paths from the map."""
        old = [self.map.edges[edge] for number in gone for edge in self._passages[number].edges]
        for edge in old:
            self.map.drop_edge(edge.id)
        return old

    def _remove_nodes(self, gone: set[int], loose: set[int]) -> list[Node]:
        """Remove the corners of paths, and vertices without edges, from the map."""
        places: list[_Key] = []
        for number in gone:
            del self._boxes[number]
            places += [(cell, number) for cell in self._passages.pop(number).corners]
        for cell in loose:
            if not self.map.edges_at(self._nodes[cell, 0]):
                places.append((cell, 0))
        old = [self.map.nodes[self._nodes.pop(place)] for place in places]
        for node in old:
            self.map.drop_node(node.id)
        return old

    def _put_nodes(
        self, lattice: Lattice, fresh: set[_Key], old: list[Node], reach_m: float
    ) -> None:
        """Put new nodes into the map, with the ids of old ones that they continue.

        reach_m: from a new corner to an old one.
        """
        if not fresh:
            return
        array = np.array(list(fresh), dtype=np.int64)
        rows_cols = rows_and_cols(lattice, array[:, 0])
        order = np.lexsort((array[:, 1], rows_cols[:, 1], rows_cols[:, 0]))
        places = [(int(cell), int(number)) for cell, number in array[order]]
        found = self._measured(lattice, [cell for cell, _ in places])
        nodes = [
            Node(0, NodeKind.CORNER if number else NodeKind.END, *measures)
            for (_, number), measures in zip(places, found, strict=True)
        ]
        ids = self._continued(nodes, old, reach_m)
        for k, place in enumerate(places):
            self._nodes[place] = ids.get(k) or self._new_id()
            self.map.put_node(replace(nodes[k], id=self._nodes[place]))

    def _continued(self, fresh: list[Node], old: list[Node], reach_m: float) -> dict[int, int]:
        """Ids of old nodes by the index of the new node that continues each."""
        if not fresh or not old:
            return {}
        new_xy, old_xy = (np.array([(node.x, node.y) for node in some]) for some in (fresh, old))
        distance = np.hypot(*np.moveaxis(new_xy[:, None] - old_xy, 2, 0))
        corner, old_corner = (
            np.array([node.kind is NodeKind.CORNER for node in some]) for some in (fresh, old)
        )
        penalty = _OTHER_KIND * MATCH_RADIUS_M * (corner[:, None] != old_corner)
        cost = distance + penalty * (distance > 0.1 * self._frame.resolution)
        is_near = distance <= MATCH_RADIUS_M
        cost[~is_near] += reach_m  # after all that are near
        pairs = np.argwhere(is_near | (corner[:, None] & old_corner & (distance <= reach_m)))
        ids: dict[int, int] = {}
        used: set[int] = set()
        for i, j in pairs[np.argsort(cost[pairs[:, 0], pairs[:, 1]], kind='stable')].tolist():
            if i not in ids and old[j].id not in used:
                ids[i] = old[j].id
                used.add(old[j].id)
        return ids

    def _put_passages(self, new: dict[int, _Passage], old: list[Edge]) -> None:
        """Put the edges of new paths into the map."""
        between: dict[tuple[int, int], list[Edge]] = {}
        for edge in old:
            between.setdefault((min(edge.a, edge.b), max(edge.a, edge.b)), []).append(edge)
        for number, passage in new.items():
            self._passages[number] = passage
            self._boxes[number] = box_of(passage.places, passage.squared)
            if passage.cells.size > 1:
                self._put_edges(number, passage, between)

    def _put_edges(
        self, number: int, passage: _Passage, between: dict[tuple[int, int], list[Edge]]
    ) -> None:
        """Put the edges of a path into the map, with the ids of old ones between the same nodes."""
        owners = [0, *[number] * (len(passage.stops) - 2), 0]
        cells = passage.cells[passage.stops].tolist()
        ids = [self._nodes[place] for place in zip(cells, owners, strict=True)]
        points = self._frame.centres_of(passage.places)
        least = least_between(passage.squared, passage.stops).tolist()
        stops = pairwise(passage.stops.tolist())
        for (a, b), (first, last), squared in zip(pairwise(ids), stops, least, strict=True):
            path = points[first : last + 1]
            edge_id = _taken_over(between.get((min(a, b), max(a, b)), []), path)
            clearance = math.sqrt(squared) * self._frame.resolution
            edge = Edge(edge_id or self._new_id(), a, b, path, path_length(path), clearance)
            self.map.put_edge(edge)
            passage.edges.append(edge.id)

    def _put_vertices(self, lattice: Lattice, cells: list[int]) -> None:
        """Update the kinds and the clearances of the nodes of vertices."""
        for cell, measures in zip(cells, self._measured(lattice, cells), strict=True):
            node_id = self._nodes[cell, 0]
            node = Node(node_id, self.map.kind_at(node_id), *measures)
            if node != self.map.nodes[node_id]:
                self.map.put_node(node)

    def _measured(self, lattice: Lattice, cells: list[int]) -> list[tuple[float, float, float]]:
        """x, y and clearance of cells, m."""
        array = np.array(cells, dtype=np.int64)
        xy = self._frame.centres_of(rows_and_cols(lattice, array))
        clearances = np.sqrt(squared_clearances(lattice, array)) * self._frame.resolution
        rows = zip(xy.tolist(), clearances.tolist(), strict=True)
        return [(x, y, clearance) for (x, y), clearance in rows]

    def _new_id(self) -> int:
        self.next_id += 1
        return self.next_id - 1


def _taken_over(same: list[Edge], path: Array) -> int:
    """Id of the old edge between the same nodes whose middle is nearest; 0: none. It is removed."""
    if not same:
        return 0
    middle = path[len(path) // 2]
    middles = np.array([edge.path[len(edge.path) // 2] for edge in same])
    return same.pop(int(np.hypot(*(middles - middle).T).argmin())).id
