"""Ids that stay with a place.

The global map's nodes and edges, brought up to date with what the atlas holds.
"""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.snapshot import MAX_CELL_INDEX, MAX_COUNT, MAX_ID, Field
from thinmap_ros.core.topology.atlas import Atlas
from thinmap_ros.core.topology.config import TopologyConfig
from thinmap_ros.core.topology.corners import corner_indices
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap
from thinmap_ros.core.topology.skeleton import edge_of, kind_of, node_of
from thinmap_ros.core.topology.skeleton_graph import Chain, room_along

_NEW = 0  # id of a node that has none yet
_OTHER_KIND = 0.5  # share of same_place_m by which a node of another kind counts as farther away
Cells = NDArray[np.int64]
Place = tuple[int, int]  # spot, -1; or chain, index of a corner
FIELDS = {
    # number of a spot and -1, or number of a chain and index of a corner; id of its node
    'places': Field(np.int64, ('p', 3), (1, -1, 1), (MAX_COUNT, MAX_CELL_INDEX, MAX_ID)),
    # number of a chain, id of an edge along it
    'edges': Field(np.int64, ('e', 2), 1, (MAX_COUNT, MAX_ID)),
    'next_id': Field(np.int64, (1,), 1, MAX_ID),
}
OldEdges = dict[tuple[int, int], list[Edge]]  # by the ids of their nodes, the lower one first


