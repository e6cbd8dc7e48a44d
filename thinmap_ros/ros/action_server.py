"""An action server with one goal at a time, driven by callbacks without blocking."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

from action_msgs.msg import GoalInfo
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from unique_identifier_msgs.msg import UUID

from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.private_rclpy import adopt_goal, begin_goal


class Outcome(Enum):
    """How a goal ended."""

    SUCCEEDED = 'succeeded'
    ABORTED = 'aborted'
    CANCELED = 'canceled'


class InvalidGoalError(Exception):
    """A goal that cannot be followed, with the result that its client receives."""

    def __init__(self, result: Any) -> None:
        super().__init__(str(result))
        self.result = result


@dataclass(frozen=True)
class _Goal:
    """An accepted goal, and the server that accepted it."""

    server: ActionServer
    handle: ServerGoalHandle


class SingleGoalServer:
    """Accepts a goal, and returns its result when the node calls `finish`.

    Goals are accepted while the node is active. A new goal preempts the old one, which is aborted
    with the result of `preempted`. rclpy runs a goal in a coroutine, and one that waits keeps the
    executor busy; here the coroutine starts when the result is known, although the goal's status
    is EXECUTING from its acceptance on, as clients of Nav2 expect. One server may serve several
    actions: there is one goal at a time among all of them.

    A goal for which a cancel was accepted ends CANCELED, whatever ends it: the node, which looks at
    `is_cancel_requested` from time to time, or a newer goal. As in Nav2.
    """

    def __init__(
        self,
        node: ThinmapNode,
        action: Any,
        name: str,
        on_goal: Callable[[Any], None],
        preempted: Callable[[], Any],
        read: Callable[[Any], Any] = lambda request: request,
    ) -> None:
        """on_goal: receives what `read` returns for the goal of a request.

        read: raises InvalidGoalError for a goal that is aborted at once; the old goal continues.
        preempted: returns the result of the old goal, before `on_goal` is called.
        """
        self._node = node
        self._on_goal = on_goal
        self._preempted = preempted
        self._goal: _Goal | None = None
        self._servers: list[ActionServer] = []
        self._endings: dict[bytes, tuple[Outcome, Any]] = {}
        self.add_action(action, name, read)

    def add_action(self, action: Any, name: str, read: Callable[[Any], Any]) -> None:
        """Serve another action; read: as for the first one."""
        server: ActionServer = ActionServer(
            self._node,
            action,
            name,
            execute_callback=self._end,
            goal_callback=lambda request: (
                GoalResponse.ACCEPT if self._node.is_active else GoalResponse.REJECT
            ),
            cancel_callback=self._cancel,
            handle_accepted_callback=lambda handle: self._accept(_Goal(server, handle), read),
        )
        self._servers.append(server)

    @property
    def active(self) -> bool:
        """Whether there is a goal."""
        return self._goal is not None

    @property
    def goal_id(self) -> bytes:
        """Id of the goal, 16 bytes; none without a goal."""
        return b'' if self._goal is None else bytes(self._goal.handle.goal_id.uuid)

    @property
    def is_cancel_requested(self) -> bool:
        """Whether a cancel of the goal was accepted: the node is to finish it."""
        return self._goal is not None and self._goal.handle.is_cancel_requested

    def restore(self, goal_id: bytes) -> None:
        """Accept a goal of the first action again, which a server of before had accepted.

        For its client, its status, feedback and cancellation are as before. The result is sent to
        those who ask from now on: what was asked for was lost with the server of before.
        """
        server = self._servers[0]
        stamp = self._node.get_clock().now().to_msg()
        info = GoalInfo(goal_id=UUID(uuid=list(goal_id)), stamp=stamp)
        handle = ServerGoalHandle(server, info, server.action_type.Goal())
        adopt_goal(server, handle, goal_id)
        begin_goal(handle)
        self._goal = _Goal(server, handle)

    def feedback(self, message: Any) -> None:
        """Publish feedback on the goal, if there is one."""
        if self._goal is not None:
            self._goal.handle.publish_feedback(message)

    def finish(self, outcome: Outcome, result: Any) -> None:
        """End the goal, if there is one, with a result."""
        goal = self._goal
        self._goal = None
        if goal is not None:
            self._run(goal, outcome, result)

    def _run(self, goal: _Goal, outcome: Outcome, result: Any) -> None:
        """Run the coroutine of a goal, which ends at once."""
        self._endings[bytes(goal.handle.goal_id.uuid)] = (outcome, result)
        goal.server.notify_execute(goal.handle, None)

    def _accept(self, goal: _Goal, read: Callable[[Any], Any]) -> None:
        begin_goal(goal.handle)
        try:
            request = read(goal.handle.request)
        except InvalidGoalError as invalid:
            self._run(goal, Outcome.ABORTED, invalid.result)
            return
        except Exception:
            self._run(goal, Outcome.ABORTED, goal.server.action_type.Result())
            raise
        self.finish(Outcome.ABORTED, self._preempted())
        self._goal = goal
        try:
            self._on_goal(request)
        except Exception:
            self.finish(Outcome.ABORTED, goal.server.action_type.Result())
            raise

    def _cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        is_current = self._goal is not None and handle.goal_id == self._goal.handle.goal_id
        # Replaced just now, by a goal that was received together with the cancel.
        outcome, _ = self._endings.get(bytes(handle.goal_id.uuid), (None, None))
        is_cancelable = is_current or outcome is Outcome.ABORTED
        return CancelResponse.ACCEPT if is_cancelable else CancelResponse.REJECT

    def _end(self, handle: ServerGoalHandle) -> Any:
        outcome, result = self._endings.pop(bytes(handle.goal_id.uuid))
        if handle.is_cancel_requested:
            handle.canceled()
        elif outcome is Outcome.SUCCEEDED:
            handle.succeed()
        else:
            handle.abort()
        return result
