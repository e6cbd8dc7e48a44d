"""The maps of several robots: searches for links between them, and one map of all."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from thinmap_ros.core.grid.moved import MapMotion, overlaid_bent
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.places.recognition import JOIN_ODDS, recognize
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.loop_closure import LoopClosureConfig
from thinmap_ros.core.slam.joining.join import refined
from thinmap_ros.core.slam.joining.map_links import MapLink, MapLinks
from thinmap_ros.core.slam.joining.pieces import RobotKeyframes, SlamPiece
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import TopologyBuilder, build, join_topologies, moved_map

WORLD = 'world'  # a map without cells, in whose frame a person gives the poses of others
_FEWEST_MATCHES = LoopClosureConfig().min_consistent_matches
_MATCHED = np.diag(np.square([0.05, 0.05, 0.01]))  # of the place of a map, by many scans
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
    cells = patch.frame.cells_of(np.vstack(points))
    return bool(((cells >= 0) & (cells < patch.shape)).all())


@dataclass(frozen=True, eq=False)
class Search:
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
        if matches < _FEWEST_MATCHES:
            return None
        return MapLink(self.a, self.b, T, _MATCHED, log_odds, matches)


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

    def receive(
        self,
        name: str,
        patch: GridPatch,
        graph: TopologicalMap | None,
        keyframes: RobotKeyframes | None = None,
    ) -> None:
        """Take the newest map of a robot."""
        self.maps[name] = RobotMap(patch, graph, keyframes)

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

    def next_search(self) -> Search | None:
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
                return Search(a, b, *maps, link if is_matched else None, guess, self._join_odds)
        return None

    def found(self, search: Search, link: MapLink | None, log_odds: float) -> list[MapLink]:
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
class MergedMap:
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
    before: MergedMap | None,
    bent: Mapping[str, Array] | None = None,
) -> MergedMap:
    """Merge the maps that have a place (3,) in the world; what the first knows comes first.

    before: the map that was merged last, whose ids are continued; None: ids are those of the first
    map, as far as they can be. bent: poses (N, 3) of the keyframes of each map that bends, world
    frame.
    """
    motions = {name: _motion(maps[name], T, (bent or {}).get(name)) for name, T in places.items()}
    first, *others = places
    patch = _moved(maps[first].patch, motions[first], places[first])
    for name in others:
        patch = overlaid_bent(patch, maps[name].patch, motions[name])
    known = before or _begun(first, maps[first].graph, patch, motions[first])
    builder = TopologyBuilder.continued(patch, known.graph, known.next_id)
    for name in places.keys() - known.names:
        graph = _moved_graph(maps[name].graph, motions[name])
        builder, _ = join_topologies(patch, builder.map, graph, builder.next_id)
    return MergedMap(frozenset(places), patch, builder.map, builder.next_id)


def _motion(robot: RobotMap, T: Array, bent: Array | None) -> MapMotion:
    """How a map comes into the world: as its keyframes do, or to its place (3,)."""
    if bent is None or robot.keyframes is None:
        return MapMotion.rigid(T)
    return MapMotion(robot.keyframes.poses, bent)


def _begun(name: str, graph: TopologicalMap, patch: GridPatch, motion: MapMotion) -> MergedMap:
    """The topological map of the first robot, moved, with the cells of all."""
    next_id = max([0, *graph.nodes, *graph.edges]) + 1
    return MergedMap(frozenset([name]), patch, _moved_graph(graph, motion), next_id)


def _moved_graph(graph: TopologicalMap, motion: MapMotion) -> TopologicalMap:
    return moved_map(graph, motion.before, motion.after)


def _moved(patch: GridPatch, motion: MapMotion, T: Array) -> GridPatch:
    """A map in the world frame, on the lattice of a map at a place (3,), which may be its own."""
    if not motion.after.any():
        return patch
    cell = np.full((1, 1), UNKNOWN, dtype=np.int8)
    empty = GridPatch(GridFrame(float(T[0]), float(T[1]), patch.frame.resolution), cell)
    return overlaid_bent(empty, patch, motion)
