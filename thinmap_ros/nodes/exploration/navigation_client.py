"""Client of the navigator: one goal at a time, sent again when the navigator is silent."""

from collections.abc import Callable

from action_msgs.msg import GoalStatus
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.task import Future

from thinmap_ros.core.exploration.mission import DriveRequest
from thinmap_ros.core.se2 import Array
from thinmap_ros.ros import messages
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import WARN_PERIOD_S


class NavigationClient:
    """Sends goals to the action navigate_to_pose, and reports how the last one ended."""

    def __init__(
        self, node: ThinmapNode, frame_id: str, on_result: Callable[[bool, str], None]
    ) -> None:
        """Make a client; on_result: receives success and reason, of the last goal only."""
        self._node = node
        self._frame_id = frame_id
        self._on_result = on_result
        self._client = ActionClient(node, NavigateToPose, 'navigate_to_pose')
        self._request: DriveRequest | None = None
        self._handle: ClientGoalHandle | None = None

    @property
    def is_driving(self) -> bool:
        """Whether the navigator has a goal and reports on it."""
        return self._request is not None and not self._request.is_silent(self._now_s())

    def drive_to(self, goal: Array) -> None:
        """Send a goal (3,), unless the navigator has about the same and reports on it."""
        logger = self._node.get_logger()
        if self._request is not None and self._request.is_silent(self._now_s()):
            logger.warning(
                'the navigator is silent: asking again', throttle_duration_sec=WARN_PERIOD_S
            )
            self._request = None
            self._handle = None
        if self._request is not None and self._request.is_same(goal):
            return
        if not self._client.server_is_ready():
            logger.warning('no navigator yet', throttle_duration_sec=WARN_PERIOD_S)
            return
        self._send(DriveRequest(goal, self._now_s()))

    def cancel(self) -> None:
        """Cancel the goal."""
        if self._handle is not None:
            self._handle.cancel_goal_async()
        self._handle = None
        self._request = None

    def _send(self, request: DriveRequest) -> None:
        self._request = request
        goal = NavigateToPose.Goal()
        now_ns = self._node.get_clock().now().nanoseconds
        goal.pose = messages.pose_stamped_msg(request.goal, self._frame_id, now_ns)
        sent = self._client.send_goal_async(goal, self._on_feedback)
        sent.add_done_callback(lambda future: self._on_response(future, request))

    def _on_feedback(self, message: NavigateToPose.Impl.FeedbackMessage) -> None:
        if self._request is not None:
            self._request.last_feedback_s = self._now_s()

    def _on_response(self, future: Future, request: DriveRequest) -> None:
        handle = future.result()
        if request is not self._request:
            if handle.accepted:
                # Replaced by another goal, or cancelled, before the navigator responded.
                handle.cancel_goal_async()
            return
        if not handle.accepted:
            self._request = None
            return
        self._handle = handle
        handle.get_result_async().add_done_callback(lambda done: self._on_done(done, request))

    def _on_done(self, future: Future, request: DriveRequest) -> None:
        if request is not self._request:
            return  # the result of a goal that was replaced
        ended = future.result()
        self._request = None
        self._handle = None
        is_success = ended.status == GoalStatus.STATUS_SUCCEEDED
        self._on_result(is_success, str(ended.result.error_msg))

    def _now_s(self) -> float:
        return float(self._node.get_clock().now().nanoseconds) / 1e9