class Registry:
    """Which node stands for which spot or corner, and which edges for which chain.

    `map` is changed in place, and only where the atlas changed.
    """

    def __init__(self, config: TopologyConfig, lattice: GridFrame) -> None:
        self.map = TopologicalMap()
        self._config = config
        self._lattice = lattice
        self._next_id = 1
        self._nodes: dict[Place, int] = {}
        self._breaks: dict[int, list[int]] = {}
        self._edges: dict[int, list[int]] = {}
        self._pieces: dict[int, Chain] = {}
        self._heritage: tuple[list[Node], list[Edge]] = ([], [])

    def state(self) -> dict[str, NDArray[np.int64]]:
        """Which ids stand for what.

        Places (spot or chain, index, node id), edges (chain, edge id), the next id.
        """
        places = [(*place, node) for place, node in self._nodes.items()]
        edges = [(chain, edge) for chain, ids in self._edges.items() for edge in ids]
        return {
            'places': np.array(places, dtype=np.int64).reshape(-1, 3),
            'edges': np.array(edges, dtype=np.int64).reshape(-1, 2),
            'next_id': np.array([self._next_id]),
        }

    def restore(self, atlas: Atlas, state: Mapping[str, NDArray[np.int64]]) -> None:
        """Give an atlas the ids that the `state` of the registry beside it names.

        state: checked by FIELDS. Raises InputError where it does not name each place and edge once.
        """
        self._nodes = {(owner, index): node for owner, index, node in state['places'].tolist()}
        self._next_id = int(state['next_id'][0])
        used = np.concatenate([state['places'][:, 2], state['edges'][:, 1]])
        snapshot.require_unique(used, 'topology: id of a node or edge')
        last = int(used.max(initial=0))
        next_id = self._next_id
        snapshot.require(last < next_id, f'topology: next id {next_id}', f'above {last}')
        places = self._places(atlas, set(atlas.spots), set(atlas.chains))
        # Where the corners are depends on the robot's size: saved with another one, they differ.
        same = self._nodes.keys() == {place for place, _ in places}
        same = same and len(self._nodes) == len(state['places'])
        expected = f'the {len(places)} of this robot_radius_m, each once'
        snapshot.require(same, f'topology: {len(state["places"])} places with ids', expected)
        for place, node in places:
            self.map.put_node(_named(node, self._nodes[place]))
        self._restore_edges(atlas, state['edges'])

    def _restore_edges(self, atlas: Atlas, edges: NDArray[np.int64]) -> None:
        """Put the edges (chain, edge id) of an atlas whose nodes are there already into the map."""
        ids: dict[int, list[int]] = {}
        for chain, edge in edges.tolist():
            ids.setdefault(chain, []).append(edge)
        same = ids.keys() == atlas.chains.keys()
        snapshot.require(same, f'topology: edges of {len(ids)} chains', f'of {len(atlas.chains)}')
        for number in atlas.chains:
            pieces = self._pieces_of(atlas, number)
            same = len(pieces) == len(ids[number])
            snapshot.require(same, f'topology: edges of chain {number}', f'{len(pieces)} of them')
            self._edges[number] = ids[number]
            for edge_id, (a, b, piece) in zip(ids[number], pieces, strict=True):
                self.map.put_edge(edge_of(edge_id, a, b, piece, self._lattice))
                self._pieces[edge_id] = piece

    def skip(self, count: int) -> None:
        """Never give the next so many ids."""
        self._next_id += count

    def inherit(self, other: 'Registry', nodes: list[Node]) -> None:
        """Let the next `refresh` name places and edges after those of another registry.

        Its nodes have moved meanwhile.
        """
        self._next_id = other._next_id
        self._heritage = nodes, list(other.map.edges.values())
        self._pieces = {edge: other._pieces[edge] for edge in other.map.edges}

    def refresh(self, atlas: Atlas) -> bool:
        """Follow the changes of the atlas since the last call; returns whether there were any.

        A new node gets the id of a removed one that lay within node_match_radius_m: nearest pairs
        first, and one of another kind counts as farther away unless it was in the same cell.
        An edge between two nodes keeps its id.
        """
        spots, chains = atlas.take_changes()
        changed = bool(spots or chains)
        old: OldEdges = {}
        for edge in self._withdraw_edges(chains) + self._heritage[1]:
            old.setdefault((min(edge.a, edge.b), max(edge.a, edge.b)), []).append(edge)
        old_nodes = self._withdraw_nodes(atlas, spots, chains) + self._heritage[0]
        self._heritage = [], []
        places = self._places(atlas, spots, chains)
        self._name([(place, node) for place, node in places if place not in self._nodes], old_nodes)
        for place, node in places:
            self.map.put_node(_named(node, self._nodes[place]))
        for number in sorted(chains & atlas.chains.keys()):
            self._put_edges(atlas, number, old)
        for left in old.values():
            for edge in left:
                del self._pieces[edge.id]
        return changed

    def _withdraw_edges(self, chains: set[int]) -> list[Edge]:
        """Take the edges of chains that changed out of the map."""
        old = [self.map.edges[edge] for number in chains for edge in self._edges.pop(number, [])]
        for edge in old:
            self.map.drop_edge(edge.id)
        return old

    def _withdraw_nodes(self, atlas: Atlas, spots: set[int], chains: set[int]) -> list[Node]:
        """Take nodes of spots that are gone, and corners of changed chains, out of the map."""
        places = [(spot, -1) for spot in spots - atlas.spots.keys()]
        places += [(number, k) for number in chains for k in self._breaks.pop(number, [])]
        old = [
            self.map.nodes[self._nodes.pop(place)]
            for place in sorted(places)
            if place in self._nodes
        ]
        for node in old:
            self.map.drop_node(node.id)
        return old

    def _places(self, atlas: Atlas, spots: set[int], chains: set[int]) -> list[tuple[Place, Node]]:
        """Spots and corners that are new or may have changed, as nodes yet without id."""
        places = []
        for spot in sorted(spots & atlas.spots.keys()):
            cell = atlas.spots[spot].cell
            squared = atlas.spots[spot].squared
            places.append(
                ((spot, -1), node_of(_NEW, kind_of(atlas, spot), cell, squared, self._lattice))
            )
        radius = self._config.robot_radius_m / self._lattice.resolution
        for number in sorted(chains & atlas.chains.keys()):
            chain = atlas.chains[number]
            self._breaks[number] = corner_indices(chain.cells, room_along(chain, radius)).tolist()
            for k in self._breaks[number]:
                row, col = chain.cells[k].tolist()
                node = node_of(
                    _NEW, NodeKind.CORNER, (row, col), int(chain.squared[k]), self._lattice
                )
                places.append(((number, k), node))
        return places

    def _name(self, fresh: list[tuple[Place, Node]], old: list[Node]) -> None:
        """Give ids to new places.

        Those of old nodes where they continue them, new ones to the rest.
        """
        for i, j in self._continued([node for _, node in fresh], old):
            self._nodes[fresh[i][0]] = old[j].id
        for place, _ in fresh:
            if place not in self._nodes:
                self._nodes[place] = self._new_id()

    def _continued(self, fresh: list[Node], old: list[Node]) -> list[tuple[int, int]]:
        """Pairs (index of a new node, index of the old one that it continues), each used once."""
        if not fresh or not old:
            return []
        new_xy, old_xy = (np.array([(node.x, node.y) for node in nodes]) for nodes in (fresh, old))
        fresh_kinds, old_kinds = (np.array([n.kind for n in nodes]) for nodes in (fresh, old))
        kinds = fresh_kinds[:, None] != old_kinds
        distance = np.hypot(*np.moveaxis(new_xy[:, None] - old_xy, 2, 0))
        limit = self._config.node_match_radius_m
        moved = distance > 0.1 * self._lattice.resolution
        cost = distance + (_OTHER_KIND * limit) * (kinds & moved)
        pairs = np.argwhere(distance <= limit)
        used_new: set[int] = set()
        used_old: set[int] = set()
        found = []
        for i, j in pairs[np.argsort(cost[pairs[:, 0], pairs[:, 1]], kind='stable')].tolist():
            if i not in used_new and j not in used_old:
                used_new.add(i)
                used_old.add(j)
                found.append((i, j))
        return found

    def _put_edges(self, atlas: Atlas, number: int, old: OldEdges) -> None:
        """Put the edges of a chain into the map.

        Each takes over the id of an old one between the same nodes.
        """
        self._edges[number] = []
        for a, b, piece in self._pieces_of(atlas, number):
            edge = self._edge(a, b, piece, old)
            self.map.put_edge(edge)
            self._edges[number].append(edge.id)

    def _pieces_of(self, atlas: Atlas, number: int) -> list[tuple[int, int, Chain]]:
        """The pieces of a chain between its nodes, and the ids of these."""
        chain = atlas.chains[number]
        breaks = self._breaks[number]
        ids = [
            self._nodes[chain.a, -1],
            *(self._nodes[number, k] for k in breaks),
            self._nodes[chain.b, -1],
        ]
        stops = [0, *breaks, len(chain.cells) - 1]
        ends = zip(pairwise(ids), pairwise(stops), strict=True)
        return [(a, b, chain.part(first, last)) for (a, b), (first, last) in ends]

    def _edge(self, a: int, b: int, piece: Chain, old: OldEdges) -> Edge:
        """The edge along a piece of chain.

        An old one if it ran just there, else a new one, with an old id if any.
        """
        same = old.get((min(a, b), max(a, b)), [])
        for k, edge in enumerate(same):
            known = self._pieces[edge.id]
            if edge.a == a and _is_same(known.cells, known.squared, piece.cells, piece.squared):
                return same.pop(k)
        edge_id = 0
        if same:
            middle = piece.cells[len(piece.cells) // 2]
            middles = [self._pieces[edge.id].cells[len(edge.path) // 2] for edge in same]
            edge_id = same.pop(int(np.abs(np.array(middles) - middle).sum(axis=1).argmin())).id
        edge = edge_of(edge_id or self._new_id(), a, b, piece, self._lattice)
        self._pieces[edge.id] = piece
        return edge

    def _new_id(self) -> int:
        self._next_id += 1
        return self._next_id - 1


def _named(node: Node, number: int) -> Node:
    return Node(number, node.kind, node.x, node.y, node.clearance_m)


@kernel
def _is_same(cells: Cells, squared: Cells, other_cells: Cells, other_squared: Cells) -> bool:
    """Whether two pieces have the same cells (K, 2) and smallest squared clearances (K,)."""
    if cells.shape[0] != other_cells.shape[0]:
        return False
    for k in range(cells.shape[0]):
        if cells[k, 0] != other_cells[k, 0] or cells[k, 1] != other_cells[k, 1]:
            return False
    return bool(squared.min() == other_squared.min())
