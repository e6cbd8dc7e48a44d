"""Management of the line features: added, extended, merged, removed, and selected by place.

Source: EKF-SLAM/TI paper sections 2 and 4. The paper does not define when features are added or
removed. Here a feature is added after several observations, so that clutter does not enter the
state, and removed after several consecutive scans saw through it.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.ekf_slam.ekf import CompressedEkf, EkfSlam
from thinmap_ros.core.ekf_slam.features import (
    FeatureTrack,
    LineFeature,
    Lines,
    as_seen,
    ends_of,
    interval,
    normals_of,
    sides_of,
    tangents_of,
)
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, compose, transform_points, wrap
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_COUNT, MAX_ID, Field
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap

# Only pairs nearer than this are tested by their Mahalanobis distance.
_NEAR_M = 0.5
_NEAR_RAD = math.radians(15.0)


@dataclass(frozen=True)
class AssociationConfig(Config):
    """Parameters of data association."""

    gate: float = parameter(
        5.99,
        'Largest squared Mahalanobis distance between a line and a feature (2 degrees of freedom: '
        '95 %). Raise it if features double, lower it if different walls are merged.',
        low=0.1,
        high=50.0,
    )
    max_gap_m: float = parameter(
        3.0,
        'Largest gap along the line between an observed segment and the feature that it extends '
        '(m); at least the width of a door. Lower it if collinear walls of different rooms merge.',
        low=0.0,
        high=20.0,
    )


@dataclass(frozen=True)
class FeatureConfig(Config):
    """Parameters of feature management."""

    min_observations: int = parameter(
        4,
        'Number of observations after which a line stays in the map; it corrects the pose from the '
        'first one on. Raise it against features on moving objects, lower it for walls that are '
        'seen in passing.',
        low=1,
        high=100,
    )
    candidate_max_misses: int = parameter(
        15,
        'Number of observations without a match after which a line that has too few is dropped. '
        'Raise it for walls that are often hidden.',
        low=1,
        high=10_000,
    )


@dataclass(frozen=True, eq=False)
class Associations:
    """Nearest feature of each line of a scan, and whether several features pass the gate.

    Both (K,); index: -1 if no feature passes the gate.
    """

    index: NDArray[np.int64]
    ambiguous: NDArray[np.bool_]


def associate(
    ekf: EkfSlam,
    features: list[FeatureTrack],
    lines: Lines,
    laser_map: Array,
    config: AssociationConfig,
) -> Associations:
    """Associate each line of a scan with its nearest feature, independently of other lines.

    laser_map (2,): position of the laser, map frame. Ambiguous lines should be associated again
    after the others have updated the pose, so that the scan is considered jointly (the idea of
    Neira and Tardos, "Data association in stochastic mapping using the joint compatibility test",
    2001). Collinear walls of different rooms are on one infinite line, so the observed segments
    have to overlap or be near, too. The two faces of a thin wall are two features, each observed
    from its own side.
    Source: EKF-SLAM/TI paper eq. (13), with the sign of the gate corrected: v' S^-1 v <= 5.99, two
    degrees of freedom, 95 %.
    """
    chosen = np.full(len(lines), -1, dtype=np.int64)
    passing = np.zeros(len(lines), dtype=np.int64)
    if not (features and len(lines)):
        return Associations(chosen, passing > 1)
    ends_map = transform_points(ekf.pose, lines.ends.reshape(-1, 2)).reshape(-1, 2, 2)
    pairs = np.argwhere(meeting(ekf.lines, features, ends_map, laser_map, config.max_gap_m))
    best = np.full(len(lines), np.inf)
    for k, index in pairs:
        expected, spread, _ = ekf.innovations(int(index))
        v = lines.z[k] - expected
        v[1] = wrap(float(v[1]))
        distance = mahalanobis(v, spread + lines.covariances[k])
        if distance > config.gate:
            continue
        passing[k] += 1
        if distance <= best[k]:
            best[k] = distance
            chosen[k] = index
    return Associations(chosen, passing > 1)


def meeting(
    lines_map: Array, features: list[FeatureTrack], ends_map: Array, seen_from: Array, gap_m: float
) -> NDArray[np.bool_]:
    """Whether segments with ends (K, 2, 2), map frame, may be part of features, (K, N).

    Direction and offset agree roughly, the intervals along the line are at most gap_m apart, and
    the laser, at seen_from (2,), is on the side from which the feature was first observed.
    """
    offsets = np.abs(ends_map.mean(axis=1) @ normals_of(lines_map).T - lines_map[:, 0])
    chords = ends_map[:, 1] - ends_map[:, 0]
    rise = np.abs(chords @ normals_of(lines_map).T) / np.maximum(np.hypot(*chords.T), 1e-9)[:, None]
    along = ends_map @ tangents_of(lines_map).T
    low = np.array([f.low for f in features])
    high = np.array([f.high for f in features])
    gaps = np.maximum(low - along.max(axis=1), along.min(axis=1) - high)
    first_seen_from = np.array([f.first_seen_from for f in features]).reshape(-1, 2)
    facing = sides_of(lines_map, seen_from) == sides_of(lines_map, first_seen_from)
    return np.asarray(
        (offsets <= _NEAR_M) & (rise <= math.sin(_NEAR_RAD)) & (gaps <= gap_m) & facing
    )


def mahalanobis(v: Array, S: Array) -> float:
    """Squared Mahalanobis distance v' S^-1 v, v (2,), S (2, 2).

    Infinite if S is not positive definite.
    """
    determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    if not (determinant > 0.0 and S[0, 0] > 0.0):
        return math.inf
    squares = v[0] * v[0] * S[1, 1] + v[1] * v[1] * S[0, 0] - v[0] * v[1] * (S[0, 1] + S[1, 0])
    return float(squares / determinant)


# Of features that a scan sees through.
_BEYOND_M = 0.3  # a beam that ends this far behind a feature has passed through it
_END_M = 0.15  # margin at the ends of a feature where beams are ignored
_MIN_BEAMS = 8
_SHARE = 0.7  # smallest share of passing beams among those that reach the feature
_FLATTEST = 0.17  # smallest sine of the angle between beam and wall


def seen_through(
    scan: Scan, T_map_base: Array, lines: Array, features: list[FeatureTrack]
) -> NDArray[np.bool_]:
    """Whether the scan passes through each feature with its line (N, 2), map frame; (N,).

    It is removed then, as an opened door. Most of the beams that should hit the feature, and enough
    of them, end well behind it. Beams without return are ignored: glass and black walls cause them,
    too.
    """
    if not features:
        return np.zeros(0, dtype=np.bool_)
    T_map_laser = compose(T_map_base, scan.T_base_laser)
    angles = scan.angles_rad[scan.hit] + T_map_laser[2]
    beams = np.column_stack([np.cos(angles), np.sin(angles)])
    towards = beams @ normals_of(lines).T
    with np.errstate(divide='ignore', invalid='ignore'):
        expected = (lines[:, 0] - normals_of(lines) @ T_map_laser[:2]) / towards
        along = tangents_of(lines) @ T_map_laser[:2] + expected * (beams @ tangents_of(lines).T)
    low, high = np.array([(f.low, f.high) for f in features]).T
    aimed = (
        (expected > 0.0)
        & (np.abs(towards) > _FLATTEST)
        & (along > low + _END_M)
        & (along < high - _END_M)
    )
    ranges = scan.ranges_m[scan.hit][:, None]
    through = (aimed & (ranges > expected + _BEYOND_M)).sum(axis=0)
    reaching = (aimed & (ranges > expected - _BEYOND_M)).sum(axis=0)
    return np.asarray((through >= _MIN_BEAMS) & (through > _SHARE * reaching))


AREA_FIELDS = {
    'stored_at': Field(np.int64, ('s', 2), 1, MAX_ID),
    'node_ids': Field(np.int64, ('a',), 1, MAX_ID),
    'node_places': Field(np.float64, ('a', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
}


# Of the local area: largest path length to a node, except to the first one on each edge.
_PATH_M = 8.0
_BESIDE_M = 2.0  # nodes nearer than this are never behind the robot
_LIST_M = 12.0  # radius in which nodes are listed, unless none is near
_AS_NEAR_M = 1.0  # tolerance within which nodes are as near as the nearest
_TURN_M_RAD = 0.5  # distance that costs as much as a rotation by a radian
_TRAIL_M = 3.0  # between nodes along the robot's path, until a topology is set


class LocalArea:
    """Features by the topological nodes near which they were observed.

    The local area consists of the features at the robot's node and at the nodes connected to it,
    except those out of view. Until `set_topology` is called with nodes, nodes are placed along the
    robot's path.
    Source: EKF-SLAM/TI paper section 4, Fig. 6-8.
    """

    def __init__(self) -> None:
        self._topology = TopologicalMap()
        self._trail: _Trail | None = _Trail(self._topology)
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

    def state(self, ids: set[int]) -> dict[str, NDArray[Any]]:
        """Where these features are stored (K, 2), (feature, node); ids and places of the nodes."""
        nodes = self._topology.nodes
        stored = [(i, n) for i in sorted(ids) for n in self.nodes_of(i) if n in nodes]
        used = sorted({n for _, n in stored})
        return {
            'stored_at': np.array(stored, dtype=np.int64).reshape(-1, 2),
            'node_ids': np.array(used, dtype=np.int64),
            'node_places': np.array([nodes[n].position for n in used]).reshape(-1, 2),
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
            if abs(bearing) <= half_view_rad or distance <= _BESIDE_M:
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
                if node_id != here and length > _PATH_M:
                    continue
                other = edge.other(node_id)
                if other not in lengths:
                    open_ids.append(other)
                lengths[other] = min(length, lengths.get(other, length))
        return [i for i in lengths if i != here]

    def _node_at(self, T_map_base: Array) -> int | None:
        """Nearest node; among nodes about as near, the one with the smallest bearing."""
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
        """List the nodes near a pose (3,).

        Called once per metre; its time does not depend on the size of the map if nodes are near.
        """
        topology = self._topology
        (x, y) = T_map_base[:2].tolist()
        near = topology.nodes_near(x, y, _LIST_M)
        # After the next metre the nearest node may be a metre farther away, and nodes about as near
        # another metre.
        nearest = min((math.hypot(n.x - x, n.y - y) for n in near), default=math.inf)
        sure = nearest + 3.0 * _AS_NEAR_M
        if sure > _LIST_M:
            near = list(topology.nodes.values())
        self._ids = [node.id for node in near]
        self._places = np.array([(n.x, n.y) for n in near]).reshape(-1, 2)
        self._listed_at = T_map_base[:2].copy()
        gone = self._features_at.keys() - topology.nodes.keys()
        # In a map that is changed in place, distant nodes do not move.
        changed = near if topology is self._listed else list(topology.nodes.values())
        self._place_of.update((n.id, n.position) for n in changed if n.id in self._features_at)
        self._listed = topology
        self._hand_over(sorted(gone))

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

    def __init__(self, topology: TopologicalMap) -> None:
        self._map = topology
        self._last: int | None = None
        self._ids = count(1)

    def follow(self, T_map_base: Array) -> bool:
        """Update by the robot's pose (3,); returns whether nodes or edges were added."""
        x = float(T_map_base[0])
        y = float(T_map_base[1])
        node = self._map.nearest_node(x, y)
        last = self._last
        known = len(self._map.nodes) + len(self._map.edges)
        if node is None or math.dist(node.position, (x, y)) > _TRAIL_M:
            node = Node(next(self._ids), NodeKind.CORNER, x, y, 0.0)
            self._map.put_node(node)
        if last is not None and last != node.id and node.id not in self._map.neighbours(last):
            path = np.array([self._map.nodes[last].position, node.position])
            length = math.dist(*path)
            self._map.put_edge(Edge(next(self._ids), last, node.id, path, length, 0.0))
        self._last = node.id
        return len(self._map.nodes) + len(self._map.edges) != known


