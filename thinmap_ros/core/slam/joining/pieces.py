"""Pieces of map from keyframes: those that grow, those that are joined, those of other robots."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.edits import Erasure
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.places.piece import SAME_M, Landmarks, MapPiece, drawn_scans, landmarks_around
from thinmap_ros.core.places.views import View, ViewBuilder
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.joining.messages import KeyframeMessage, SentEdge
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import TopologyBuilder

# Coarser than the map: recognition compares pieces, and nobody sees them.
_CELL_M = 0.1


class GrowingPiece:
    """A piece that grows: keyframes in the frame of the first of them, grid, graph and views.

    That is all that recognition needs of it. numbers: of the keyframes in the pose graph. The graph
    follows the grid with each view: this takes hardly longer than with each keyframe.
    """

    def __init__(self) -> None:
        self.numbers: list[int] = []
        self.frames: list[Keyframe] = []
        self.views: list[View] = []
        self._grid = OccupancyGrid(OccupancyConfig(resolution_m=_CELL_M))
        self._topology = TopologyBuilder(TopologyConfig())
        self._in_graph = 0  # keyframes
        self._views = ViewBuilder()

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def path_m(self) -> float:
        """Length of the path, m."""
        return self.frames[-1].path_m - self.frames[0].path_m if self.frames else 0.0

    def add(self, number: int, frames: Sequence[Keyframe]) -> None:
        """Add a keyframe of those of the pose graph; it is left out where it fits into no map."""
        frame = frames[number]
        first = frames[self.numbers[0]] if self.numbers else frame
        own = replace(frame, T_map_base=se2.between(first.T_map_base, frame.T_map_base))
        try:
            self._grid.add_scan(own.scan, own.T_map_base)
        except InputError:
            return
        self.numbers.append(number)
        self.frames.append(own)
        if views := self._views.add(own):
            self.views += views
            self._update_graph()

    def end_path(self) -> None:
        """Make the views at the end of the path, after the last keyframe."""
        self.views += self._views.finish()

    def map_piece(self, tag: str = '') -> MapPiece:
        """The piece as it is now; tag: of its storey."""
        self._update_graph()
        return MapPiece(self.frames, self._grid.known_area(), self._topology.map, self.views, tag)

    def landmarks(self, view: View) -> Landmarks:
        """Landmarks around a view of this piece."""
        return landmarks_around(self._topology.map, view)

    def is_bent(self, frames: Sequence[Keyframe]) -> bool:
        """Whether a correction has moved its keyframes relative to each other since they came.

        frames: of the pose graph.
        """
        if not self.frames:
            return False
        poses = np.array([frames[number].T_map_base for number in self.numbers])
        own = np.array([frame.T_map_base for frame in self.frames])
        moved = np.array([se2.between(poses[0], T) for T in poses])
        return bool(np.hypot(*(moved - own)[:, :2].T).max() > SAME_M)

    def _update_graph(self) -> None:
        """Let the graph follow the grid."""
        changes = self._grid.take_changes()
        if changes is not None:
            places = [frame.T_map_base for frame in self.frames[self._in_graph :]]
            self._topology.update(changes, np.array(places))
            self._in_graph = len(self.frames)


@dataclass(frozen=True, eq=False)
class SlamPiece:
    """A piece of map that can be joined: keyframes and edges, grid and topological map.

    edges: between keyframes, by their numbers; without any the piece is rigid. next_id: smallest
    number that no node or edge of the graph has had. erased: parts of which no earlier scan shows
    anything. tag: of its storey, '' where nobody knows it.
    """

    frames: Sequence[Keyframe]
    edges: Sequence[Edge]
    patch: GridPatch
    graph: TopologicalMap
    next_id: int
    erased: Sequence[Erasure] = ()
    tag: str = ''

    @staticmethod
    def of_bare_map(patch: GridPatch, graph: TopologicalMap, next_id: int = 1) -> 'SlamPiece':
        """A rigid piece: the scans of its keyframes are drawn from its grid."""
        frames = [
            Keyframe(
                drawn.scan,
                surface_points(drawn.scan),
                drawn.T_map_base,
                0.0,
                np.zeros((3, 3)),
                submap=0,
            )
            for drawn in drawn_scans(patch, graph)
        ]
        return SlamPiece(
            frames, [], patch, graph, max([next_id - 1, *graph.nodes, *graph.edges]) + 1
        )

    @property
    def is_rigid(self) -> bool:
        """Whether it has no pose graph."""
        return not self.edges

    @cached_property
    def poses(self) -> Array:
        """Poses (N, 3) of the keyframes."""
        return np.array([frame.T_map_base for frame in self.frames]).reshape(-1, 3)

    @cached_property
    def places(self) -> MapPiece:
        """The piece for recognition."""
        return MapPiece(self.frames, self.patch, self.graph, tag=self.tag)


@dataclass(frozen=True, eq=False)
class RobotKeyframes:
    """Keyframes of a robot's map, at the poses of the robot's own graph, and edges between them.

    session: of their numbers.
    """

    session: int
    frames: list[Keyframe]
    sent_edges: list[SentEdge]

    @cached_property
    def poses(self) -> Array:
        """Poses T_map_base (N, 3)."""
        return np.array([frame.T_map_base for frame in self.frames]).reshape(-1, 3)

    @cached_property
    def edges(self) -> list[Edge]:
        """The edges: at the poses they have no error, as these are optimal."""
        poses = self.poses
        return [
            Edge(e.a, e.b, se2.between(poses[e.a], poses[e.b]), e.information, robust=False)
            for e in self.sent_edges
        ]


class ReceivedKeyframes:
    """Collects the keyframes of a robot, and corrections of their poses, in any order.

    Of one session: what comes of another one replaces all.
    """

    def __init__(self) -> None:
        self.map_id = 0
        self._session = 0
        self._frames: dict[int, tuple[int, Keyframe]] = {}  # with their revision
        self._edges: list[SentEdge] = []
        self._corrections: dict[int, tuple[int, Array]] = {}  # newest by session
        self._known: RobotKeyframes | None = None

    def add(self, session: int, map_id: int, message: KeyframeMessage) -> None:
        """Add a keyframe of a session, and of the map of an id."""
        if session != self._session:
            self._session = session
            self.map_id = map_id
            self._frames.clear()
            self._edges.clear()
            self._known = None
        if message.number not in self._frames:
            scan = message.scan
            frame = Keyframe(
                scan, surface_points(scan), message.T_map_base, 0.0, np.zeros((3, 3)), submap=0
            )
            self._frames[message.number] = (message.revision, frame)
        self._edges += message.edges

    def correct(self, session: int, revision: int, poses: Array) -> None:
        """Take corrected poses (N, 3) of the first keyframes of a session."""
        self._corrections = {session: (revision, poses)}

    def known(self) -> RobotKeyframes | None:
        """The keyframes up to the first one that is missing; None without any.

        Those of the last call, as long as the poses of a correction are missing.
        """
        revision, poses = self._corrections.get(self._session, (0, np.zeros((0, 3))))
        found: list[Keyframe] = []
        while len(found) in self._frames:
            number = len(found)
            own, frame = self._frames[number]
            if number < len(poses):
                frame = replace(frame, T_map_base=poses[number])
            elif own != revision:
                return self._known
            found.append(frame)
        if found:
            edges = [edge for edge in self._edges if max(edge.a, edge.b) < len(found)]
            self._known = RobotKeyframes(self._session, found, edges)
        return self._known
