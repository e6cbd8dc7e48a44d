"""Joins two pieces of map: while a robot drives in one that is apart, and of saved maps."""

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.correction import add_scan_outside
from thinmap_ros.core.grid.edits import Erasure
from thinmap_ros.core.grid.moved import MapMotion, overlaid
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.places.piece import MATCH_M, MATCH_RAD
from thinmap_ros.core.places.recognition import PieceHypothesis, Placement, Recognition, decide
from thinmap_ros.core.places.views import View
from thinmap_ros.core.se2 import Array, inverse, propagated_covariance, rotated_covariance
from thinmap_ros.core.slam.graph.keyframes import Keyframe, view_difference_m
from thinmap_ros.core.slam.graph.loop_closure import (
    EDGE_NOISE,
    LoopClosure,
    LoopClosureConfig,
    Pieces,
    Submaps,
)
from thinmap_ros.core.slam.graph.pose_graph import Edge, optimized
from thinmap_ros.core.slam.joining.pieces import GrowingPiece, SlamPiece
from thinmap_ros.core.slam.matching.local_map import LocalMapConfig
from thinmap_ros.core.slam.matching.scan_matcher import MIN_POINTS, Matcher, MatchingConfig
from thinmap_ros.core.stage import Apart, Join
from thinmap_ros.core.topology.topology import Ids, TopologyBuilder, join_topologies, moved_map

_CONFIG = LoopClosureConfig()

# How far the place of a view is off at its other keyframes.
_PRIOR = np.diag(np.square([MATCH_M, MATCH_M, MATCH_RAD]))

# Less than of a loop: the place is known. With 0.75, errors between real halves were a fifth more.
_MIN_INLIER_RATIO = 0.7

# A keyframe by its number, and its predicted pose (3,) in the known piece.
Prior = tuple[int, Array]


def placed_keyframes(
    query: Sequence[Keyframe], views: Sequence[View], hypothesis: PieceHypothesis
) -> Iterator[Prior]:
    """Keyframes of the views that a hypothesis places; views: all of the piece, by number."""
    placed = [views[number] for number in sorted(hypothesis.poses)]
    for k, frame in enumerate(query):
        around = [view for view in placed if view.frames[0] <= k <= view.frames[2]]
        if around:
            view = min(around, key=lambda each: abs(each.frames[1] - k))
            T_view_frame = se2.between(view.T_piece_view, frame.T_map_base)
            yield k, se2.compose(hypothesis.poses[view.number], T_view_frame)


def match_keyframes(
    known: Sequence[Keyframe], query: Sequence[Keyframe], priors: Iterable[Prior]
) -> Iterator[Edge | None]:
    """Match keyframes of a piece with submaps of the known one, where they are near to it.

    Yields an edge from a keyframe of the known piece to one of the query, each by its own number,
    for each match, or None for one that failed: a caller may do one at a time.
    """
    matcher = Matcher(MatchingConfig())
    submaps = Submaps(LocalMapConfig())
    poses = np.array([frame.T_map_base for frame in known]).reshape(-1, 3)
    for k, prior in priors:
        frame = query[k]
        j = _nearest(poses, prior)
        if j is None or len(frame.points) < MIN_POINTS:
            continue
        base, submap = submaps.around(known, j, math.inf)
        match = matcher.match(
            frame.points, frame.scan.T_base_laser, submap, se2.between(base, prior), _PRIOR
        )
        if match.inlier_ratio < _MIN_INLIER_RATIO:
            yield None
            continue
        covariance = inverse(match.scan_information + 1e-3 * np.eye(3)) + EDGE_NOISE
        T_j_base = se2.between(poses[j], base)
        information = inverse(rotated_covariance(covariance, float(T_j_base[2])))
        yield Edge(j, k, se2.compose(T_j_base, match.pose), information, robust=True)


def _nearest(poses: Array, T: Array) -> int | None:
    """The pose (N, 3) with the most similar view; None if all are too far away."""
    away = np.hypot(*(poses[:, :2] - T[:2]).T)
    near = np.flatnonzero(away < _CONFIG.search_radius_m)
    if not len(near):
        return None
    return int(min(near, key=lambda j: view_difference_m(poses[j], T)))


# Of the published map, with each scan: its grid and graph are made again from its keyframes.
_KEYFRAMES_PER_SCAN = 2


@dataclass(frozen=True, eq=False)
class _Matching:
    """A join in progress: the place of the piece, matches to be made, and those made so far."""

    placement: Placement
    log_odds: float
    matches: Iterator[Edge | None]
    links: list[Edge]


