"""The maps of the robots of a team, and the links between them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from thinmap_ros.core import se2
from thinmap_ros.core.grid.fused import Layer, fused
from thinmap_ros.core.grid.moved import MapMotion, laid_on, overlaid_bent
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.places.piece import SAME_M, SAME_RAD
from thinmap_ros.core.places.place_odds import JOIN_ODDS
from thinmap_ros.core.places.recognition import MATCH_NOISE, recognize
from thinmap_ros.core.se2 import Array, inverse, propagated_covariance, rotated_covariance
from thinmap_ros.core.slam.graph.loop_closure import LoopClosureConfig
from thinmap_ros.core.slam.graph.pose_graph import Edge, optimized
from thinmap_ros.core.slam.joining.join import found, match_keyframes, refined
from thinmap_ros.core.slam.joining.pieces import RobotKeyframes, SlamPiece
from thinmap_ros.core.slam.odometry import CHI2
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import TopologyBuilder, build, join_topologies, moved_map

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
    """One pose graph of the keyframes of robots that are joined: their maps bend to agree."""

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
        present = {
            name: se2.compose(bent[-1], se2.invert(maps[name].poses[-1]))  # by the last keyframe
            for name, bent in poses.items()
        }
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
            links.edges += found(match_keyframes(known, maps[b].frames, priors))
            links.tried.update(near)

    def _optimized(self, group: Sequence[str], start: Mapping[str, Array]) -> dict[str, Array]:
        """Poses (N, 3) of the keyframes of robots that matches connect; the first one is fixed.

        None of them bends where the edges do not determine the poses.
        """
        ends = np.cumsum([0, *(len(start[name]) for name in group)]).tolist()
        first = dict(zip(group, ends, strict=False))
        edges: list[Edge] = []
        for name in group:
            edges += (edge.shifted(first[name], first[name]) for edge in self._maps[name].edges)
        for (a, b), links in self._links.items():
            if a in first and b in first:
                edges += (edge.shifted(first[a], first[b]) for edge in links.edges)
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


def _are_connected(count: int, edges: Sequence[Edge]) -> bool:
    """Whether edges connect so many keyframes."""
    a = np.array([edge.a for edge in edges])
    b = np.array([edge.b for edge in edges])
    links = coo_matrix((np.ones(len(edges)), (a, b)), shape=(count, count))
    parts, _ = connected_components(links, directed=False)
    return bool(parts == 1)


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


@dataclass(frozen=True, eq=False)
class MapLink:
    """Pose T_a_b (3,) of map b in the frame of map a, with covariance (3, 3), frame of a.

    log_odds: that it is right; infinite where a person gave it. matches: scans that agree on it.
    """

    a: str
    b: str
    T_a_b: Array
    covariance: Array
    log_odds: float
    matches: int = 0

    @property
    def is_given(self) -> bool:
        """Whether a person gave it."""
        return math.isinf(self.log_odds)

    def reversed(self) -> 'MapLink':
        """The link from b to a."""
        T_b_a = se2.invert(self.T_a_b)
        turned = rotated_covariance(self.covariance, float(T_b_a[2]))
        covariance = propagated_covariance(turned, T_b_a[:2])
        return MapLink(self.b, self.a, T_b_a, covariance, self.log_odds, self.matches)

    def then(self, other: 'MapLink') -> 'MapLink':
        """The link from a to the end of another link, which begins at b."""
        T = se2.compose(self.T_a_b, other.T_a_b)
        own = propagated_covariance(self.covariance, T[:2] - self.T_a_b[:2])
        covariance = own + rotated_covariance(other.covariance, float(self.T_a_b[2]))
        log_odds = min(self.log_odds, other.log_odds)
        return MapLink(self.a, other.b, T, covariance, log_odds)

    def contradicts(self, other: 'MapLink') -> bool:
        """Whether another link between the same maps cannot be right if this one is."""
        off = se2.pose_difference(other.T_a_b, self.T_a_b)
        expected = self.covariance + other.covariance
        return float(off @ np.linalg.solve(expected, off)) > CHI2


class MapLinks:
    """The links between maps by their names, at most one for each pair.

    The surest links that connect the maps decide. A link that contradicts them is dropped.
    """

    def __init__(self) -> None:
        self._links: dict[frozenset[str], MapLink] = {}

    def __iter__(self) -> Iterator[MapLink]:
        """All links."""
        return iter(self._links.values())

    def between(self, a: str, b: str) -> MapLink | None:
        """The link from a to b, or None."""
        link = self._links.get(frozenset((a, b)))
        return link if link is None or link.a == a else link.reversed()

    def chain(self, a: str, b: str) -> MapLink | None:
        """The chain of the surest links from a to b, or None."""
        return self._chains(a).get(b)

    def add(self, link: MapLink) -> list[MapLink]:
        """Add a link, or replace that of its pair; returns the links that are dropped for it."""
        self._links[frozenset((link.a, link.b))] = link
        tree = self._tree()
        dropped = [other for other in self if other not in tree and self._is_wrong(other)]
        for other in dropped:
            del self._links[frozenset((other.a, other.b))]
        return dropped

    def remove(self, name: str) -> None:
        """Remove all links of a map."""
        self._links = {pair: link for pair, link in self._links.items() if name not in pair}

    def discard(self, link: MapLink) -> bool:
        """Remove a link, if it is still the one of its pair; returns whether it was."""
        pair = frozenset((link.a, link.b))
        is_there = self._links.get(pair) is link
        if is_there:
            del self._links[pair]
        return is_there

    def places(self, reference: str) -> dict[str, Array]:
        """Pose (3,) of each map that is connected with a reference, in the frame of that."""
        chains = self._chains(reference)
        names = list(chains)
        number = {name: k for k, name in enumerate(names)}
        poses = np.array([chain.T_a_b for chain in chains.values()])
        edges = [
            Edge(number[link.a], number[link.b], link.T_a_b, inverse(link.covariance), False)
            for link in self
            if link.a in number
        ]
        if len(edges) >= len(names):  # otherwise there is no cycle
            poses = optimized(poses, edges)
        return dict(zip(names, poses, strict=True))

    def _is_wrong(self, link: MapLink) -> bool:
        return link.contradicts(self._chains(link.a)[link.b])

    def _tree(self) -> list[MapLink]:
        """The surest links that connect all that is connected."""
        group = {name: name for pair in self._links for name in pair}
        tree = []
        for link in sorted(self, key=lambda each: -each.log_odds):
            kept = group[link.a]
            gone = group[link.b]
            if kept != gone:
                tree.append(link)
                group = {name: kept if of == gone else of for name, of in group.items()}
        return tree

    def _chains(self, start: str) -> dict[str, MapLink]:
        """Chain of the surest links from a map to each that is connected with it, itself first."""
        beside: dict[str, list[MapLink]] = {}
        for link in self._tree():
            beside.setdefault(link.a, []).append(link)
            beside.setdefault(link.b, []).append(link.reversed())
        chains = {start: MapLink(start, start, np.zeros(3), np.zeros((3, 3)), math.inf)}
        waiting = [start]
        while waiting:
            here = waiting.pop(0)
            for link in beside.get(here, []):
                if link.b not in chains:
                    chains[link.b] = chains[here].then(link)
                    waiting.append(link.b)
        return chains


WORLD = 'world'  # a map without cells, in whose frame a person gives the poses of others

_GIVEN = np.diag(np.square([0.5, 0.5, 0.1]))  # of one that a person has measured


@dataclass(frozen=True, eq=False)
class RobotMap:
    """The newest map of a robot, in a frame of its own.

    given_graph: its topological map. One that does not lie in the grid, or None, is replaced by one
    that is made from the grid: map and graph come on two topics. keyframes: with which the map
    bends; None: it is rigid.
    """

    patch: GridPatch
    given_graph: TopologicalMap | None = None
    keyframes: RobotKeyframes | None = None

    @cached_property
    def graph(self) -> TopologicalMap:
        """The topological map."""
        given = self.given_graph
        if given is not None and _lies_in(given, self.patch):
            return given
        return build(self.patch, None, TopologyConfig())

    @cached_property
    def piece(self) -> SlamPiece:
        """The map for recognition."""
        return SlamPiece.of_bare_map(self.patch, self.graph)


def _lies_in(graph: TopologicalMap, patch: GridPatch) -> bool:
    """Whether all nodes and paths of a graph lie in the rectangle of a map."""
    points = [np.array([node.position for node in graph.nodes.values()]).reshape(-1, 2)]
    points += [edge.path for edge in graph.edges.values()]
    return bool(patch.contains(np.vstack(points)).all())


@dataclass(frozen=True, eq=False)
class LinkSearch:
    """A search for the place of map b in map a.

    link: the present one, which is refined, and replaced where a surer place is found; guess: that
    by other links or by a person, or None.
    """

    a: str
    b: str
    first: RobotMap
    second: RobotMap
    link: MapLink | None
    guess: MapLink | None
    join_odds: float

    def run(self) -> tuple[MapLink | None, float]:
        """The link, if there is one, and the log odds of the most likely place."""
        known = self.link or self.guess
        link = None if known is None else self._refined(known)
        if link is not None and link.is_given:
            return link, link.log_odds
        found, log_odds = self._recognized()
        if link is None:
            return found, log_odds
        if found is None or log_odds <= link.log_odds:
            return link, link.log_odds
        if found.contradicts(link):
            return found, log_odds
        return replace(link, log_odds=log_odds), log_odds

    def _recognized(self) -> tuple[MapLink | None, float]:
        """The link that place recognition finds, and the log odds of the most likely place."""
        decision = recognize(self.second.piece.places, self.first.piece.places, self.join_odds)
        placement = decision.placement
        if not decision.is_joined or placement is None:
            return None, decision.log_odds
        return self._link_near(placement.T_map_piece, decision.log_odds), decision.log_odds

    def _refined(self, link: MapLink) -> MapLink | None:
        """The link by the maps as they are now; the same one where these do not contradict it.

        None where they have nothing in common any more: one of the robots has begun another map.
        """
        newer = self._link_near(link.T_a_b, link.log_odds)
        is_moved = newer is None or not link.matches or newer.contradicts(link)
        return newer if is_moved else link

    def _link_near(self, T: Array, log_odds: float) -> MapLink | None:
        """Link near a pose (3,); None where too few scans match there."""
        T, matches = refined(self.first.piece, self.second.piece, T)
        if matches < _FEWEST_LINKS:
            return None
        return MapLink(self.a, self.b, T, MATCH_NOISE, log_odds, matches)


class Team:
    """The maps of robots by name, and the links between them."""

    def __init__(self, join_odds: float = JOIN_ODDS) -> None:
        """join_odds: from which two maps are joined."""
        self.maps: dict[str, RobotMap] = {}
        self.links = MapLinks()
        self.log_odds: dict[frozenset[str], float] = {}  # of pairs, by the last search
        self._join_odds = join_odds
        self._searched: dict[frozenset[str], tuple[RobotMap, RobotMap]] = {}  # the oldest first
        self._separate: set[str] = set()
        self._reference = ''

    def give(self, a: str, b: str, T_a_b: Array) -> list[MapLink]:
        """Join map b to map a, or to WORLD, at a pose (3,) that a person gives.

        It is refined as soon as scans match. Returns the links that are dropped for it.
        """
        self._separate -= {a, b}
        return self.links.add(MapLink(a, b, T_a_b, _GIVEN, math.inf))

    def links_of(self, name: str) -> list[MapLink]:
        """The links of a map, each from it to another one."""
        own = [link for link in self.links if name in (link.a, link.b)]
        return [link if link.a == name else link.reversed() for link in own]

    def begin_again(self, name: str) -> None:
        """A robot has begun another map: what was known of the last one does not hold for it."""
        self.links.remove(name)
        self._searched = {pair: maps for pair, maps in self._searched.items() if name not in pair}

    def separate(self, name: str) -> None:
        """Undo the joins of a map; it is joined again when a person does it."""
        self.links.remove(name)
        self._separate.add(name)

    def next_search(self) -> LinkSearch | None:
        """The pair of maps that was searched longest ago, if one of both has changed since."""
        names = sorted(self.maps.keys() - self._separate)
        pairs = [frozenset((a, b)) for k, a in enumerate(names) for b in names[k + 1 :]]
        order = list(self._searched)
        pairs.sort(key=lambda pair: order.index(pair) if pair in self._searched else -1)
        for pair in pairs:
            a, b = sorted(pair)
            maps = (self.maps[a], self.maps[b])
            link = self.links.between(a, b)
            if self._searched.get(pair) != maps:
                self._searched.pop(pair, None)
                self._searched[pair] = maps
                is_matched = link is not None and link.matches > 0
                guess = None if is_matched else self.links.chain(a, b)
                return LinkSearch(a, b, *maps, link if is_matched else None, guess, self._join_odds)
        return None

    def found(self, search: LinkSearch, link: MapLink | None, log_odds: float) -> list[MapLink]:
        """Take the result of a search; returns the links that are dropped for it."""
        pair = frozenset((search.a, search.b))
        self.log_odds[pair] = log_odds
        if pair & self._separate:
            return []
        if link is None:
            before = search.link
            return [before] if before is not None and self.links.discard(before) else []
        return self.links.add(link)

    def places(self) -> dict[str, Array]:
        """Pose (3,) of each joined map in the world frame; empty while none is joined.

        The world is the frame in which a person gave poses; otherwise that of the first map that
        was joined, as long as it is.
        """
        linked = {name for link in self.links for name in (link.a, link.b)}
        if not linked:
            return {}
        if WORLD in linked:
            self._reference = WORLD
        elif self._reference not in linked:
            self._reference = min(linked)
        places = self.links.places(self._reference)
        return {name: T for name, T in places.items() if name in self.maps}


@dataclass(frozen=True, eq=False)
class TeamMap:
    """The map of the robots of these names, in the world frame.

    next_id: smallest number that no node or edge of its topological map has had.
    """

    names: frozenset[str]
    patch: GridPatch
    graph: TopologicalMap
    next_id: int


def merged(
    maps: Mapping[str, RobotMap],
    places: Mapping[str, Array],
    before: TeamMap | None,
    bent: Mapping[str, Array] | None = None,
) -> TeamMap:
    """Merge the maps that have a place (3,) in the world, on the cells of the first; see `fused`.

    before: the map that was merged last, whose ids are continued; None: ids are those of the first
    map, as far as they can be. bent: poses (N, 3) of the keyframes of each map that bends, world
    frame.
    """
    motions = {name: _motion(maps[name], T, (bent or {}).get(name)) for name, T in places.items()}
    first = next(iter(places))
    patch = _fused(maps, motions, places[first])
    known = before or _begun(first, maps[first].graph, patch, motions[first])
    builder = TopologyBuilder.continued(patch, known.graph, known.next_id)
    for name in places.keys() - known.names:
        graph = _moved_graph(maps[name].graph, motions[name])
        builder, _ = join_topologies(patch, builder.map, graph, builder.next_id)
    return TeamMap(frozenset(places), patch, builder.map, builder.next_id)


def _fused(
    maps: Mapping[str, RobotMap], motions: Mapping[str, MapMotion], T_world_first: Array
) -> GridPatch:
    """The cells of maps that are moved by motions; T_world_first (3,): place of the first one."""
    first, *others = motions
    patch = _moved(maps[first].patch, motions[first], T_world_first)
    if not others:
        return patch
    moved = [patch]
    for name in others:
        patch, own = laid_on(patch, maps[name].patch, motions[name])
        moved.append(own)
    layers = [
        Layer(own.padded(own.overhang_of(patch)), _driven(maps[name], motions[name]))
        for name, own in zip(motions, moved, strict=True)
    ]
    return fused(layers, 2.0 * math.sqrt(MATCH_NOISE[0, 0]))


def _driven(robot: RobotMap, motion: MapMotion) -> Array:
    """Places (N, 2), world frame, where a robot has been, as far as its keyframes tell."""
    poses = np.zeros((0, 3)) if robot.keyframes is None else robot.keyframes.poses
    return motion.moved(poses[:, :2])


def _motion(robot: RobotMap, T: Array, bent: Array | None) -> MapMotion:
    """How a map comes into the world: as its keyframes do, or to its place (3,)."""
    if bent is None or robot.keyframes is None:
        return MapMotion.rigid(T)
    return MapMotion(robot.keyframes.poses, bent)


def _begun(name: str, graph: TopologicalMap, patch: GridPatch, motion: MapMotion) -> TeamMap:
    """The topological map of the first robot, moved, with the cells of all."""
    next_id = max([0, *graph.nodes, *graph.edges]) + 1
    return TeamMap(frozenset([name]), patch, _moved_graph(graph, motion), next_id)


def _moved_graph(graph: TopologicalMap, motion: MapMotion) -> TopologicalMap:
    return moved_map(graph, motion.before, motion.after)


def _moved(patch: GridPatch, motion: MapMotion, T: Array) -> GridPatch:
    """A map in the world frame, on the lattice of a map at a place (3,), which may be its own."""
    if not motion.after.any():
        return patch
    cell = np.full((1, 1), UNKNOWN, dtype=np.int8)
    empty = GridPatch(GridFrame(float(T[0]), float(T[1]), patch.frame.resolution), cell)
    return overlaid_bent(empty, patch, motion)
