"""A client that explores a world, then sends the robot to random places, until Ctrl-C."""

import signal
from time import monotonic
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from rclpy.node import Node

from thinmap_msgs.action import Explore
from thinmap_ros.ros import messages
from thinmap_ros.sim.drives import random_start
from thinmap_ros.sim.world import World

_PAUSE_S = 0.5  # of the machine; a goal that is rejected at once does not flood the server


class GoalClient:
    """One goal at a time. explorations: that may fail before places are tried without a map."""

    def __init__(self, node: Node, world: World, seed: int, explorations: int = 1) -> None:
        self.goals = 0
        self.reached = 0
        self._world = world
        self._rng = np.random.default_rng(seed)
        self._explore = ActionClient(node, Explore, 'explore')
        self._navigate = ActionClient(node, NavigateToPose, 'navigate_to_pose')
        self._explorations = explorations
        self._handle: Any = None
        self._is_busy = False
        self._number = 0
        self._sent_s = -_PAUSE_S

    def step(self) -> None:
        """Send the next goal if the robot is idle."""
        client = self._explore if self._explorations else self._navigate
        is_early = monotonic() - self._sent_s < _PAUSE_S
        if self._is_busy or is_early or not client.server_is_ready():
            return
        self._is_busy = True
        self._sent_s = monotonic()
        self._number += 1
        number = self._number
        sent = client.send_goal_async(self._next_goal())
        sent.add_done_callback(lambda future: self._on_response(number, future.result()))

    def ask_again(self) -> None:
        """Ask for the result again: the server was killed, and one that is new may answer."""
        if self._handle is not None:
            self._request_result(self._number, self._handle)
        elif self._is_busy:
            self._is_busy = False
            self._number += 1

    def explore_again(self, explorations: int) -> None:
        """Forget the goal, and explore: the nodes were started again."""
        self._is_busy = False
        self._handle = None
        self._number += 1
        self._explorations = explorations

    def _next_goal(self) -> Any:
        if self._explorations:
            return Explore.Goal()
        self.goals += 1
        place = random_start(self._world, self._rng)
        return NavigateToPose.Goal(pose=messages.pose_stamped_msg(place, 'map', 0))

    def _on_response(self, number: int, handle: Any) -> None:
        if number != self._number:
            return
        if handle.accepted:
            self._handle = handle
            self._request_result(number, handle)
        else:
            self._is_busy = False

    def _request_result(self, number: int, handle: Any) -> None:
        asked = handle.get_result_async()
        asked.add_done_callback(lambda future: self._on_ended(number, future.result()))

    def _on_ended(self, number: int, result: Any) -> None:
        if number != self._number:
            return
        self._number += 1
        self._is_busy = False
        self._handle = None
        is_reached = result.status == GoalStatus.STATUS_SUCCEEDED
        if self._explorations:
            self._explorations = 0 if is_reached else self._explorations - 1
        else:
            self.reached += is_reached


class Interruption:
    """Records SIGINT and SIGTERM until `check` is called.

    The second one raises KeyboardInterrupt at once.
    """

    def __init__(self) -> None:
        self._is_requested = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal was received."""
        if self._is_requested:
            raise KeyboardInterrupt

    def _request(self, number: int, frame: object) -> None:
        if self._is_requested:
            raise KeyboardInterrupt
        self._is_requested = True