class Atlas:
    """Joins the piece that the robot is in with the published map once its place is recognized.

    A piece that is apart is looked for in the published map, a little with each scan, by the views
    along its path. Where the odds are high enough, both are joined by matches of its keyframes.
    What recognition needs of the published map is kept: the next search adds what is new.
    Source: Elvira, Tardos and Montiel, "ORBSLAM-Atlas: a robust and accurate multi-map system",
    2019.
    """

    def __init__(self, loops: LoopClosure) -> None:
        """loops: the keyframes, their graph and the pieces."""
        self._loops = loops
        self._join: Join | None = None
        self._search: _PieceSearch | None = None
        self._known: GrowingPiece | None = None

    @property
    def apart(self) -> Apart | None:
        """The piece that the robot is in; None if that is the published map."""
        if not self._loops.pieces.is_apart:
            return None
        return Apart(0.0, -math.inf) if self._search is None else self._search.apart

    def step(self, join_odds: float) -> None:
        """Do some of the pending work; called once per scan.

        join_odds: odds of its place with which a piece is joined.
        """
        pieces = self._loops.pieces
        if not pieces.is_apart:
            self._search = None
            return
        if self._loops.graph.is_moving:
            return
        search = self._search
        if search is None or search.is_outdated(self._loops):
            search = self._begun()
        self._search = None  # begun again if this step of it fails, with all of the map
        self._known = None
        self._join = search.step(self._loops, join_odds) or self._join
        self._search = search
        self._known = search.known

    def _begun(self) -> '_PieceSearch':
        """A search for the piece that the robot is in; a map that was bent is made again."""
        frames = self._loops.keyframes.frames
        pieces = self._loops.pieces
        published = [k for k, frame in enumerate(frames) if pieces.is_published(frame.submap)]
        known = self._known
        if known is None or known.is_bent(frames) or not {*known.numbers} <= {*published}:
            known = GrowingPiece()
        return _PieceSearch(pieces.piece, known, sorted({*published} - {*known.numbers}))

    def take_join(self) -> Join | None:
        """The join that a correction has completed; None where it was a loop of its own."""
        join = self._join
        self._join = None
        return join


class _PieceSearch:
    """Looks for a piece in the published map."""

    def __init__(self, piece: int, known: GrowingPiece, waiting: Iterable[int]) -> None:
        """piece: its number; known: of the published map; waiting: its keyframes not yet in it."""
        self._log_odds = -math.inf
        self._piece = piece
        self.known = known
        self._waiting = deque(waiting)
        self._query = GrowingPiece()
        self._next = 0  # keyframe that is looked at next
        self._recognition: Recognition | None = None
        self._matching: _Matching | None = None
        self._revision: int | None = None

    @property
    def apart(self) -> Apart:
        """The piece, as far as it has been looked at."""
        return Apart(self._query.path_m, self._log_odds)

    def is_outdated(self, loops: LoopClosure) -> bool:
        """Whether the robot is in another piece, or one of the two was bent by a correction."""
        if self._piece != loops.pieces.piece:
            return True
        is_corrected = self._revision != loops.keyframes.revision
        self._revision = loops.keyframes.revision
        frames = loops.keyframes.frames
        return is_corrected and (self.known.is_bent(frames) or self._query.is_bent(frames))

    def step(self, loops: LoopClosure, join_odds: float) -> Join | None:
        """Do one of: add keyframes, look for a view, match a keyframe, join both."""
        frames = loops.keyframes.frames
        if self._matching is not None:
            return self._match(self._matching, loops)
        if self._waiting:
            for _ in range(min(_KEYFRAMES_PER_SCAN, len(self._waiting))):
                number = self._waiting.popleft()
                self.known.add(number, frames)
            if not self._waiting:
                self.known.end_path()
        elif self._has_view and not loops.pieces.is_other_storey():
            self._look(loops.pieces, join_odds)
        else:
            self._grow(loops)
        return None

    @property
    def _has_view(self) -> bool:
        looked_for = 0 if self._recognition is None else len(self._recognition.views)
        return looked_for < len(self._query.views)

    def _grow(self, loops: LoopClosure) -> None:
        """Add the next keyframe to the piece."""
        frames = loops.keyframes.frames
        while self._next < len(frames):
            number = self._next
            self._next += 1
            if loops.pieces.is_here(frames[number].submap):
                self._query.add(number, frames)
                return

    def _look(self, pieces: Pieces, join_odds: float) -> None:
        """Look for the next view, and begin to join if the place is sure."""
        if not len(self.known):
            return
        if self._recognition is None:
            self._recognition = Recognition(self.known.map_piece(pieces.published_tag))
        recognition = self._recognition
        view = self._query.views[len(recognition.views)]
        recognition.add(view, self._query.landmarks(view))
        query = self._query.map_piece(pieces.tag)
        decision = decide(recognition, query, recognition.known, join_odds)
        self._log_odds = decision.log_odds
        if decision.is_joined and decision.placement is not None:
            placement = decision.placement
            priors = placed_keyframes(self._query.frames, self._query.views, placement.hypothesis)
            matches = match_keyframes(self.known.frames, self._query.frames, priors)
            self._matching = _Matching(placement, decision.log_odds, matches, [])

    def _match(self, matching: _Matching, loops: LoopClosure) -> Join | None:
        """Match the next keyframe; join the piece after the last one, if enough have matched."""
        try:
            link = next(matching.matches)
        except StopIteration:
            self._matching = None
            is_linked = len(matching.links) >= loops.min_consistent_matches
            return self._joined(matching, loops) if is_linked else None
        if link is not None:
            a = self.known.numbers[link.a]
            matching.links.append(replace(link, a=a, b=self._query.numbers[link.b]))
        return None

    def _joined(self, matching: _Matching, loops: LoopClosure) -> Join:
        frames = loops.keyframes.frames
        T_map_known = frames[self.known.numbers[0]].T_map_base
        T_map_query = frames[self._query.numbers[0]].T_map_base
        T_map_joined = se2.compose(T_map_known, matching.placement.T_map_piece)
        T = se2.compose(T_map_joined, se2.invert(T_map_query))
        loops.join(T, matching.links)
        return Join(T, matching.log_odds, self._query.path_m, len(matching.links))


