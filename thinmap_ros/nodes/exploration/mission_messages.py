"""Missions to and from messages."""

import math

import numpy as np
from geometry_msgs.msg import Point

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import EndNode as EndNodeMsg
from thinmap_msgs.msg import EndNodeArray, ExplorationStatus
from thinmap_ros.core.exploration.mission import Budget, Mission, MissionGoal
from thinmap_ros.core.exploration.strategy import EndNode
from thinmap_ros.ros import messages

_NOT_ESTIMATED = -1.0


def mission_goal_from(message: Explore.Goal) -> MissionGoal:
    """Goal of a mission. Raises InputError where a limit or a corner is no number, or too large."""
    budget = Budget(message.time_limit_s, message.distance_limit_m, message.area_limit_m2)
    area = np.array([[point.x, point.y] for point in message.area.points]).reshape(-1, 2)
    return MissionGoal(budget, area, bool(message.return_home))


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
