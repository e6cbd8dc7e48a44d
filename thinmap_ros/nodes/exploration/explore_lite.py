"""Topics of explore_lite: explore/frontiers, explore/status and explore/resume."""

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import Point, Pose, Vector3
from rclpy.qos import QoSProfile
from std_msgs.msg import Bool, ColorRGBA, String
from visualization_msgs.msg import Marker, MarkerArray

from thinmap_ros.core.exploration.mission import Mission, MissionState
from thinmap_ros.core.exploration.strategy import EndNode, ShowsFrontiers
from thinmap_ros.core.se2 import Array
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode

STARTED = 'exploration_started'
IN_PROGRESS = 'exploration_in_progress'
PAUSED = 'exploration_paused'
COMPLETE = 'exploration_complete'
RETURNING = 'returning_to_origin'
RETURNED = 'returned_to_origin'
_NAMESPACE = 'frontiers'
_POINT_M = 0.1
_SPHERE_M = 0.3
_BLUE = ColorRGBA(b=1.0, a=1.0)
_GREEN = ColorRGBA(g=1.0, a=1.0)
_RED = ColorRGBA(r=1.0, a=1.0)


def status_of(mission: Mission, is_yielding: bool) -> str:
    """Word of explore/status for a mission; empty before the first one.

    is_yielding: whether the robot drives for somebody else.
    """
    is_paused = mission.is_paused or is_yielding
    if mission.is_running and is_paused:
        return PAUSED
    if mission.state == MissionState.EXPLORING:
        return STARTED if mission.decision is None else IN_PROGRESS
    if mission.state == MissionState.RETURNING:
        return RETURNING
    if mission.state == MissionState.FINISHED:
        if mission.has_returned:
            return RETURNED
        # An exploration that was cancelled or failed continues at the next start.
        return COMPLETE if mission.end.is_explored else PAUSED
    return ''


class ExploreLiteTopics:
    """Publishes the state of a mission as explore_lite does, and hears explore/resume."""

    def __init__(self, node: ThinmapNode, frame_id: str, on_resume: Callable[[bool], None]) -> None:
        """on_resume: receives whether to continue or to pause."""
        self._node = node
        self._frame_id = frame_id
        self._status = node.create_publisher(String, 'explore/status', qos.LATCHED)
        self._frontiers = node.create_publisher(
            MarkerArray, 'explore/frontiers', QoSProfile(depth=10)
        )
        self._last_status = ''
        self._is_complete = False
        self._on_resume = on_resume
        node.diagnostics.expect_topic('explore/resume')
        node.create_subscription(Bool, 'explore/resume', self._on_message, qos.STREAM)

    def _on_message(self, message: Bool) -> None:
        self._node.diagnostics.message_received('explore/resume')
        if self._node.is_active:
            self._on_resume(bool(message.data))

    def publish_status(self, mission: Mission, is_yielding: bool) -> None:
        """Publish the status where it has changed; none is left out between two calls."""
        status = status_of(mission, is_yielding)
        if status in (RETURNING, RETURNED) and not self._is_complete:
            self._publish(COMPLETE)
        self._is_complete = status in (COMPLETE, RETURNING, RETURNED) or (
            status == PAUSED and self._is_complete
        )
        if status:
            self._publish(status)

    def publish_frontiers(self, mission: Mission) -> None:
        """Publish the frontiers of a mission, for subscribers only."""
        if self._frontiers.get_subscription_count() == 0:
            return
        markers = [Marker(action=Marker.DELETEALL)]
        markers += [self._points(cells) for cells in _cells_of(mission)]
        decision = mission.decision
        if decision is not None:
            for node in decision.end_nodes:
                if node.frontier_length_m > 0.0:
                    markers.append(self._sphere(node, node.node_id in decision.unreachable))
        header = messages.header(self._frame_id, self._node.get_clock().now().nanoseconds)
        for number, marker in enumerate(markers):
            marker.header = header
            marker.ns = _NAMESPACE
            marker.id = number
        self._frontiers.publish(MarkerArray(markers=markers))

    def _publish(self, status: str) -> None:
        if status != self._last_status:
            self._last_status = status
            self._status.publish(String(data=status))

    def _points(self, cells: Array) -> Marker:
        return Marker(
            type=Marker.POINTS,
            pose=_identity(),
            scale=Vector3(x=_POINT_M, y=_POINT_M, z=_POINT_M),
            color=_BLUE,
            points=[Point(x=x, y=y) for x, y in cells.tolist()],
        )

    def _sphere(self, node: EndNode, is_unreachable: bool) -> Marker:
        size_m = _SPHERE_M * max(1.0, float(np.sqrt(node.frontier_length_m)))
        marker = Marker(type=Marker.SPHERE, pose=_identity())
        marker.pose.position = Point(x=node.x, y=node.y)
        marker.scale = Vector3(x=size_m, y=size_m, z=_SPHERE_M)
        marker.color = _RED if is_unreachable else _GREEN
        return marker


def _cells_of(mission: Mission) -> list[Array]:
    strategy = mission.strategy
    return strategy.frontiers() if isinstance(strategy, ShowsFrontiers) else []


def _identity() -> Pose:
    return messages.pose_msg(np.zeros(3))
