"""The result of a goal, also of one whose server is killed and started again."""

from collections.abc import Callable
from typing import Any

from rclpy.action.client import ClientGoalHandle
from rclpy.node import Node
from rclpy.task import Future

from thinmap_ros.nodes.parts.mission import action_servers
from thinmap_ros.ros.time_jumps import STEADY

_PERIOD_S = 1.0
# A request before the new server has discovered its client is lost.
_REQUESTS = 20


class GoalResult:
    """Requests the result of a goal, and requests it again when there is another server.

    What was requested of a server is lost when it is killed. One that takes its place continues
    the goal, or answers that it does not know it, with STATUS_UNKNOWN.
    """

    def __init__(
        self,
        node: Node,
        action: str,
        handle: ClientGoalHandle,
        on_result: Callable[[Any], None],
    ) -> None:
        """handle: of the goal, just accepted; on_result: receives status and result, once."""
        self._node = node
        self._action = action
        self._handle = handle
        self._on_result = on_result
        self._servers = action_servers(node, action)
        self._requests_left = 0
        self._timer = node.create_timer(_PERIOD_S, self._check, clock=STEADY)
        self._request()

    def _check(self) -> None:
        servers = action_servers(self._node, self._action)
        if servers - self._servers:
            self._servers |= servers
            self._requests_left = _REQUESTS
        if self._requests_left > 0:
            self._requests_left -= 1
            self._request()

    def _request(self) -> None:
        self._handle.get_result_async().add_done_callback(self._on_done)

    def _on_done(self, future: Future) -> None:
        if self._timer is None:
            return  # another answer
        self._node.destroy_timer(self._timer)
        self._timer = None
        self._on_result(future.result())
