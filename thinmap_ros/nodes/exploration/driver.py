"""Who drives the robot to the targets of an exploration."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node

from thinmap_ros.core.exploration.mission import is_same_goal
from thinmap_ros.core.se2 import Array
from thinmap_ros.nodes.exploration.goal_monitor import PREFIX_BYTES
from thinmap_ros.ros import messages, qos

_ARRIVED_M = 0.3
OnResult = Callable[[bool, str], None]
"""Receives whether the robot reached the last goal, and the reason where it did not."""


class Driver(Protocol):
    """Drives to one goal at a time, and reports how the last one ended."""

    @property
    def is_driving(self) -> bool:
        """Whether there is a goal that has not ended."""

    @property
    def is_yielding(self) -> bool:
        """Whether the goal waits for the end of somebody else's."""

    @property
    def goal(self) -> Array | None:
        """The goal (3,) that has not ended."""

    @property
    def remaining_m(self) -> float | None:
        """Rest of the path to the goal; None where it is unknown."""

    @property
    def goal_prefix(self) -> bytes:
        """PREFIX_BYTES with which the ids of its goals begin."""

    def adopt(self, goal_prefix: bytes) -> None:
        """Count the goals of a killed driver as own ones, by their prefix."""

    def drive_to(self, goal: Array) -> None:
        """Set the goal (3,) in the map frame, instead of an earlier one."""

    def cancel(self) -> None:
        """Cancel the goal; there is no result."""

    def robot_moved(self, T_map_base: Array) -> None:
        """Process the present pose (3,) of the robot."""


class TargetPublisher:
    """Publishes each new target on exploration_target."""

    def __init__(self, node: Node, frame_id: str) -> None:
        self._node = node
        self._frame_id = frame_id
        self._publisher = node.create_publisher(PoseStamped, 'exploration_target', qos.LATCHED)
        self._last: Array | None = None

    def publish(self, goal: Array) -> None:
        """Publish a target (3,), unless it is the last one."""
        if self._last is not None and is_same_goal(self._last, goal):
            return
        self._last = goal
        now_ns = self._node.get_clock().now().nanoseconds
        self._publisher.publish(messages.pose_stamped_msg(goal, self._frame_id, now_ns))

    def clear(self) -> None:
        """Publish the next target in any case."""
        self._last = None


class ForeignDriver:
    """Another navigator drives to the published targets until it arrives, or the target changes."""

    is_yielding = False
    remaining_m: float | None = None
    goal_prefix = bytes(PREFIX_BYTES)

    def __init__(self, on_result: OnResult) -> None:
        self._on_result = on_result
        self.goal: Array | None = None

    @property
    def is_driving(self) -> bool:
        """Whether the robot is still to arrive at the goal."""
        return self.goal is not None

    def adopt(self, goal_prefix: bytes) -> None:
        """Nothing: goals have no ids here."""

    def drive_to(self, goal: Array) -> None:
        """Set the goal (3,)."""
        self.goal = goal

    def cancel(self) -> None:
        """Forget the goal."""
        self.goal = None

    def robot_moved(self, T_map_base: Array) -> None:
        """Report the arrival of a robot at a pose (3,)."""
        goal = self.goal
        if goal is not None and np.hypot(*(goal[:2] - T_map_base[:2])) <= _ARRIVED_M:
            self.goal = None
            self._on_result(True, '')
