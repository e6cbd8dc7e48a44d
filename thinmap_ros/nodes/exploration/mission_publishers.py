"""What the explorer publishes of its mission."""

import math
from collections.abc import Callable

from geometry_msgs.msg import Point

from thinmap_msgs.msg import EndNode as EndNodeMsg
from thinmap_msgs.msg import EndNodeArray, ExplorationStatus
from thinmap_ros.core.exploration.mission import Mission
from thinmap_ros.core.exploration.strategy import EndNode
from thinmap_ros.nodes.exploration.driver import TargetPublisher
from thinmap_ros.nodes.exploration.explore_lite import ExploreLiteTopics
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode

_NOT_ESTIMATED = -1.0


def end_nodes_msg(mission: Mission, frame_id: str, stamp_ns: int) -> EndNodeArray:
    """End nodes of the strategy's last decision."""
    end_nodes = [] if mission.decision is None else mission.decision.end_nodes
    return EndNodeArray(
        header=messages.header(frame_id, stamp_ns),
        end_nodes=[_end_node_msg(node) for node in end_nodes],
    )


def status_msg(mission: Mission, frame_id: str, now_ns: int) -> ExplorationStatus:
    """State and progress of a mission."""
    status = ExplorationStatus(
        header=messages.header(frame_id, now_ns),
        state=int(mission.state),
        reason_code=int(mission.end.code),
        reason=mission.end.reason,
        distance_m=mission.odometer.distance_m,
        elapsed=messages.duration_msg(mission.elapsed_s(now_ns / 1e9)),
        missing_area_m2=_NOT_ESTIMATED,
        missing_area_bound_m2=_NOT_ESTIMATED,
    )
    decision = mission.decision
    if decision is None:
        return status
    status.coverage_estimate = decision.coverage_estimate
    status.known_area_m2 = decision.known_area_m2
    status.reason = status.reason or decision.reason
    status.end_nodes_remaining = decision.remaining
    if decision.missing is not None:
        status.missing_area_m2 = decision.missing.expected_m2
        status.missing_area_bound_m2 = decision.missing.bound_m2
    if decision.target is not None:
        status.has_target = True
        status.target_id = decision.target.node_id
        status.target_position = Point(x=decision.target.x, y=decision.target.y)
    return status


def _end_node_msg(node: EndNode) -> EndNodeMsg:
    is_observed = math.isfinite(node.min_distance_m)
    return EndNodeMsg(
        node_id=node.node_id,
        position=Point(x=node.x, y=node.y),
        position_probability=node.probability,
        distance_index=node.distance_index,
        angle_index=node.angle_index,
        min_distance_m=node.min_distance_m if is_observed else 0.0,
        angle_span_deg=node.angle_span_deg,
        expected_area_m2=node.expected_area_m2,
        is_target=node.is_target,
    )


class MissionPublishers:
    """Publishes end nodes and status.

    target: publishes where the robot drives; lite: the state as explore_lite does.
    """

    def __init__(self, node: ThinmapNode, frame_id: str, on_resume: Callable[[bool], None]) -> None:
        """on_resume: receives what explore/resume asks for, continue or pause."""
        self._clock = node.get_clock()
        self._frame_id = frame_id
        self._end_nodes = node.create_publisher(EndNodeArray, 'end_nodes', qos.LATCHED)
        self._status = node.create_publisher(ExplorationStatus, 'exploration_status', qos.LATCHED)
        self.target = TargetPublisher(node, frame_id)
        self.lite = ExploreLiteTopics(node, frame_id, on_resume)

    def end_nodes(self, mission: Mission, stamp_ns: int) -> None:
        """Publish the end nodes of a decision about a scan."""
        self._end_nodes.publish(end_nodes_msg(mission, self._frame_id, stamp_ns))

    def end_nodes_now(self, mission: Mission) -> EndNodeArray:
        """Message of the end nodes of the last decision."""
        return end_nodes_msg(mission, self._frame_id, self._now_ns())

    def status(self, mission: Mission) -> ExplorationStatus:
        """Publish the status; returns the message."""
        message = self.status_now(mission)
        self._status.publish(message)
        return message

    def status_now(self, mission: Mission) -> ExplorationStatus:
        """Message of the present status."""
        return status_msg(mission, self._frame_id, self._now_ns())

    def _now_ns(self) -> int:
        return int(self._clock.now().nanoseconds)
