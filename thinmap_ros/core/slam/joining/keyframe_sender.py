"""Which keyframes, edges and corrected poses of its map a robot has yet to tell others."""

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array, inverse
from thinmap_ros.core.slam.graph.keyframes import with_calibration
from thinmap_ros.core.slam.graph.loop_closure import LoopClosure
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.joining.keyframe_messages import KeyframeMessage, SentEdge
from thinmap_ros.core.slam.odometry import UNKNOWN


class KeyframeSender:
    """Sends each keyframe of the published map once, and the poses of all after a correction.

    Keyframes that are apart are sent after they are joined. They are numbered as they are sent.
    """

    def __init__(self, loops: LoopClosure) -> None:
        """loops: the keyframes of the robot, and their graph."""
        self.loops = loops
        self.revision = 0  # corrections that were sent
        self._seen_revision = loops.keyframes.revision
        self._is_corrected = False  # since the last message
        self._told: list[int] = []  # their numbers in the graph
        self._waiting: list[int] = []
        self._seen = 0  # keyframes of the graph
        self._open: list[Edge] = []  # those that are not sent
        self._seen_edges = 0

    def corrected_poses(self) -> Array | None:
        """Poses (N, 3) of all that are sent, if they were corrected since the last call."""
        keyframes = self.loops.keyframes
        if keyframes.revision == self._seen_revision:
            return None
        self._seen_revision = keyframes.revision
        self.revision += 1
        self._is_corrected = True
        return np.array([keyframes.frames[k].T_map_base for k in self._told]).reshape(-1, 3)

    def next_message(self) -> KeyframeMessage | None:
        """The next keyframe, or the last one again with edges; None: all are sent.

        Call `corrected_poses` before.
        """
        frames = self.loops.keyframes.frames
        self._waiting += range(self._seen, len(frames))
        self._seen = len(frames)
        pieces = self.loops.pieces
        ready = (k for k in self._waiting if pieces.is_published(frames[k].submap))
        k = next(ready, None)
        if k is None:
            return self._edges_of_loops()
        self._waiting.remove(k)
        self._told.append(k)
        if k:
            self._open.append(self.loops.keyframes.steps[k - 1])
        edges = self._edges()
        last = len(self._told) - 1
        if last and not any(last in (edge.a, edge.b) for edge in edges):
            edges.append(SentEdge(last - 1, last, inverse(UNKNOWN)))
        return self._last(edges)

    def _edges_of_loops(self) -> KeyframeMessage | None:
        """The last keyframe again, with the edges of a loop that no new one has told."""
        if not self._is_corrected:
            return None
        edges = self._edges()
        return self._last(edges) if edges else None

    def _last(self, edges: list[SentEdge]) -> KeyframeMessage:
        """The keyframe that was told last, with edges."""
        self._is_corrected = False
        frame = self.loops.keyframes.frames[self._told[-1]]
        number = len(self._told) - 1
        return KeyframeMessage(number, self.revision, frame.T_map_base, frame.scan, tuple(edges))

    def _edges(self) -> list[SentEdge]:
        """All edges that are not told yet, between keyframes that are."""
        edges = self.loops.graph.edges
        self._open += edges[self._seen_edges :]
        self._seen_edges = len(edges)
        number_of = {told: number for number, told in enumerate(self._told)}
        ready = [edge for edge in self._open if edge.a in number_of and edge.b in number_of]
        self._open = [edge for edge in self._open if edge not in ready]
        return [self._sent(edge, number_of) for edge in ready]

    def _sent(self, edge: Edge, number_of: dict[int, int]) -> SentEdge:
        """An edge with the weight and the uncertainty that it has in the robot's own graph."""
        frames = self.loops.keyframes.frames
        T = se2.between(frames[edge.a].T_map_base, frames[edge.b].T_map_base)
        weight = edge.weight_at(T)
        own = with_calibration(edge, self.loops.calibration)
        return SentEdge(number_of[edge.a], number_of[edge.b], weight * own.information)
