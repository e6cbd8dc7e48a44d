"""Ids of a whole topological map that stay with their places when it is built again."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from thinmap_ros.core.topology.graph import Edge, Node, TopologicalMap

_OTHER_KIND = 0.5  # share of the match radius by which a node of another kind counts as farther


class StableIds:
    """Renames the nodes and edges of maps of the same place.

    A node continues the nearest earlier one within match_radius_m, m. An edge continues one between
    the same nodes, of several the one with the most similar length.
    """

    def __init__(self, match_radius_m: float) -> None:
        self.map = TopologicalMap()
        self._match_radius_m = match_radius_m
        self._next_id = 1

    def renamed(self, fresh: TopologicalMap) -> TopologicalMap:
        """The same map with the ids of the last one where it continues that."""
        ids = self._node_ids(list(fresh.nodes.values()))
        nodes = [replace(node, id=ids[node.id]) for node in fresh.nodes.values()]
        old: dict[tuple[int, int], list[Edge]] = {}
        for edge in self.map.edges.values():
            old.setdefault(_ends(edge.a, edge.b), []).append(edge)
        edges = [self._renamed_edge(edge, ids, old) for edge in fresh.edges.values()]
        self.map = TopologicalMap(nodes, edges)
        return self.map

    def _node_ids(self, fresh: list[Node]) -> dict[int, int]:
        """New id by old id of each node."""
        ids: dict[int, int] = {}
        used: set[int] = set()
        for fresh_id, old_id in self._pairs(fresh):
            if fresh_id not in ids and old_id not in used:
                ids[fresh_id] = old_id
                used.add(old_id)
        for node in fresh:
            if node.id not in ids:
                ids[node.id] = self._new_id()
        return ids

    def _pairs(self, fresh: list[Node]) -> Iterable[tuple[int, int]]:
        """Ids of a node and of an earlier one that it may continue, nearest pairs first."""
        old = list(self.map.nodes.values())
        if not fresh or not old:
            return []
        places = np.array([(node.x, node.y) for node in fresh])
        old_places = np.array([(node.x, node.y) for node in old])
        distances = np.hypot(*(places[:, None] - old_places[None]).transpose(2, 0, 1))
        kinds = np.array([node.kind for node in fresh])
        old_kinds = np.array([node.kind for node in old])
        other = kinds[:, None] != old_kinds[None]
        costs = distances + _OTHER_KIND * self._match_radius_m * other
        near = np.argwhere(distances <= self._match_radius_m)
        order = np.argsort(costs[near[:, 0], near[:, 1]], kind='stable')
        return [(fresh[i].id, old[j].id) for i, j in near[order].tolist()]

    def _renamed_edge(
        self, edge: Edge, ids: dict[int, int], old: dict[tuple[int, int], list[Edge]]
    ) -> Edge:
        a = ids[edge.a]
        b = ids[edge.b]
        same = old.get(_ends(a, b), [])
        if not same:
            return replace(edge, id=self._new_id(), a=a, b=b)
        best = min(same, key=lambda known: abs(known.length_m - edge.length_m))
        same.remove(best)
        return replace(edge, id=best.id, a=a, b=b)

    def _new_id(self) -> int:
        self._next_id += 1
        return self._next_id - 1


def _ends(a: int, b: int) -> tuple[int, int]:
    return min(a, b), max(a, b)