def _from_robot(T_map_base: Array, place: Array) -> tuple[float, float]:
    """Bearing (rad, robot frame) and distance (m) of a position (2,), map frame."""
    dx = float(place[0] - T_map_base[0])
    dy = float(place[1] - T_map_base[1])
    return wrap(math.atan2(dy, dx) - float(T_map_base[2])), math.hypot(dx, dy)


# Standard deviations of real walls about a straight line; with less, the filter is overconfident.
WALL_FLATNESS_M = 0.02

_WALL_FLATNESS_RAD = 0.006

_ONE_WALL_M = 3.0 * WALL_FLATNESS_M  # largest distance between two lines that may be one wall

_NEW = 3.0  # times the gate: the distance from which on a line is a new one (99.99 %)

MAX_MISSES = 5  # consecutive scans through a feature until it is removed: a door has opened

_SPARE = 8  # additional features that may stay in the local area

_ROUNDING = 1e-6  # relative rounding error that is accepted in a covariance

FIELDS = {
    'ids': Field(np.int64, ('n',), 1, MAX_ID),
    'lines': Field(
        np.float64, ('n', 2), (-MAX_COORDINATE_M, -4.0 * np.pi), (MAX_COORDINATE_M, 4.0 * np.pi)
    ),
    'line_covariance': Field(np.float64, ('2n', '2n'), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    # low and high end along the line, x and y of first_seen_from, misses
    'spans': Field(
        np.float64,
        ('n', 5),
        (
            -2.0 * MAX_COORDINATE_M,
            -2.0 * MAX_COORDINATE_M,
            -MAX_COORDINATE_M,
            -MAX_COORDINATE_M,
            0.0,
        ),
        (
            2.0 * MAX_COORDINATE_M,
            2.0 * MAX_COORDINATE_M,
            MAX_COORDINATE_M,
            MAX_COORDINATE_M,
            float(MAX_COUNT),
        ),
    ),
    'next_id': Field(np.int64, (), 1, MAX_ID),
    **AREA_FIELDS,
}


class FeatureMap:
    """All features by id, and the local area of the filter.

    With local areas (EKF-SLAM/TI) association and update use the features of the local area;
    without, they use all. A line is in the filter from its first observation on, so that a robot
    that turns towards walls it has not seen yet does not turn by odometry alone; it is a feature of
    the map once it has been observed often enough.
    """

    def __init__(
        self, config: FeatureConfig, association: AssociationConfig, local_areas: bool
    ) -> None:
        self.area = LocalArea()
        self._config = config
        self._association = association
        self._local_areas = local_areas
        self._wall = np.diag(np.square([WALL_FLATNESS_M, _WALL_FLATNESS_RAD]))
        self._features: dict[int, FeatureTrack] = {}
        # Observations that those which are not in the map yet still need.
        self._awaited: dict[int, int] = {}
        # Features outside the local area that were observed, to be added to it.
        self._called: set[int] = set()
        self._next_id = 1

    def __len__(self) -> int:
        return len(self._features) - len(self._awaited)

    def state(self, ekf: CompressedEkf) -> dict[str, NDArray[Any]]:
        """All features as arrays by name, with the covariance of their lines."""
        mean, covariance = ekf.flush()
        kept = np.array([i not in self._awaited for i in ekf.ids], dtype=np.bool_)
        ids = np.array(ekf.ids, dtype=np.int64)[kept]
        features = [self._features[i] for i in ids.tolist()]
        spans = [(f.low, f.high, *f.first_seen_from, f.misses) for f in features]
        numbers = 3 + np.flatnonzero(np.repeat(kept, 2))
        return {
            'ids': ids,
            'lines': mean[numbers].reshape(-1, 2),
            'line_covariance': covariance[np.ix_(numbers, numbers)],
            'spans': np.array(spans).reshape(-1, 5),
            'next_id': np.array(self._next_id),
            **self.area.state(set(ids.tolist())),
        }

    def restore(self, ekf: CompressedEkf, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore a saved `state` into an empty map and its filter.

        state: checked by FIELDS. Raises InputError if its arrays are inconsistent.
        """
        _check_references(state)
        ids = state['ids'].tolist()
        self.area.restore(state)
        ekf.restore(ids, state['lines'], state['line_covariance'])
        self._features = {
            i: FeatureTrack(i, low, high, np.array([x, y]), int(missed))
            for i, (low, high, x, y, missed) in zip(ids, state['spans'].tolist(), strict=True)
        }
        self._next_id = int(state['next_id'])

    def line_features(self, ekf: CompressedEkf) -> list[LineFeature]:
        """All features, with their current lines."""
        lines = ekf.lines()
        covariances = ekf.line_covariances()
        local = set(ekf.area)
        return [
            as_seen(feature, lines[i].copy(), covariances[i], self.area.nodes_of(i), i in local)
            for i, feature in self._features.items()
            if i not in self._awaited
        ]

    def observe(
        self,
        ekf: CompressedEkf,
        lines: Lines,
        scan: Scan,
        learn: bool = True,
    ) -> tuple[int, bool]:
        """Associate the lines of a scan, update the filter, and manage the features.

        learn: whether features may be added, extended, merged and removed.
        Returns the number of matched lines, and whether the filter update was possible.
        """
        if self._local_areas:
            self._choose_area(ekf, scan)
        lines = Lines(lines.z, lines.covariances + self._walls(lines), lines.ends)
        laser_map = transform_points(ekf.local.pose, scan.T_base_laser[None, :2])[0]
        chosen, taken = self._correct(ekf, lines, laser_map)
        matched = np.flatnonzero(chosen >= 0)
        unknown = np.flatnonzero(chosen < 0)
        if not learn:
            return len(matched), taken
        seen = self._grow(ekf, chosen[matched], lines.select(matched))
        self._miss(ekf, seen, scan)
        self._merge(ekf, seen)
        new = self._take_up(ekf, lines.select(unknown), laser_map)
        self.area.store(ekf.local.pose, [i for i in (*seen, *new) if i in self._features])
        return len(matched), taken

    def _walls(self, lines: Lines) -> Array:
        """Covariances (K, 2, 2) of lines due to the flatness of real walls.

        The error at the ends is the same as elsewhere, so a short line has an uncertain direction.
        """
        sigma_m = WALL_FLATNESS_M
        walls = np.zeros((len(lines), 2, 2))
        walls[:, 0, 0] = sigma_m**2
        walls[:, 1, 1] = np.square(sigma_m / np.maximum(lines.lengths_m, sigma_m))
        return walls

    def _correct(
        self, ekf: CompressedEkf, lines: Lines, laser_map: Array
    ) -> tuple[NDArray[np.int64], bool]:
        """Update by the unambiguous lines, then by the others.

        Returns the index of the feature of each line (-1: none), and whether both were possible.
        """
        features = self._local(ekf)
        choice = associate(ekf.local, features, lines, laser_map, self._association)
        chosen = np.where(choice.ambiguous, -1, choice.index)
        taken = _update(ekf.local, chosen, lines)
        left = np.flatnonzero(choice.ambiguous)
        if left.size:
            again = associate(
                ekf.local, features, lines.select(left), laser_map, self._association
            ).index
            taken &= _update(ekf.local, again, lines.select(left))
            chosen[left] = again
        return chosen, taken

    def _local(self, ekf: CompressedEkf) -> list[FeatureTrack]:
        return [self._features[i] for i in ekf.area]

    def _choose_area(self, ekf: CompressedEkf, scan: Scan) -> None:
        """Set the filter's area if features are missing, or if it holds too many others."""
        half_view = 0.5 * abs(scan.angle_increment_rad) * scan.ranges_m.size
        wanted = self.area.features_near(ekf.local.pose, half_view) | self._called
        if not wanted <= set(ekf.area) or len(ekf.area) > len(wanted) + _SPARE:
            for feature_id in (set(ekf.area) - wanted) & self._awaited.keys():
                self._drop(ekf, feature_id, None)
            ekf.set_local_area(sorted(wanted))
            self._called.clear()

    def _grow(self, ekf: CompressedEkf, indices: NDArray[np.int64], lines: Lines) -> list[int]:
        """Extend features by the observed segments; returns their ids."""
        for index, ends in zip(indices, lines.ends, strict=True):
            self._extend(ekf, index, ends)
        seen = [ekf.area[i] for i in np.unique(indices)]
        for feature_id in seen:
            self._features[feature_id].misses = 0
            self._features[feature_id].unseen = 0
            self._await(feature_id, self._awaited.get(feature_id, 0) - 1)
        return seen

    def _await(self, feature_id: int, observations: int) -> None:
        """Keep a feature out of the map until it has been observed so many times again."""
        self._awaited.pop(feature_id, None)
        if observations > 0:
            self._awaited[feature_id] = observations

    def _extend(self, ekf: CompressedEkf, index: int, ends: Array) -> None:
        """Extend a feature by a segment with ends (2, 2), robot frame."""
        ends_map = transform_points(ekf.local.pose, ends)
        self._features[ekf.area[index]].grow(*interval(ekf.local.lines[index], ends_map))

    def _miss(self, ekf: CompressedEkf, seen: Iterable[int], scan: Scan) -> None:
        """Count scans through features, and those without a new one; remove what has too many."""
        through = seen_through(scan, ekf.local.pose, ekf.local.lines, self._local(ekf))
        for feature_id, gone in list(zip(ekf.area, through.tolist(), strict=True)):
            if feature_id in seen:
                continue
            feature = self._features[feature_id]
            feature.misses += gone
            feature.unseen += 1
            is_new = feature_id in self._awaited
            is_rare = is_new and feature.unseen > self._config.candidate_max_misses
            if feature.misses >= MAX_MISSES or is_rare:
                self._drop(ekf, feature_id, None)

    def _merge(self, ekf: CompressedEkf, seen: Iterable[int]) -> None:
        """Merge observed features that are the same wall as another feature."""
        for feature_id in seen:
            twin = self._twin(ekf, feature_id) if feature_id in self._features else None
            if twin is None:
                continue
            kept = min(feature_id, twin)
            dropped = max(feature_id, twin)
            a = ekf.area.index(kept)
            b = ekf.area.index(dropped)
            if ekf.local.merge(a, b, self._wall):
                ends = ends_of(self._features[dropped], ekf.local.lines[b])
                self._features[kept].grow(*interval(ekf.local.lines[a], ends))
                self._await(kept, min(self._awaited.get(i, 0) for i in (kept, dropped)))
                self._drop(ekf, dropped, kept)

    def _twin(self, ekf: CompressedEkf, feature_id: int) -> int | None:
        """Another feature that is the same wall, or None.

        Their intervals overlap, and their difference passes the gate.
        """
        index = ekf.area.index(feature_id)
        lines = ekf.local.lines
        ends = ends_of(self._features[feature_id], lines[index])
        near = meeting(
            lines, self._local(ekf), ends[None], self._features[feature_id].first_seen_from, 0.0
        )[0]
        for other in np.flatnonzero(near):
            if other != index and self._is_one_wall(ekf, index, int(other)):
                return ekf.area[other]
        return None

    def _is_one_wall(self, ekf: CompressedEkf, a: int, b: int) -> bool:
        v, S, _ = ekf.local.difference(a, b)
        ends = ends_of(self._features[ekf.area[b]], ekf.local.lines[b])
        apart = np.abs(ends @ normals_of(ekf.local.lines[[a]])[0] - ekf.local.lines[a, 0]).max()
        return (
            bool(apart <= _ONE_WALL_M) and mahalanobis(v, S + self._wall) <= self._association.gate
        )

    def _drop(self, ekf: CompressedEkf, feature_id: int, heir: int | None) -> None:
        ekf.remove(ekf.area.index(feature_id))
        self.area.remove(feature_id, heir)
        self._called.discard(feature_id)
        self._awaited.pop(feature_id, None)
        del self._features[feature_id]

    def _take_up(self, ekf: CompressedEkf, lines: Lines, laser_map: Array) -> list[int]:
        """Add the lines that are of no feature; returns the ids of the new features.

        A line that fails the gate of a feature may still be of it, and is not new unless it fails
        by far: a duplicate would keep the wrong heading with which it was added.
        """
        first = self._next_id
        wider = replace(self._association, gate=_NEW * self._association.gate)
        known = associate(ekf.local, self._local(ekf), lines, laser_map, wider).index >= 0
        lines = lines.select(np.flatnonzero(~known))
        for k, covering in enumerate(self._covering(ekf, lines, laser_map)):
            self._called |= covering - set(ekf.area)
            if not covering:
                self._add(ekf, lines.select(np.array([k])), laser_map)
        return list(range(first, self._next_id))

    def _add(self, ekf: CompressedEkf, line: Lines, laser_map: Array) -> None:
        """Add a line as a feature, or to one of the same scan: two may be of one new wall."""
        features = self._local(ekf)
        same = associate(ekf.local, features, line, laser_map, self._association).index[0]
        if same >= 0:
            self._extend(ekf, int(same), line.ends[0])
            return
        feature_id = self._next_id
        self._next_id += 1
        index = ekf.add(feature_id, line.z[0], line.covariances[0])
        ends_map = transform_points(ekf.local.pose, line.ends[0])
        span = interval(ekf.local.lines[index], ends_map)
        self._features[feature_id] = FeatureTrack(feature_id, *span, laser_map)
        self._await(feature_id, self._config.min_observations - 1)

    def _covering(self, ekf: CompressedEkf, seen: Lines, laser_map: Array) -> list[set[int]]:
        """For each line, ids of features that cover it although it failed their gate.

        Prevents duplicate features of one wall.
        """
        if not len(seen):
            return []
        ids, lines = ekf.line_array()
        normals = normals_of(lines)
        found = []
        ends_map = transform_points(ekf.local.pose, seen.ends.reshape(-1, 2))
        for start, end in ends_map.reshape(-1, 2, 2):
            middle = 0.5 * (start + end)
            reach = 0.25 * (end - start)
            # Only features whose lines are near.
            near = np.abs(normals @ middle - lines[:, 0]) <= _ONE_WALL_M
            features = [self._features[i] for i in ids[near].tolist()]
            ends = np.stack([middle - reach, middle + reach])
            is_covering = meeting(lines[near], features, ends[None], laser_map, 0.0)[0]
            found.append(set(ids[near][is_covering].tolist()))
        return found


def _check_references(state: Mapping[str, NDArray[Any]]) -> None:
    """Raise InputError unless ids are unique and known, spans ordered, and P is a covariance."""
    ids = state['ids']
    spans = state['spans']
    snapshot.require_unique(ids, 'features: id')
    last = int(ids.max(initial=0))
    next_id = int(state['next_id'])
    snapshot.require(last < next_id, f'features: next id {next_id}', f'above {last}')
    snapshot.require_known(state['stored_at'][:, 0], ids, 'features: stored feature')
    in_order = bool((spans[:, 0] <= spans[:, 1]).all())
    snapshot.require(in_order, 'features: spans', 'low ends below high ends')
    is_covariance = _is_covariance(state['line_covariance'])
    expected = 'a symmetric matrix without negative variances'
    snapshot.require(is_covariance, 'features: line_covariance', expected)


def _is_covariance(P: Array) -> bool:
    """Whether a matrix (N, N) is symmetric and positive semidefinite up to rounding."""
    rounding = _ROUNDING * float(np.abs(P).max(initial=0.0))
    if np.abs(P - P.T).max(initial=0.0) > rounding:
        return False
    try:
        # The added variance, of the size of rounding errors, makes a semidefinite matrix definite.
        np.linalg.cholesky(P + (rounding + 1e-12) * np.eye(len(P)))
    except np.linalg.LinAlgError:
        return False
    return True


def _update(ekf: EkfSlam, chosen: NDArray[np.int64], lines: Lines) -> bool:
    matched = np.flatnonzero(chosen >= 0)
    return ekf.update(chosen[matched], lines.z[matched], lines.covariances[matched])