_MAX_LINKS = 100  # for one transform; more take time


def rigid_links(first: SlamPiece, second: SlamPiece, priors: Sequence[Prior]) -> list[Edge]:
    """Matches of keyframes of the second piece with the first one, at predicted poses."""
    some = priors[:: 1 + len(priors) // _MAX_LINKS]
    return found(match_keyframes(first.frames, second.frames, some))


def found(links: Iterable[Edge | None]) -> list[Edge]:
    """The matches that did not fail."""
    return [link for link in links if link is not None]


def rigid_transform(first: SlamPiece, second: SlamPiece, T: Array, links: Sequence[Edge]) -> Array:
    """Pose T_first_second (3,) that the links agree on, from a rough one."""
    bodies = [_between_bodies(link, first, second) for link in links]
    return np.asarray(optimized(np.vstack([np.zeros(3), T]), bodies)[1])


def refined(first: SlamPiece, second: SlamPiece, T: Array) -> tuple[Array, int]:
    """Pose T_first_second (3,) near a given one by matches of all keyframes, and their number."""
    priors = [(k, se2.compose(T, own)) for k, own in enumerate(second.poses)]
    near = [(k, prior) for k, prior in priors if first.patch.contains(prior[None, :2])[0]]
    links = rigid_links(first, second, near)
    return rigid_transform(first, second, T, links), len(links)


def _between_bodies(link: Edge, first: SlamPiece, second: SlamPiece) -> Edge:
    """A link as an edge from the frame of the first piece to that of the second."""
    T_first_a = first.poses[link.a]
    T_first_b = se2.compose(T_first_a, link.T_a_b)
    T_first_second = se2.compose(T_first_b, se2.invert(second.poses[link.b]))
    covariance = rotated_covariance(inverse(link.information), float(T_first_a[2]))
    covariance = propagated_covariance(covariance, T_first_second[:2] - T_first_b[:2])
    return Edge(0, 1, T_first_second, inverse(covariance), robust=True)


@dataclass(frozen=True, eq=False)
class JoinedMap:
    """The map of two pieces, in the frame of the first.

    T_first_second (3,): frame of the second piece; ids: of the nodes of the second piece in the
    map, by their own; links: number of edges between keyframes of both; motions: how the places of
    the first and of the second piece have moved.
    """

    piece: SlamPiece
    grid: OccupancyGrid
    topology: TopologyBuilder
    T_first_second: Array
    ids: Ids
    links: int
    motions: tuple[MapMotion, MapMotion]


def join(
    first: SlamPiece, second: SlamPiece, placement: Placement, grid: OccupancyConfig | None = None
) -> JoinedMap:
    """Join two pieces, given where the second lies in the first: one graph, grid and topology.

    grid: configuration of the joined one.
    If both have edges, all keyframes are optimized together, and the grid is rendered from their
    scans. Otherwise both stay rigid.
    """
    is_rigid = first.is_rigid or second.is_rigid
    priors = list(placed_keyframes(second.frames, second.places.views, placement.hypothesis))
    if is_rigid:
        links = rigid_links(first, second, priors)
        return _joined_rigidly(first, second, placement.T_map_piece, links, grid)
    links = found(match_keyframes(first.frames, second.frames, priors))
    return _optimized_together(first, second, placement.T_map_piece, links, grid)


def _optimized_together(
    first: SlamPiece,
    second: SlamPiece,
    T: Array,
    links: Sequence[Edge],
    config: OccupancyConfig | None,
) -> JoinedMap:
    count = len(first.frames)
    poses = np.vstack([first.poses, [se2.compose(T, own) for own in second.poses]])
    both = [*first.frames, *_later(second.frames, first.frames)]
    frames = _at(both, _bent(poses, first, second, links))
    # Again, where the other keyframes are now: those of the views alone left a third more error.
    nearby = enumerate(frame.T_map_base for frame in frames[count:])
    links = found(match_keyframes(frames[:count], frames[count:], nearby))
    poses = _bent(poses, first, second, links)
    frames = _at(frames, poses)
    motions = (MapMotion(first.poses, poses[:count]), MapMotion(second.poses, poses[count:]))
    erased = _erased(first, second, motions)
    grid = OccupancyGrid(config, first.patch.frame)
    for frame in frames:  # with its scan, but for what was erased after that was made
        later = [each.corners for each in erased if each.stamp_ns >= frame.scan.stamp_ns]
        add_scan_outside(grid, frame.scan, frame.T_map_base, later)
    patch = grid.known_area()
    topology, ids = join_topologies(
        patch,
        moved_map(first.graph, first.poses, poses[:count]),
        moved_map(second.graph, second.poses, poses[count:]),
        first.next_id,
    )
    edges = _all_edges(first, second, links)
    piece = SlamPiece(frames, edges, patch, topology.map, topology.next_id, erased)
    nearest = links[0].b if links else 0
    T_joined = se2.compose(poses[count + nearest], se2.invert(second.poses[nearest]))
    return JoinedMap(piece, grid, topology, T_joined, ids, len(links), motions)


def _later(frames: Sequence[Keyframe], earlier: Sequence[Keyframe]) -> Iterator[Keyframe]:
    """The keyframes, with submaps and a path of their own after those of others.

    Without headings: those are relative to the first keyframe of the piece that they come from.
    """
    submaps = 1 + max(frame.submap for frame in earlier)
    path_m = max(frame.path_m for frame in earlier)
    for frame in frames:
        yield replace(
            frame, submap=submaps + frame.submap, path_m=path_m + frame.path_m, heading=None
        )


def _erased(
    first: SlamPiece, second: SlamPiece, motions: tuple[MapMotion, MapMotion]
) -> list[Erasure]:
    """Erased parts of both pieces, where they are now."""
    return [
        erasure.moved(motion.before, motion.after)
        for piece, motion in zip((first, second), motions, strict=True)
        for erasure in piece.erased
    ]


def _all_edges(first: SlamPiece, second: SlamPiece, links: Sequence[Edge]) -> list[Edge]:
    """Edges of both pieces and between them; keyframes of the second count after the first."""
    count = len(first.frames)
    shifted = (edge.shifted(count, count) for edge in second.edges)
    return [*first.edges, *shifted, *(link.shifted(0, count) for link in links)]


def _bent(poses: Array, first: SlamPiece, second: SlamPiece, links: Sequence[Edge]) -> Array:
    """Poses (N, 3) of all keyframes after an optimization."""
    return optimized(poses, _all_edges(first, second, links))


def _at(frames: Sequence[Keyframe], poses: Array) -> list[Keyframe]:
    return [replace(frame, T_map_base=T) for frame, T in zip(frames, poses, strict=True)]


def _joined_rigidly(
    first: SlamPiece,
    second: SlamPiece,
    T: Array,
    links: Sequence[Edge],
    config: OccupancyConfig | None,
) -> JoinedMap:
    T = rigid_transform(first, second, T, links)
    motions = (MapMotion.rigid(np.zeros(3)), MapMotion.rigid(T))
    patch = overlaid(first.patch, second.patch, T)
    topology, ids = join_topologies(
        patch,
        moved_map(first.graph, motions[0].before, motions[0].after),
        moved_map(second.graph, motions[1].before, motions[1].after),
        first.next_id,
    )
    piece = SlamPiece.of_bare_map(patch, topology.map, topology.next_id)
    grid = OccupancyGrid.from_patch(patch, config)
    return JoinedMap(piece, grid, topology, T, ids, len(links), motions)
