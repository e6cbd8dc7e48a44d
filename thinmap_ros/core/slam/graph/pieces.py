"""Pieces of map: submaps whose places relative to each other are known."""

import math
from collections import defaultdict, deque
from collections.abc import Sequence

from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.consistency import largest_consistent
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.pose_graph import Edge

_PUBLISHED = 0
# Distance between two views of which each says something new. Of eight kidnapped robots that drove
# for 440 s, one joined its piece at a wrong place where those 3 m of path apart were counted, and
# none with this.
_VIEW_M = 3.0
_RECENT = 24  # matches among which consistent ones are searched


class Pieces:
    """The submaps by number, each in a piece; one of the pieces is the published map.

    A submap that begins because scans contradict the map is a piece of its own. Matches of the
    robot's piece with another one are stored; enough that agree are loop edges, which join the two.
    """

    def __init__(self) -> None:
        self._piece_of = [_PUBLISHED]  # by the number of the submap
        self._matches: deque[Edge] = deque(maxlen=_RECENT)

    @property
    def current(self) -> int:
        """Number of the submap that the robot is in."""
        return len(self._piece_of) - 1

    @property
    def piece(self) -> int:
        """Number of the piece that the robot is in."""
        return self._piece_of[-1]

    @property
    def is_apart(self) -> bool:
        """Whether the place of the robot in the published map is unknown."""
        return self._piece_of[-1] != _PUBLISHED

    def load(self, submaps: int) -> None:
        """Begin a submap of the published map, after a number of others of it."""
        self._piece_of = [_PUBLISHED] * (submaps + 1)

    def begin(self) -> None:
        """Begin a submap, apart from all others."""
        self._piece_of.append(len(self._piece_of))

    def return_to_published(self) -> None:
        """The pose in the published map was given: leave a piece that is apart."""
        if self.is_apart:
            self._piece_of.append(_PUBLISHED)

    def is_here(self, submap: int) -> bool:
        """Whether a submap is part of the piece that the robot is in."""
        return self._piece_of[submap] == self._piece_of[-1]

    def is_published(self, submap: int) -> bool:
        """Whether a submap is part of the published map."""
        return self._piece_of[submap] == _PUBLISHED

    def join(self, frames: Sequence[Keyframe], edges: Sequence[Edge]) -> None:
        """Make one piece of those that loop edges connect."""
        for edge in edges:
            ends = (frames[edge.a].submap, frames[edge.b].submap)
            kept, gone = sorted(self._piece_of[submap] for submap in ends)
            self._piece_of = [kept if piece == gone else piece for piece in self._piece_of]

    def add_match(self, edge: Edge) -> None:
        """Add a match of a keyframe in the robot's piece, edge.b, with one in another piece."""
        self._matches.append(edge)

    def take_edges(self, frames: Sequence[Keyframe], fewest: int) -> list[Edge]:
        """Loop edges that join the robot's piece with another one; none while too few agree.

        fewest: matches, each of another view, that join two pieces.
        """
        of_piece: dict[int, list[Edge]] = defaultdict(list)
        for edge in self._matches:
            if self.is_here(frames[edge.b].submap):
                of_piece[self._piece_of[frames[edge.a].submap]].append(edge)
        for edges in of_piece.values():
            agreeing = largest_consistent(edges, frames)
            along_path = sorted(edge.b for edge in agreeing)
            if _count_views([frames[b].T_map_base for b in along_path]) >= fewest:
                self._matches.clear()
                return agreeing
        return []


def _count_views(poses: list[Array]) -> int:
    """Number of poses (3,) that are a view apart from each other (greedy)."""
    views: list[Array] = []
    for T in poses:
        if all(math.dist(T[:2], view[:2]) >= _VIEW_M for view in views):
            views.append(T)
    return len(views)
