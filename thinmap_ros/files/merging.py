"""Merges saved maps: sessions and map_server maps of one place into one session."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thinmap_ros.core.errors import InputError, ThinmapError, quoted
from thinmap_ros.core.grid.edits import (
    Erasures,
    KeepOut,
    MapEdits,
    require_count,
    require_erasures,
)
from thinmap_ros.core.grid.moved import MapMotion
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.places.alignment import LEAST_FOUND, align, fitted
from thinmap_ros.core.places.place_odds import JOIN_ODDS, on_one_storey
from thinmap_ros.core.places.recognition import Placement, recognize
from thinmap_ros.core.places.structure import storey_evidence
from thinmap_ros.core.se2 import Array, is_bounded_pose
from thinmap_ros.core.slam.graph.keyframes import SavedKeyframes
from thinmap_ros.core.slam.joining.join import join
from thinmap_ros.core.slam.joining.pieces import SlamPiece
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.matching.local_map import LocalMapConfig
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import checked_tag
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.segmentation import RegionTracker
from thinmap_ros.core.topology.topology import TopologyBuilder, build
from thinmap_ros.files import sessions
from thinmap_ros.files.occupancy_maps import Report, read_map, warn
from thinmap_ros.files.safe import atomic_write, path_of
from thinmap_ros.files.sessions import GRID, KEYFRAMES, REGIONS, TOPOLOGY

MIN_MAPS = 2


class NotTheSamePlaceError(ThinmapError):
    """Maps do not show the same place; log_odds: that one lies in the others."""

    def __init__(self, path: str, log_odds: float, what: str = '') -> None:
        super().__init__(f'{path}: {what or f"not the same place (log odds {log_odds:.1f})"}')
        self.log_odds = log_odds


class CannotTellError(NotTheSamePlaceError):
    """A map probably lies in the others, but its odds are less than those that are asked for.

    places: poses (3,) at which it fits best, the best one first.
    """

    def __init__(
        self, path: str, log_odds: float, join_odds: float, places: Sequence[Array]
    ) -> None:
        fits = ', then at '.join(','.join(f'{value:.2f}' for value in T) for T in places)
        super().__init__(
            path,
            log_odds,
            f'cannot tell (odds {_odds(log_odds)}, asked {_odds(math.log(join_odds))}): lower '
            '--join-odds, or give the pose with --at X,Y,YAW'
            + (f'; it fits best at {fits}' if fits else ''),
        )
        self.places = places


def _odds(log_odds: float) -> str:
    """Odds in words."""
    return f'{math.exp(log_odds):,.0f}' if log_odds < _LONG else f'1e{log_odds / math.log(10):.0f}'


_LONG = math.log(1e9)


@dataclass(frozen=True, eq=False)
class MapJoin:
    """How a map was joined: pose T_merged_map (3,) with covariance (3, 3), and log odds.

    Infinite log odds: the pose was given. found: share of the walls of which both maps tell that
    both have, where the pose was given or found by whole maps; else NaN. ids: of its nodes in the
    merged map, by their own; nodes: number of its nodes; links: matches of its scans with those of
    the other maps.
    """

    path: str
    T_merged_map: Array
    covariance: Array
    log_odds: float
    found: float
    ids: dict[int, int]
    nodes: int
    links: int


@dataclass(frozen=True, eq=False)
class MergedMap:
    """The map of several, in the frame of the first of them.

    keep_out: areas of all of them; piece: with the keyframes of all of them, if all have some, and
    the tag of their storey; cells: of a local map of these; maps: by path; joins: of all but the
    first, in the order in which they were joined.
    """

    grid: OccupancyGrid
    topology: TopologyBuilder
    regions: RegionTracker
    keep_out: KeepOut
    piece: SlamPiece
    cells: LocalMapConfig
    maps: dict[str, SlamPiece]
    joins: list[MapJoin]

    def save(self, path: str) -> list[str]:
        """Write a session, as `sessions.save_session`; returns what was written, a line each.

        It has keyframes, and a local map of these, if all maps have some.
        """
        edits = MapEdits(self.keep_out, Erasures(list(self.piece.erased)))
        return sessions.save_session(
            path,
            sessions.SessionMap(
                self.grid, self.topology, self.regions, edits, self._localizer(), self.piece.tag
            ),
        )

    def _localizer(self) -> Localizer | None:
        """A localizer of any robot in the map of the keyframes; None without any."""
        if self.piece.is_rigid:
            return None
        keyframes = SavedKeyframes.of_graph(self.piece.frames, self.piece.edges)
        config = LocalizerConfig(local_map=self.cells)
        localizer = Localizer.from_keyframes(keyframes, Localizer().calibration, config)
        localizer.tag_map(self.piece.tag)
        return localizer


def merge_maps(
    paths: Sequence[str | Path],
    join_odds: float = JOIN_ODDS,
    report: Report = warn,
    progress: Callable[[float, str], None] = lambda _share, _text: None,
    at: Sequence[Array] = (),
    tag: str = '',
) -> MergedMap:
    """Merge sessions and map_server maps (YAML files) of one place, in the frame of the first.

    join_odds: from which a map is joined, at most one false join in so many. report: receives lines
    on maps that are read; progress: the share of the work that is done, and what is done next. at:
    the pose (3,), m, m, rad, of each map after the first in the frame of the first; none: they are
    found. tag: of the storey of all maps that have none. Raises InputError where a map cannot be
    read or contradicts its pose, NotTheSamePlaceError where one has another tag, or no place in the
    others, CannotTellError, which is one, where the odds are for it but too small.
    """
    if isinstance(paths, str | Path) or not isinstance(paths, Sequence):
        raise InputError(f'paths = {quoted(paths)}: expected a list of paths')
    names = [str(path_of(path)) for path in paths]
    if len(names) < MIN_MAPS or len(set(names)) < len(names):
        raise InputError(f'{" ".join(names)}: expected two different maps or more')
    if not join_odds > 1.0:
        raise InputError(f'join odds {join_odds:g}: expected more than 1')
    given = _given_poses(names[1:], at)
    checked_tag('tag', tag)
    maps = _tagged({name: read_piece(name, report) for name in names}, tag)
    merging = _Merging(maps, join_odds, progress, given)
    while merging.waiting:
        merging.join_next()
    regions = merging.drawn.regions
    regions.update(merging.known.patch)
    return MergedMap(
        merging.grid,
        merging.topology,
        regions,
        merging.drawn.keep_out,
        merging.known,
        sessions.load_cells(names[0]),
        maps,
        merging.joins,
    )


def _tagged(maps: dict[str, SlamPiece], tag: str) -> dict[str, SlamPiece]:
    """The maps, those without a tag with the given one. Raises NotTheSamePlaceError."""
    all_tags = {'--tag': tag, **{path: piece.tag for path, piece in maps.items()}}
    tags = {source: each for source, each in all_tags.items() if each}
    for source, each in tags.items():
        first, expected = next(iter(tags.items()))
        if each != expected:
            reason = f'map_tag = {quoted(each)}: expected {quoted(expected)}, the storey of {first}'
            raise NotTheSamePlaceError(source, -math.inf, f'another storey: {reason}')
    return {path: replace(piece, tag=piece.tag or tag) for path, piece in maps.items()}


def _given_poses(names: Sequence[str], at: Sequence[Array]) -> dict[str, Array]:
    """The poses (3,) that are given, by the names of their maps. Raises InputError."""
    if len(at) not in (0, len(names)):
        raise InputError(
            f'{len(at)} given poses: expected one for each map after the first: {len(names)}'
        )
    for T in at:
        if np.shape(T) != (3,) or not is_bounded_pose(T):
            raise InputError(f'given pose {quoted(T)}: expected x, y and yaw (m, m, rad)')
    return dict(zip(names, at, strict=False))


@dataclass(frozen=True, eq=False)
class _Candidate:
    """The most likely place of a map in the others; None: none that may be joined."""

    path: str
    log_odds: float
    placement: Placement | None
    found: float = math.nan


@dataclass(eq=False)
class _Drawn:
    """What people have drawn on a map: keep-out areas, and names of its regions."""

    keep_out: KeepOut
    regions: RegionTracker

    @staticmethod
    def of(path: str) -> '_Drawn':
        """That of a session; nothing of another map. Raises InputError where it is broken."""
        regions = REGIONS.load_optional(path) or RegionTracker()
        return _Drawn(sessions.load_edits(path).keep_out, regions)

    def move(self, motion: MapMotion) -> None:
        """Move it as the map."""
        self.keep_out = self.keep_out.moved(motion.before, motion.after)
        self.regions.names.move(motion)

    def add(self, other: '_Drawn') -> None:
        """Add that of another map. Raises InputError where it is too much."""
        self.keep_out = self.keep_out.joined(other.keep_out)
        self.regions.names.add(other.regions.names)


class _Merging:
    """The map so far, and the maps that wait until they have a place in it."""

    def __init__(
        self,
        maps: dict[str, SlamPiece],
        join_odds: float,
        progress: Callable[[float, str], None],
        given: dict[str, Array],
    ) -> None:
        first, *self.waiting = maps
        self._maps = maps
        self._join_odds = join_odds
        self._progress = progress
        self._given = given
        self._fits: dict[str, list[Array]] = {}  # poses (3,) at which a whole map fits best
        self._drawn = {path: _Drawn.of(path) for path in maps}
        require_count(sum(len(drawn.keep_out.areas) for drawn in self._drawn.values()))
        require_erasures(sum(len(piece.erased) for piece in maps.values()))
        self.drawn = self._drawn[first]
        self.known = maps[first]
        self.grid = OccupancyGrid()
        self.topology = TopologyBuilder()
        self.joins: list[MapJoin] = []

    def join_next(self) -> None:
        """Join a map that waits. Raises NotTheSamePlaceError if none has a place."""
        finders = [self._by_pose] if self._given else [self._by_views, self._by_whole_map]
        share = len(self.joins) / (len(self._maps) - 1)
        best = _Candidate(self.waiting[0], -math.inf, None)
        for find in finders:
            for path in self.waiting:
                self._progress(share, f'{path}: looking for its place')
                found = find(path)
                if found.placement is not None and found.log_odds > math.log(self._join_odds):
                    self._progress(share, f'{path}: joining')
                    self._join(found, found.placement)
                    return
                best = max(best, found, key=lambda each: each.log_odds)
        raise self._refusal(best)

    def _refusal(self, best: _Candidate) -> ThinmapError:
        least = f'expected at least {100 * LEAST_FOUND:.0f} %'
        agree = f'{100 * best.found:.0f} % of the walls agree'
        if self._given:
            given = ','.join(f'{value:g}' for value in self._given[best.path])
            return InputError(
                f'{best.path}: the maps contradict the given pose {given}: {agree} near it: {least}'
            )
        if best.log_odds > 0.0 and best.found < LEAST_FOUND:
            reason = f'not the same place: {agree}: {least}'
            return NotTheSamePlaceError(best.path, best.log_odds, reason)
        if best.log_odds <= 0.0:
            return NotTheSamePlaceError(best.path, best.log_odds)
        places = self._fits.get(best.path, [])
        return CannotTellError(best.path, best.log_odds, self._join_odds, places)

    def _by_views(self, path: str) -> _Candidate:
        decision = recognize(self._maps[path].places, self.known.places, self._join_odds)
        placement = decision.placement if decision.is_joined else None
        return _Candidate(path, decision.log_odds, placement)

    def _by_whole_map(self, path: str) -> _Candidate:
        """For maps too small for their views to decide."""
        query = self._maps[path].places
        known = self.known.places
        alignment = align(query, known)
        if alignment is None:
            return _Candidate(path, -math.inf, None)
        fits = [fitted(query, known, T) for T in (alignment.T_known_query, alignment.second)]
        self._fits[path] = [fit.T_known_query for fit in fits]
        motion = MapMotion.rigid(fits[0].T_known_query)
        ratio = storey_evidence(query, known, motion, math.inf)
        log_odds = on_one_storey(alignment.log_odds, ratio, self._join_odds)
        placement = fits[0].placement(query, log_odds)
        return _Candidate(
            path,
            log_odds,
            None if fits[0].is_contrary else placement,
            fits[0].found,
        )

    def _by_pose(self, path: str) -> _Candidate:
        """Where a person says that it lies."""
        query = self._maps[path].places
        fit = fitted(query, self.known.places, self._given[path])
        placement = None if fit.is_contrary else fit.placement(query, math.inf)
        return _Candidate(path, math.inf, placement, fit.found)

    def _join(self, candidate: _Candidate, placement: Placement) -> None:
        path = candidate.path
        joined = join(self.known, self._maps[path], placement)
        nodes = len(self._maps[path].graph.nodes)
        self.joins.append(
            MapJoin(
                path,
                joined.T_first_second,
                placement.covariance,
                candidate.log_odds,
                candidate.found,
                joined.ids,
                nodes,
                joined.links,
            )
        )
        self.waiting.remove(path)
        for drawn, motion in zip((self.drawn, self._drawn[path]), joined.motions, strict=True):
            drawn.move(motion)
        self.drawn.add(self._drawn[path])
        self.known = replace(joined.piece, tag=self.known.tag or self._maps[path].tag)
        self.grid = joined.grid
        self.topology = joined.topology


def read_piece(path: str, report: Report = warn) -> SlamPiece:
    """Read a session, or a map_server map by its YAML file, as a piece of map.

    A map without a topological map gets one. Keyframes of a map that has none are drawn from its
    grid; such a map stays rigid.
    Raises InputError where a file is missing or broken.
    """
    tag = sessions.load_tag(path)
    if GRID.exists(path):
        patch = GRID.load(path).known_area()
    else:
        patch = read_map(sessions.description_of(path), report=report, keeps_unknown=True)
    if TOPOLOGY.exists(path):
        builder = sessions.load_topology(path)
        saved = KEYFRAMES.load_optional(path) if GRID.exists(path) else None
        if saved is not None:
            edges = [*saved.steps, *saved.edges]
            erased = sessions.load_edits(path).erasures.items
            return SlamPiece(saved.frames, edges, patch, builder.map, builder.next_id, erased, tag)
        bare = SlamPiece.of_bare_map(patch, builder.map, builder.next_id)
    else:
        bare = SlamPiece.of_bare_map(patch, build(patch, None, TopologyConfig()))
    return replace(bare, tag=tag)


def write_ids(path: Path, merged: MergedMap) -> None:
    """Write a CSV file with a line for each node of all maps but the first: map, id, merged id."""
    rows = [
        f'{joined.path},{own},{new}' for joined in merged.joins for own, new in joined.ids.items()
    ]
    with atomic_write(path) as aside:
        aside.write_text('\n'.join(['map,id,merged_id', *rows, '']), encoding='utf-8')
