"""Goals of navigate_to_pose and explore, of a page; cancelled with those of everybody."""

from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from rclpy.task import Future
from std_msgs.msg import String

from thinmap_msgs.action import Explore
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode

NAVIGATE = 'navigate_to_pose'
EXPLORE = 'explore'
_PAUSED = 'exploration_paused'  # as explore_lite has it, on explore/status
_DRIVING = (NAVIGATE, 'navigate_through_poses')
_ACTIVE = (GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING)
_OUTCOMES = {
    GoalStatus.STATUS_SUCCEEDED: 'done',
    GoalStatus.STATUS_CANCELED: 'cancelled',
    GoalStatus.STATUS_ABORTED: 'failed',
}


class RobotTasks:
    """Sends goals, and cancels all goals of the robot, of all clients."""

    def __init__(
        self,
        node: ThinmapNode,
        map_frame: str,
        on_news: Callable[[str], None],
        on_goal: Callable[[Array | None], None],
    ) -> None:
        """on_news: receives how a goal ends, in words; on_goal: the place (3,) of it, or None."""
        self._node = node
        self._map_frame = map_frame
        self._on_news = on_news
        self._on_goal = on_goal
        self._navigate = ActionClient(node, NavigateToPose, NAVIGATE)
        self._explore = ActionClient(node, Explore, EXPLORE)
        self._cancels = {
            name: node.create_client(CancelGoal, f'{name}/_action/cancel_goal')
            for name in (EXPLORE, *_DRIVING)
        }
        self._is_held = False
        self._cancels_asked = 0
        self._active = {name: False for name in self._cancels}
        self._word = ''
        node.create_subscription(String, 'explore/status', self._on_word, qos.LATCHED)
        self._newest: Future | None = None
        for name in self._cancels:
            node.create_subscription(
                GoalStatusArray,
                f'{name}/_action/status',
                lambda message, name=name: self._on_status(name, message),
                qos.LATCHED,
            )

    def hold(self, is_held: bool) -> None:
        """While the robot is held, each goal of anybody is cancelled."""
        self._is_held = is_held
        if is_held:
            self.cancel_all()

    def cancel_all(self) -> None:
        """Cancel all goals of all clients, and those of the page that are on their way."""
        self._cancels_asked += 1
        for name in self._cancels:
            self._cancel(name)

    def drive_to(self, pose: Array) -> None:
        """Send a goal (3,), map frame. Raises InputError where no navigator runs."""
        self._require(self._navigate, NAVIGATE, 'navigator')
        now_ns = int(self._node.get_clock().now().nanoseconds)
        target = messages.pose_stamped_msg(pose, self._map_frame, now_ns)
        self._on_goal(pose)
        self._send(self._navigate, NavigateToPose.Goal(pose=target), 'goal')

    def require_paused(self) -> None:
        """Raise InputError unless there is an exploration that waits to be continued."""
        if not self._active[EXPLORE] or self._word != _PAUSED:
            raise InputError('resume: no exploration is paused: expected one, or Explore to start')

    def explore(self, area: list[tuple[float, float]], return_home: bool) -> None:
        """Start an exploration inside a polygon, m. Raises InputError where no explorer runs."""
        self._require(self._explore, EXPLORE, 'explorer')
        goal = Explore.Goal(area=messages.polygon_msg(area), return_home=return_home)
        self._send(self._explore, goal, 'exploration')

    def _require(self, client: ActionClient, name: str, node: str) -> None:
        if not client.server_is_ready():
            raise InputError(f'no server of {name}: expected {node} to run')

    def _send(self, client: ActionClient, goal: Any, what: str) -> None:
        sent = client.send_goal_async(goal)
        if what == 'goal':
            self._newest = sent
        cancels = self._cancels_asked
        sent.add_done_callback(lambda future: self._on_answer(future, what, cancels))

    def _on_answer(self, sent: Future, what: str, cancels: int) -> None:
        handle = sent.result()
        if handle is None or not handle.accepted:
            self._end(sent, f'{what} rejected')
            return
        self._on_news(f'{what} accepted')
        if cancels != self._cancels_asked:
            handle.cancel_goal_async()  # all goals were cancelled before this one was known
        handle.get_result_async().add_done_callback(
            lambda future: self._on_result(sent, future.result(), what)
        )

    def _on_result(self, sent: Future, answer: Any, what: str) -> None:
        outcome = _OUTCOMES.get(answer.status, 'ended')
        result = answer.result
        reason = result.error_msg if what == 'goal' else result.status.reason
        self._end(sent, f'{what} {outcome}: {reason}' if reason else f'{what} {outcome}')

    def _end(self, sent: Future, news: str) -> None:
        if sent is self._newest:
            self._on_goal(None)
        self._on_news(news)

    def _cancel(self, name: str) -> None:
        """Cancel all goals of an action: as its service has it, by an id and a time of zero."""
        if self._cancels[name].service_is_ready():
            self._cancels[name].call_async(CancelGoal.Request())

    def _on_status(self, name: str, message: GoalStatusArray) -> None:
        self._active[name] = any(status.status in _ACTIVE for status in message.status_list)
        if self._is_held and self._active[name]:
            self._cancel(name)

    def _on_word(self, message: String) -> None:
        self._word = message.data
