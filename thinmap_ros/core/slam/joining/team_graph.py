"""One pose graph of the keyframes of several robots: their maps bend to agree in the overlap."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from thinmap_ros.core import se2
from thinmap_ros.core.places.piece import SAME_M, SAME_RAD
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.loop_closure import LoopClosureConfig
from thinmap_ros.core.slam.graph.pose_graph import Edge, optimized
from thinmap_ros.core.slam.joining.join import match_keyframes
from thinmap_ros.core.slam.joining.pieces import RobotKeyframes

_FEWEST_LINKS = LoopClosureConfig().min_consistent_matches
_NEAR_M = LoopClosureConfig().search_radius_m
_MAX_MATCHES = 100  # of a pair at a time: some 0.3 s
Pair = tuple[str, str]


@dataclass(eq=False)
class _Links:
    """Matches of keyframes of one robot, edge.b, with submaps of another one, edge.a.

    T_a_b (3,): place of the second map in the first when the first match was made; tried: numbers
    of the keyframes that were matched, with success or without.
    """

    sessions: tuple[int, int]
    T_a_b: Array
    edges: list[Edge] = field(default_factory=list)
    tried: set[int] = field(default_factory=set)

    def hold_for(self, sessions: tuple[int, int], T_a_b: Array) -> bool:
        """Whether both robots have the same maps as then, joined at the same place."""
        return self.sessions == sessions and _are_near(self.T_a_b, T_a_b)


@dataclass(frozen=True, eq=False)
class Bend:
    """How the maps of robots bend, by their names.

    poses: of the keyframes (N, 3), world frame; present: pose (3,) of each map where its robot is;
    rigid: the place (3,) that it had without.
    """

    poses: Mapping[str, Array] = field(default_factory=dict)
    present: Mapping[str, Array] = field(default_factory=dict)
    rigid: Mapping[str, Array] = field(default_factory=dict)

    def present_places(self, places: Mapping[str, Array]) -> dict[str, Array]:
        """Pose (3,) of each map where its robot is, given the places of rigid maps, newer ones.

        The frame of a map that bends has a place of its own for each part of it.
        """
        return {
            name: self.present[name]
            if name in self.present and _are_near(self.rigid[name], T)
            else T
            for name, T in places.items()
        }


class TeamGraph:
    """Moves the keyframes of robots that are joined so that their scans agree."""

    def __init__(self) -> None:
        self._last = Bend()
        self._maps: dict[str, RobotKeyframes] = {}
        self._links: dict[Pair, _Links] = {}

    def bend(self, maps: Mapping[str, RobotKeyframes], places: Mapping[str, Array]) -> Bend:
        """Bend the maps of all robots whose keyframes match those of another one.

        maps: keyframes of robots; places: pose (3,) of each joined map in the world, the reference
        first.
        """
        names = [name for name in places if name in maps]
        start = {name: self._start(name, maps[name], places[name]) for name in names}
        pairs = list(combinations(names, 2))
        for a, b in pairs:
            self._match((a, b), maps, places, start)
        linked = [pair for pair in pairs if len(self._links[pair].edges) >= _FEWEST_LINKS]
        self._links = {pair: self._links[pair] for pair in pairs}
        self._maps = {name: maps[name] for name in names}
        poses: dict[str, Array] = {}
        for group in _groups(names, linked):
            if len(group) > 1:
                poses |= self._optimized(group, start)
        present = {name: _place_of_last(bent, maps[name].poses) for name, bent in poses.items()}
        self._last = Bend(poses, present, places)
        return self._last

    def count_links(self) -> int:
        """Number of matches between keyframes of two robots."""
        return sum(len(links.edges) for links in self._links.values())

    def _start(self, name: str, map_now: RobotKeyframes, T: Array) -> Array:
        """Poses (N, 3) to begin with: the last ones, or those of the rigid map at a place (3,)."""
        rigid = np.array([se2.compose(T, own) for own in map_now.poses])
        before = self._maps.get(name)
        bent = self._last.poses.get(name)
        if bent is None or before is None or not _are_near(self._last.rigid[name], T):
            return rigid
        known = len(before.frames)
        is_same = before.session == map_now.session and known <= len(rigid)
        if not is_same or not np.array_equal(before.poses, map_now.poses[:known]):
            return rigid  # its own graph has corrected it
        last = bent[-1]
        own = map_now.poses
        added = [se2.compose(last, se2.between(own[known - 1], T)) for T in own[known:]]
        return np.vstack([bent, *added])

    def _match(
        self,
        pair: Pair,
        maps: Mapping[str, RobotKeyframes],
        places: Mapping[str, Array],
        start: Mapping[str, Array],
    ) -> None:
        """Match keyframes of two robots that are near each other and were not matched yet."""
        a, b = pair
        T_a_b = se2.between(places[a], places[b])
        sessions = (maps[a].session, maps[b].session)
        links = self._links.get(pair)
        if links is None or not links.hold_for(sessions, T_a_b):
            links = self._links[pair] = _Links(sessions, T_a_b)
        away, _ = cKDTree(start[a][:, :2]).query(start[b][:, :2])
        near = [k for k in np.flatnonzero(away < _NEAR_M).tolist() if k not in links.tried]
        near = near[:_MAX_MATCHES]
        if near:
            known = [
                replace(frame, T_map_base=T)
                for frame, T in zip(maps[a].frames, start[a], strict=True)
            ]
            priors = ((k, start[b][k]) for k in near)
            found = match_keyframes(known, maps[b].frames, priors)
            links.edges += [link for link in found if link is not None]
            links.tried.update(near)

    def _optimized(self, group: Sequence[str], start: Mapping[str, Array]) -> dict[str, Array]:
        """Poses (N, 3) of the keyframes of robots that matches connect; the first one is fixed.

        None of them bends where the edges do not determine the poses.
        """
        ends = np.cumsum([0, *(len(start[name]) for name in group)]).tolist()
        first = dict(zip(group, ends, strict=False))
        edges: list[Edge] = []
        for name in group:
            edges += _shifted(self._maps[name].edges, first[name], first[name])
        for (a, b), links in self._links.items():
            if a in first and b in first:
                edges += _shifted(links.edges, first[a], first[b])
        if not _are_connected(ends[-1], edges):
            return {}  # a robot has not told all of its edges
        poses = optimized(np.vstack([start[name] for name in group]), edges)
        if not np.isfinite(poses).all():
            return {}  # edges of absurd weights
        return {
            name: poses[begin:end] for name, (begin, end) in zip(group, pairwise(ends), strict=True)
        }


def _are_near(T_a: Array, T_b: Array) -> bool:
    """Whether two places (3,) of a map are one, which was corrected at most."""
    x, y, turn = np.abs(se2.between(T_a, T_b)).tolist()
    return bool(max(x, y) < SAME_M and turn < SAME_RAD)


def _place_of_last(bent: Array, own: Array) -> Array:
    """Pose (3,) of a map in the world, by the last of its keyframes (N, 3)."""
    return se2.compose(bent[-1], se2.invert(own[-1]))


def _are_connected(count: int, edges: Sequence[Edge]) -> bool:
    """Whether edges connect so many keyframes."""
    a = np.array([edge.a for edge in edges])
    b = np.array([edge.b for edge in edges])
    links = coo_matrix((np.ones(len(edges)), (a, b)), shape=(count, count))
    parts, _ = connected_components(links, directed=False)
    return bool(parts == 1)


def _shifted(edges: Sequence[Edge], by_a: int, by_b: int) -> Iterator[Edge]:
    """The edges with other numbers."""
    return (replace(edge, a=edge.a + by_a, b=edge.b + by_b) for edge in edges)


def _groups(names: Sequence[str], pairs: Sequence[Pair]) -> list[list[str]]:
    """Names that are connected by pairs, each group in their order."""
    group = {name: name for name in names}
    for a, b in pairs:
        kept = group[a]
        gone = group[b]
        group = {name: kept if of == gone else of for name, of in group.items()}
    found: dict[str, list[str]] = {}
    for name in names:
        found.setdefault(group[name], []).append(name)
    return list(found.values())
