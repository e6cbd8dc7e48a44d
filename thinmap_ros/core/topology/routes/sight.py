"""Which places see the node that is nearest to them."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import Node, TopologicalMap
from thinmap_ros.jit import kernel

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
_LATTICE_M = 0.5  # between the places that should see a node
_REACH_M = 10.0  # a node that is farther off is out of sight
_MIN_GAIN = 3  # places that a node must show


class Sight:
    """Places on a lattice of traversable cells, the node nearest to each, and whether it is seen.

    A route server starts at the node nearest to the robot, whatever walls are between.
    """

    def __init__(
        self, frame: GridFrame, standing: Mask, known: Mask, nodes: Iterable[Node]
    ) -> None:
        """Begin with some nodes: standing (H, W), traversable cells; known (H, W), cells seen."""
        step = max(round(_LATTICE_M / frame.resolution), 1)
        self._frame = frame
        self._known = known
        self._cells = np.ascontiguousarray(np.argwhere(standing[::step, ::step]) * step)
        self._xy = frame.centres_of(self._cells)
        self._tree = cKDTree(self._xy)
        self._away = np.full(len(self._cells), np.inf)
        self._owner = np.zeros(len(self._cells), dtype=np.int64)
        self._seen: Mask = np.zeros(len(self._cells), dtype=np.bool_)
        self._places: dict[int, Cells] = {}
        self._assign(list(nodes))

    def drop(self, node: Node, graph: TopologicalMap) -> bool:
        """Leave out a node of a graph, unless fewer places would see the node nearest to them."""
        places = self._places[node.id]
        others = self._candidates(node, graph)
        xy = np.array([(other.x, other.y) for other in others])
        away = np.hypot(*np.moveaxis(self._xy[places][:, None] - xy, 2, 0))
        nearest = away.argmin(axis=1)
        seen = np.zeros(len(places), dtype=np.bool_)
        for k in np.unique(nearest):
            seen[nearest == k] = self._sees(others[k], places[nearest == k])
        if seen.sum() < self._seen[places].sum():
            return False
        self._seen[places] = seen
        self._away[places] = away.min(axis=1)
        for k in np.unique(nearest):
            self._give(others[k].id, places[nearest == k])
        del self._places[node.id]
        return True

    def add(self, node: Node) -> bool:
        """Add a node, if so some more places see the node nearest to them."""
        near = np.array(self._tree.query_ball_point(node.position, _REACH_M), dtype=np.int64)
        away = np.hypot(*(self._xy[near] - node.position).T)
        closer = away < self._away[near]
        places = near[closer]
        seen = self._sees(node, places)
        if seen.sum() < self._seen[places].sum() + _MIN_GAIN:
            return False
        for owner in np.unique(self._owner[places]).tolist():
            self._places[owner] = np.setdiff1d(self._places[owner], places)
        self._seen[places] = seen
        self._away[places] = away[closer]
        self._give(node.id, places)
        return True

    def unseen(self) -> Cells:
        """Indices of the places that do not see the node nearest to them."""
        return np.flatnonzero(~self._seen)

    def is_seen(self, place: int) -> bool:
        """Whether a place sees the node nearest to it."""
        return bool(self._seen[place])

    def first_seeing(self, place: int, cells: Cells) -> int:
        """Index of the first of some cells (N, 2) that a place sees; -1: none."""
        row, col = self._cells[place].tolist()
        return int(_first_clear(self._known, row, col, cells))

    def position(self, place: int) -> Array:
        """A place (2,), m."""
        return np.asarray(self._xy[place])

    def _assign(self, nodes: list[Node]) -> None:
        """Find the nearest of the nodes for each place."""
        self._places = {node.id: np.empty(0, dtype=np.int64) for node in nodes}
        if not nodes or not len(self._cells):
            return
        found = cKDTree([(node.x, node.y) for node in nodes]).query(self._xy)
        self._away = np.asarray(found[0])
        nearest = np.asarray(found[1])
        order = np.argsort(nearest, kind='stable')
        first = np.searchsorted(nearest[order], np.arange(len(nodes) + 1))
        for k, node in enumerate(nodes):
            places = order[first[k] : first[k + 1]]
            self._seen[places] = self._sees(node, places)
            self._give(node.id, places)

    def _give(self, node_id: int, places: Cells) -> None:
        self._owner[places] = node_id
        had = self._places.get(node_id, places[:0])
        self._places[node_id] = np.concatenate((had, places))

    def _candidates(self, node: Node, graph: TopologicalMap) -> list[Node]:
        """Other nodes that may be nearest to one of the places of a node with a neighbour."""
        around = [graph.nodes[i] for i in graph.neighbours(node.id) if i != node.id]
        reach_m = float(self._away[self._places[node.id]].max(initial=0.0))
        nearest_m = min(float(np.hypot(*(other.position - node.position))) for other in around)
        found = graph.nodes_near(node.x, node.y, 2.0 * reach_m + nearest_m)
        return [other for other in found if other.id != node.id]

    def _sees(self, node: Node, places: Cells) -> Mask:
        row, col = self._frame.cells_of(node.position)[0].tolist()
        return np.asarray(_lines_clear(self._known, row, col, self._cells[places]))


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
