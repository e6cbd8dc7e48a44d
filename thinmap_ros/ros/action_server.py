"""An action server with one goal at a time, driven by callbacks without blocking."""

from collections.abc import Callable
from enum import Enum
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle

from thinmap_ros.ros.lifecycle_node import ThinmapNode


class Outcome(Enum):
    """How a goal ended."""

    SUCCEEDED = 'succeeded'
    ABORTED = 'aborted'
    CANCELED = 'canceled'


class SingleGoalServer:
    """Accepts a goal, and returns its result when the node calls `finish`.

    Goals are accepted while the node is active. A new goal preempts the old one, which is aborted
    with the result of `preempted`. rclpy runs a goal in a coroutine, and one that waits keeps the
    executor busy; here the coroutine starts when the result is known. `on_cancel` records the
    request: the node calls `finish` later, from another callback, when the goal's state has
    changed.
    """

    def __init__(
        self,
        node: ThinmapNode,
        action: Any,
        name: str,
        on_goal: Callable[[Any], None],
        on_cancel: Callable[[], None],
        preempted: Callable[[], Any],
    ) -> None:
        self._on_goal = on_goal
        self._on_cancel = on_cancel
        self._preempted = preempted
        self._handle: ServerGoalHandle | None = None
        self._endings: dict[bytes, tuple[Outcome, Any]] = {}
        self._server = ActionServer(
            node,
            action,
            name,
            execute_callback=self._end,
            goal_callback=lambda request: (
                GoalResponse.ACCEPT if node.is_active else GoalResponse.REJECT
            ),
            cancel_callback=self._cancel,
            handle_accepted_callback=self._accept,
        )

    @property
    def active(self) -> bool:
        """Whether there is a goal."""
        return self._handle is not None

    def feedback(self, message: Any) -> None:
        """Publish feedback on the goal, if there is one."""
        if self._handle is not None:
            self._handle.publish_feedback(message)

    def finish(self, outcome: Outcome, result: Any) -> None:
        """End the goal, if there is one, with a result."""
        handle = self._handle
        self._handle = None
        if handle is not None:
            self._endings[bytes(handle.goal_id.uuid)] = (outcome, result)
            handle.execute()

    def _accept(self, handle: ServerGoalHandle) -> None:
        self.finish(Outcome.ABORTED, self._preempted())
        self._handle = handle
        self._on_goal(handle.request)

    def _cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        if self._handle is None or handle.goal_id != self._handle.goal_id:
            return CancelResponse.REJECT
        self._on_cancel()
        return CancelResponse.ACCEPT

    def _end(self, handle: ServerGoalHandle) -> Any:
        outcome, result = self._endings.pop(bytes(handle.goal_id.uuid))
        if outcome is Outcome.CANCELED and handle.is_cancel_requested:
            handle.canceled()
        elif outcome is Outcome.SUCCEEDED:
            handle.succeed()
        else:
            handle.abort()
        return result
