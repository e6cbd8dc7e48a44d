"""Local area: selection of the features near the robot by the topological map.

Features are stored at the nodes near which they were observed. The local area consists of the
features at the robot's node and at the nodes connected to it, except those out of view.
Source: EKF-SLAM/TI paper section 4, Fig. 6-8.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_ID, Field
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap

FIELDS = {
    'stored_at': Field(np.int64, ('s', 2), 1, MAX_ID),
    'node_ids': Field(np.int64, ('a',), 1, MAX_ID),
    'node_places': Field(np.float64, ('a', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
}


@dataclass(frozen=True)
class LocalAreaConfig:
    """Which nodes make the local area.

    path_m: largest path length to a node, except to the first one on each edge; beside_m: nodes
    nearer than this are never behind the robot; list_m: radius in which nodes are listed, unless
    none is near; near_m: tolerance within which nodes are as near as the nearest; turn_m_rad:
    distance that costs as much as a rotation by a radian; trail_m: distance between nodes along the
    robot's path, until a topology is set.
    """

    path_m: float = 8.0
    beside_m: float = 2.0
    list_m: float = 12.0
    near_m: float = 1.0
    turn_m_rad: float = 0.5
    trail_m: float = 3.0


class LocalArea:
    """Features by the topological nodes near which they were observed.

    Until `set_topology` is called with nodes, nodes are placed along the robot's path.
    """

    def __init__(self, config: LocalAreaConfig | None = None) -> None:
        self._config = config or LocalAreaConfig()
        self._topology = TopologicalMap()
        self._trail: _Trail | None = _Trail(self._topology, self._config.trail_m)
        self._features_at: dict[int, set[int]] = {}
        self._nodes_of: dict[int, set[int]] = {}
        # Ids and positions of the nodes that could be nearest, and the position (2,) of the robot
        # when they were listed.
        self._ids: list[int] = []
        self._places: Array = np.empty((0, 2))
        self._listed_at: Array = np.full(2, np.inf)
        # Positions of the nodes with features when they were last listed, and their map.
        self._place_of: dict[int, Array] = {}
        self._listed: TopologicalMap | None = None

    def set_topology(self, topology: TopologicalMap) -> None:
        """Set the topological map: a newer version of the same map, or the same object, changed.

        Features at removed nodes move to other nodes when nodes are next listed.
        """
        if not topology.nodes:
            return
        before = self._topology
        trail = self._trail
        self._topology = topology
        self._trail = None
        if trail is not None:
            self._place_of = {i: before.nodes[i].position for i in self._features_at}
            self._hand_over(list(self._features_at))
            self._listed_at = np.full(2, np.inf)

    def state(self) -> dict[str, NDArray[Any]]:
        """Stored features (K, 2) as (feature, node), and the ids and positions of the nodes."""
        nodes = self._topology.nodes
        stored = [(f, n) for f, at in self._nodes_of.items() for n in sorted(at) if n in nodes]
        ids = sorted({n for _, n in stored})
        return {
            'stored_at': np.array(stored, dtype=np.int64).reshape(-1, 2),
            'node_ids': np.array(ids, dtype=np.int64),
            'node_places': np.array([nodes[n].position for n in ids]).reshape(-1, 2),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore a saved `state`; its nodes are used until a topology is set.

        state: checked by FIELDS. Raises InputError if features are stored at unknown nodes.
        """
        snapshot.require_unique(state['node_ids'], 'features: node')
        used = state['stored_at'][:, 1]
        snapshot.require_known(used, state['node_ids'], 'features: stored at node')
        ids = state['node_ids'].tolist()
        places = state['node_places']
        if not ids:
            return
        nodes = [
            Node(i, NodeKind.CORNER, x, y, 0.0)
            for i, (x, y) in zip(ids, places.tolist(), strict=True)
        ]
        self._topology = TopologicalMap(nodes)
        self._trail = None
        self._ids = ids
        self._places = places
        self._place_of = dict(zip(ids, places, strict=True))
        for feature_id, node_id in state['stored_at'].tolist():
            self._put(feature_id, node_id)

    def nodes_of(self, feature_id: int) -> list[int]:
        """Ids of the nodes at which a feature is stored."""
        return sorted(self._nodes_of.get(feature_id, ()))

    def store(self, T_map_base: Array, feature_ids: list[int]) -> None:
        """Store features that were observed from a pose (3,) at its nearest node."""
        if self._trail is not None and self._trail.follow(T_map_base):
            self._list_nodes(T_map_base)
        node = self._node_at(T_map_base)
        if node is not None:
            for feature_id in feature_ids:
                self._put(feature_id, node)

    def remove(self, feature_id: int, heir: int | None = None) -> None:
        """Remove a feature; if it was merged into another one, heir, store that instead."""
        for node_id in self._nodes_of.pop(feature_id, set()):
            self._features_at[node_id].discard(feature_id)
            if heir is not None:
                self._put(heir, node_id)

    def features_near(self, T_map_base: Array, half_view_rad: float) -> set[int]:
        """Features of the local area at a pose (3,).

        half_view_rad: half of the laser's field of view.
        """
        here = self._node_at(T_map_base)
        if here is None:
            return set()
        found = set(self._features_at.get(here, ()))
        for node_id in self._along_edges(here):
            bearing, distance = _from_robot(T_map_base, self._topology.nodes[node_id].position)
            if abs(bearing) <= half_view_rad or distance <= self._config.beside_m:
                found |= self._features_at.get(node_id, set())
        return found

    def _along_edges(self, here: int) -> list[int]:
        """Nodes connected to a node: its neighbours, and others within reach along edges."""
        lengths = {here: 0.0}
        open_ids = [here]
        while open_ids:
            node_id = min(open_ids, key=lengths.__getitem__)
            open_ids.remove(node_id)
            for edge in self._topology.edges_at(node_id):
                length = lengths[node_id] + edge.length_m
                if node_id != here and length > self._config.path_m:
                    continue
                other = edge.other(node_id)
                if other not in lengths:
                    open_ids.append(other)
                lengths[other] = min(length, lengths.get(other, length))
        return [i for i in lengths if i != here]

    def _node_at(self, T_map_base: Array) -> int | None:
        """Nearest node; among nodes about as near, the one with the smallest bearing."""
        if math.dist(T_map_base[:2], self._listed_at) > self._config.near_m:
            self._list_nodes(T_map_base)
        distances = np.hypot(*(self._places - T_map_base[:2]).T)
        cost = math.inf
        best = None
        for i in np.flatnonzero(distances <= distances.min(initial=np.inf) + self._config.near_m):
            bearing, distance = _from_robot(T_map_base, self._places[i])
            if (
                distance + self._config.turn_m_rad * abs(bearing) < cost
                and self._ids[i] in self._topology.nodes
            ):
                cost = distance + self._config.turn_m_rad * abs(bearing)
                best = self._ids[i]
        return best

    def _list_nodes(self, T_map_base: Array) -> None:
        """List the nodes near a pose (3,).

        Called once per metre; its time does not depend on the size of the map if nodes are near.
        """
        topology = self._topology
        (x, y) = T_map_base[:2].tolist()
        near = topology.nodes_near(x, y, self._config.list_m)
        # After the next metre the nearest node may be a metre farther away, and nodes about as near
        # another metre.
        nearest = min((math.hypot(n.x - x, n.y - y) for n in near), default=math.inf)
        sure = nearest + 3.0 * self._config.near_m
        if sure > self._config.list_m:
            near = list(topology.nodes.values())
        self._ids = [node.id for node in near]
        self._places = np.array([(n.x, n.y) for n in near]).reshape(-1, 2)
        self._listed_at = T_map_base[:2].copy()
        gone = self._features_at.keys() - topology.nodes.keys()
        self._note_places(near if topology is self._listed else list(topology.nodes.values()))
        self._listed = topology
        self._hand_over(sorted(gone))

    def _note_places(self, nodes: list[Node]) -> None:
        """Store the positions of nodes with features.

        In a map that is changed in place, distant nodes do not move.
        """
        self._place_of.update(
            (node.id, node.position) for node in nodes if node.id in self._features_at
        )

    def _hand_over(self, gone: list[int]) -> None:
        """Move the features of removed nodes to the nodes nearest to their former positions."""
        features = {node_id: self._features_at.pop(node_id) for node_id in gone}
        for node_id, left in features.items():
            for feature_id in left:
                self._nodes_of[feature_id].discard(node_id)
        for node_id in gone:
            x, y = self._place_of.pop(node_id).tolist()
            heir = self._topology.nearest_node(x, y)
            if heir is not None:
                for feature_id in features[node_id]:
                    self._put(feature_id, heir.id)

    def _put(self, feature_id: int, node_id: int) -> None:
        if node_id not in self._features_at:
            self._place_of[node_id] = self._topology.nodes[node_id].position
        self._features_at.setdefault(node_id, set()).add(feature_id)
        self._nodes_of.setdefault(feature_id, set()).add(node_id)


