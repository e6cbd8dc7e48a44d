"""Topological information: which features matter where the robot is.

Features are stored at the nodes near which they were seen. The local area of a robot are the
features of its node and of the nodes that edges join to it, but for those that it cannot see.
Source: EKF-SLAM/TI paper section 4, Fig. 6-8.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_ID, Field
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap

_LISTED_M = 12.0  # nodes are noted up to here, unless none is near
_AS_NEAR_M = 1.0  # nodes farther than the nearest by no more than this are about as near
_REACH_M = 8.0  # nodes along edges matter up to here, and the first one of every edge
_BESIDE_M = 2.0  # what lies this near is not behind the robot
_TURN_M_RAD = 0.5  # way that the robot could have gone while it turns by a radian
FIELDS = {
    'stored_at': Field(np.int64, ('s', 2), 1, MAX_ID),
    'node_ids': Field(np.int64, ('a',), 1, MAX_ID),
    'node_places': Field(np.float64, ('a', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
}
_TRAIL_M = 3.0  # where no topology is known, the robot's own way is one, with nodes this far apart


class LocalArea:
    """Features by the topological nodes near which they were seen.

    Until `set_topology` has given it nodes, nodes are laid along the robot's way.
    """

    def __init__(self) -> None:
        self._topology = TopologicalMap()
        self._trail: _Trail | None = _Trail(self._topology)
        self._features_at: dict[int, set[int]] = {}
        self._nodes_of: dict[int, set[int]] = {}
        # Ids and places of the nodes that could be nearest,
        # as they were when the robot was at a place (2,).
        self._ids: list[int] = []
        self._places: Array = np.empty((0, 2))
        self._listed_at: Array = np.full(2, np.inf)
        # Where the nodes with features were when they were last listed, and the map of then.
        self._place_of: dict[int, Array] = {}
        self._listed: TopologicalMap | None = None

    def set_topology(self, topology: TopologicalMap) -> None:
        """Take the topological map in use from now on.

        It is a newer state of the same map, or the map itself, changed.

        Either way features at nodes that are no more are handed on when nodes are listed next.
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
        """Features by node (K, 2) as (feature, node), and these nodes with their places."""
        nodes = self._topology.nodes
        stored = [(f, n) for f, at in self._nodes_of.items() for n in sorted(at) if n in nodes]
        ids = sorted({n for _, n in stored})
        return {
            'stored_at': np.array(stored, dtype=np.int64).reshape(-1, 2),
            'node_ids': np.array(ids, dtype=np.int64),
            'node_places': np.array([nodes[n].position for n in ids]).reshape(-1, 2),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take up the `state` of another area; once a topology is set, it replaces these nodes.

        state: checked by FIELDS. Raises InputError where features are stored at unknown nodes.
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
        """Store features that were seen from a pose (3,) at its node."""
        if self._trail is not None and self._trail.follow(T_map_base):
            self._list_nodes(T_map_base)
        node = self._node_at(T_map_base)
        if node is not None:
            for feature_id in feature_ids:
                self._put(feature_id, node)

    def forget(self, feature_id: int, heir: int | None = None) -> None:
        """Drop a feature everywhere.

        Where it has become another one, heir, that is stored in its place.
        """
        for node_id in self._nodes_of.pop(feature_id, set()):
            self._features_at[node_id].discard(feature_id)
            if heir is not None:
                self._put(heir, node_id)

    def features_near(self, T_map_base: Array, half_view_rad: float) -> set[int]:
        """Features of the local area at a pose (3,).

        half_view_rad: how far to either side the laser sees.
        """
        here = self._node_at(T_map_base)
        if here is None:
            return set()
        found = set(self._features_at.get(here, ()))
        for node_id in self._along_edges(here):
            bearing, distance = _from_robot(T_map_base, self._topology.nodes[node_id].position)
            if abs(bearing) <= half_view_rad or distance <= _BESIDE_M:
                found |= self._features_at.get(node_id, set())
        return found

    def _along_edges(self, here: int) -> list[int]:
        """Nodes that edges join to one, and those farther on within reach along edges."""
        ways = {here: 0.0}
        open_ids = [here]
        while open_ids:
            node_id = min(open_ids, key=ways.__getitem__)
            open_ids.remove(node_id)
            for edge in self._topology.edges_at(node_id):
                way = ways[node_id] + edge.length_m
                if node_id != here and way > _REACH_M:
                    continue
                if edge.other(node_id) not in ways:
                    open_ids.append(edge.other(node_id))
                ways[edge.other(node_id)] = min(way, ways.get(edge.other(node_id), way))
        return [i for i in ways if i != here]

    def _node_at(self, T_map_base: Array) -> int | None:
        """The nearest node.

        Of those about as near, the one that the robot reaches sooner as it is headed.
        """
        if math.dist(T_map_base[:2], self._listed_at) > _AS_NEAR_M:
            self._list_nodes(T_map_base)
        distances = np.hypot(*(self._places - T_map_base[:2]).T)
        cost = math.inf
        best = None
        for i in np.flatnonzero(distances <= distances.min(initial=np.inf) + _AS_NEAR_M):
            bearing, distance = _from_robot(T_map_base, self._places[i])
            if (
                distance + _TURN_M_RAD * abs(bearing) < cost
                and self._ids[i] in self._topology.nodes
            ):
                cost = distance + _TURN_M_RAD * abs(bearing)
                best = self._ids[i]
        return best

    def _list_nodes(self, T_map_base: Array) -> None:
        """Note the nodes around anew.

        Once a metre, and only as far as it takes, whatever the size of the building.
        """
        topology = self._topology
        (x, y) = T_map_base[:2].tolist()
        near = topology.nodes_near(x, y, _LISTED_M)
        # After the next metre the nearest node may be one more away, and those about as near
        # another one.
        nearest = min((math.hypot(n.x - x, n.y - y) for n in near), default=math.inf)
        sure = nearest + 2.0 * _AS_NEAR_M + _AS_NEAR_M
        if sure > _LISTED_M:
            near = list(topology.nodes.values())
        self._ids = [node.id for node in near]
        self._places = np.array([(n.x, n.y) for n in near]).reshape(-1, 2)
        self._listed_at = T_map_base[:2].copy()
        gone = self._features_at.keys() - topology.nodes.keys()
        self._note_places(near if topology is self._listed else list(topology.nodes.values()))
        self._listed = topology
        self._hand_over(sorted(gone))

    def _note_places(self, nodes: list[Node]) -> None:
        """Note where nodes with features are.

        Of a map that is changed in place, those far off stay where they were.
        """
        self._place_of.update(
            (node.id, node.position) for node in nodes if node.id in self._features_at
        )

    def _hand_over(self, gone: list[int]) -> None:
        """Features of nodes that are no more go to the nodes nearest to where those were."""
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
    """Nodes along the robot's way, in a map that is given.

    Coming back to one, the robot is there again.
    """

    def __init__(self, topology: TopologicalMap) -> None:
        self._map = topology
        self._last: int | None = None
        self._next_id = 1

    def follow(self, T_map_base: Array) -> bool:
        """Take in where the robot is now, (3,); whether nodes or edges came of it."""
        x = float(T_map_base[0])
        y = float(T_map_base[1])
        node = self._map.nearest_node(x, y)
        last = self._last
        known = len(self._map.nodes) + len(self._map.edges)
        if node is None or math.dist(node.position, (x, y)) > _TRAIL_M:
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
    """Bearing (rad, robot frame) and distance of a place (2,)."""
    dx = float(place[0] - T_map_base[0])
    dy = float(place[1] - T_map_base[1])
    return wrap(math.atan2(dy, dx) - float(T_map_base[2])), math.hypot(dx, dy)
