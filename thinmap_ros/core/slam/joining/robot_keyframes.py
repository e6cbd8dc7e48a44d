"""The keyframes of a robot's map as another program receives them."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.joining.keyframe_messages import KeyframeMessage, SentEdge
from thinmap_ros.core.slam.matching.surface import surface_points


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