class _Trail:
    """Places nodes along the robot's path in a topological map; returning to one reuses it."""

    def __init__(self, topology: TopologicalMap, spacing_m: float) -> None:
        self._map = topology
        self._spacing_m = spacing_m
        self._last: int | None = None
        self._next_id = 1

    def follow(self, T_map_base: Array) -> bool:
        """Update by the robot's pose (3,); returns whether nodes or edges were added."""
        x = float(T_map_base[0])
        y = float(T_map_base[1])
        node = self._map.nearest_node(x, y)
        last = self._last
        known = len(self._map.nodes) + len(self._map.edges)
        if node is None or math.dist(node.position, (x, y)) > self._spacing_m:
            node = Node(self._take_id(), NodeKind.CORNER, x, y, 0.0)
            self._map.put_node(node)
        if last is not None and last != node.id and node.id not in self._map.neighbours(last):
            path = np.array([self._map.nodes[last].position, node.position])
            length = math.dist(*path)
            self._map.put_edge(Edge(self._take_id(), last, node.id, path, length, 0.0))
        self._last = node.id
        return len(self._map.nodes) + len(self._map.edges) != known

    def _take_id(self) -> int:
        self._next_id += 1
        return self._next_id - 1


def _from_robot(T_map_base: Array, place: Array) -> tuple[float, float]:
    """Bearing (rad, robot frame) and distance (m) of a position (2,), map frame."""
    dx = float(place[0] - T_map_base[0])
    dy = float(place[1] - T_map_base[1])
    return wrap(math.atan2(dy, dx) - float(T_map_base[2])), math.hypot(dx, dy)
