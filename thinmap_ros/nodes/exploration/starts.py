"""What starts an exploration: always a goal of the action explore, also of the explorer itself."""

import numpy as np
from rclpy.action import ActionClient
from rclpy.node import Node

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.mission import Budget, MissionGoal
from thinmap_ros.ros.action_server import InvalidGoalError

ACTION = 'explore'


class Starts:
    """Starts the explorer by itself, and refuses goals while the robot is stopped.

    The goal is one of the action, so that its status is public and anybody can cancel it. is_due:
    whether it is still to be sent; is_paused: whether it waits to be continued. stop_reason: why
    the robot is stopped, '' if it is not.
    """

    def __init__(self, node: Node) -> None:
        self.is_due = False
        self.is_paused = False
        self.stop_reason = ''
        self._client = ActionClient(node, Explore, ACTION)

    def reset(self, is_due: bool) -> None:
        """Begin again; a robot that is stopped does not start by itself."""
        self.is_due = is_due and not self.stop_reason
        self.is_paused = False

    def stop_changed(self, reason: str) -> None:
        """Follow the stop of the robot: what has not started yet does not start after it."""
        self.stop_reason = reason
        self.is_due = self.is_due and not reason

    def send_if_due(self) -> None:
        """Send the goal, once, as soon as the server is found."""
        if self.is_due and not self.is_paused and self._client.server_is_ready():
            self.is_due = False
            self._client.send_goal_async(Explore.Goal())

    def read(self, message: Explore.Goal) -> MissionGoal:
        """Goal of a message. Raises InvalidGoalError where it is invalid, or the robot stopped."""
        try:
            if self.stop_reason:
                raise InputError(self.stop_reason)
            return _mission_goal(message)
        except InputError as error:
            status = ExplorationStatus(
                state=ExplorationStatus.FINISHED,
                reason_code=ExplorationStatus.CANCELLED,
                reason=str(error),
            )
            raise InvalidGoalError(Explore.Result(status=status)) from error


def _mission_goal(message: Explore.Goal) -> MissionGoal:
    """Goal of a mission. Raises InputError where a limit or a corner is no number, or too large."""
    budget = Budget(message.time_limit_s, message.distance_limit_m, message.area_limit_m2)
    area = np.array([[point.x, point.y] for point in message.area.points]).reshape(-1, 2)
    return MissionGoal(budget, area, bool(message.return_home))
