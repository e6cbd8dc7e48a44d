"""Pieces of map: one is published, and the one that the robot is in may be apart from it.

A piece that is apart is looked for in the published map, a little with each scan, by the views
along its path. Where the odds are high enough, both are joined by matches of its keyframes.
Source: Elvira, Tardos and Montiel, "ORBSLAM-Atlas: a robust and accurate multi-map system", 2019.
"""

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from thinmap_ros.core import se2
from thinmap_ros.core.places.recognition import Placement, Recognition, decide
from thinmap_ros.core.slam.graph.loop_closure import LoopClosure
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.joining.links import match_keyframes, placed_keyframes
from thinmap_ros.core.slam.joining.pieces import GrowingPiece
from thinmap_ros.core.stage import Apart, Join

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
    """Joins the piece that the robot is in with the published map once its place is recognized."""

    def __init__(self, loops: LoopClosure) -> None:
        """loops: the keyframes, their graph and the pieces."""
        self._loops = loops
        self._join: Join | None = None
        self._search: _Search | None = None

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
        frames = self._loops.keyframes.frames
        if self._search is None or self._search.is_outdated(self._loops):
            published = (k for k, frame in enumerate(frames) if pieces.is_published(frame.submap))
            self._search = _Search(pieces.piece, published)
        search = self._search
        self._search = None  # begun again if this step of it fails
        self._join = search.step(self._loops, join_odds) or self._join
        self._search = search

    def take_join(self) -> Join | None:
        """The join that a correction has completed; None where it was a loop of its own."""
        join = self._join
        self._join = None
        return join


class _Search:
    """Looks for a piece in the published map."""

    def __init__(self, piece: int, published: Iterable[int]) -> None:
        """piece: its number; published: numbers of the keyframes of the published map."""
        self._log_odds = -math.inf
        self._piece = piece
        self._known = GrowingPiece()
        self._waiting = deque(published)
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
        return is_corrected and (self._known.is_bent(frames) or self._query.is_bent(frames))

    def step(self, loops: LoopClosure, join_odds: float) -> Join | None:
        """Do one of: add keyframes, look for a view, match a keyframe, join both."""
        frames = loops.keyframes.frames
        if self._matching is not None:
            return self._match(self._matching, loops)
        if self._waiting:
            for _ in range(min(_KEYFRAMES_PER_SCAN, len(self._waiting))):
                number = self._waiting.popleft()
                self._known.add(number, frames[number])
            if not self._waiting:
                self._known.end_path()
        elif self._has_view:
            self._look(join_odds)
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
                self._query.add(number, frames[number])
                return

    def _look(self, join_odds: float) -> None:
        """Look for the next view, and begin to join if the place is sure."""
        if not len(self._known):
            return
        if self._recognition is None:
            self._recognition = Recognition(self._known.map_piece())
        recognition = self._recognition
        view = self._query.views[len(recognition.views)]
        recognition.add(view, self._query.landmarks(view))
        decision = decide(recognition, self._query.map_piece(), recognition.known, join_odds)
        self._log_odds = decision.log_odds
        if decision.is_joined and decision.placement is not None:
            placement = decision.placement
            priors = placed_keyframes(self._query.frames, self._query.views, placement.hypothesis)
            matches = match_keyframes(self._known.frames, self._query.frames, priors)
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
            a = self._known.numbers[link.a]
            matching.links.append(replace(link, a=a, b=self._query.numbers[link.b]))
        return None

    def _joined(self, matching: _Matching, loops: LoopClosure) -> Join:
        frames = loops.keyframes.frames
        T_map_known = frames[self._known.numbers[0]].T_map_base
        T_map_query = frames[self._query.numbers[0]].T_map_base
        T_map_joined = se2.compose(T_map_known, matching.placement.T_map_piece)
        T = se2.compose(T_map_joined, se2.invert(T_map_query))
        loops.join(T, matching.links)
        return Join(T, matching.log_odds, self._query.path_m, len(matching.links))
