"""Client of a navigator: of ours, of Nav2, or of any server of nav2_msgs/NavigateToPose."""

from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic

from action_msgs.msg import GoalStatus
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.task import Future

from thinmap_ros.core.exploration.mission import DriveProgress, DriveRequest, Retries
from thinmap_ros.core.se2 import Array
from thinmap_ros.nodes.parts.mission import (
    Driver,
    ExplorationSettings,
    GoalMonitor,
    OnResult,
)
from thinmap_ros.ros import messages
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.services import action_servers
from thinmap_ros.ros.subscription import WARN_PERIOD_S
from thinmap_ros.ros.time_jumps import STEADY

_PERIOD_S = 0.1
# Time after a failure in which a goal that has replaced ours becomes known.
_SETTLE_S = 0.3
_STATUS_NAMES = {
    GoalStatus.STATUS_CANCELED: 'cancelled by somebody else',
    GoalStatus.STATUS_ABORTED: 'aborted',
}


@dataclass
class _Drive:
    """A goal at the server.

    servers: ids of the servers that the graph knew when it was sent. failure: why it failed at
    failed_s, by the clock of the machine.
    """

    request: DriveRequest
    progress: DriveProgress
    servers: set[bytes]
    handle: ClientGoalHandle | None = None
    failure: str = ''
    failed_s: float = 0.0


class NavigationClient(Driver):
    """Sends goals, and reports how the last one ended.

    A goal that is not answered, or no longer reported on, is sent again. One that is rejected, not
    answered or without progress too long has failed. While the server drives for somebody else, the
    goal waits.
    """

    def __init__(
        self,
        node: ThinmapNode,
        settings: ExplorationSettings,
        frame_id: str,
        on_result: OnResult,
        on_longer: Callable[[float], None],
    ) -> None:
        """frame_id: frame of the goals; on_result: receives success and reason of the last one.

        on_longer: receives the rest of the path, m, when that has become longer.
        """
        super().__init__(on_result)
        self._on_longer = on_longer
        self._node = node
        self._settings = settings
        self._frame_id = frame_id
        self._client = ActionClient(node, NavigateToPose, settings.navigate_to_pose_action)
        self._others = GoalMonitor(node, settings.navigate_to_pose_action)
        self._drive: _Drive | None = None
        self._retries = Retries()
        # Only while there is a goal.
        self._timer = node.create_active_timer(_PERIOD_S, self._advance, clock=STEADY)
        self._timer.cancel()

    @property
    def is_yielding(self) -> bool:
        """Whether the goal waits for the end of somebody else's."""
        return self.goal is not None and self._drive is None and self._others.is_taken()

    @property
    def goal_prefix(self) -> bytes:
        """Bytes with which the ids of its goals begin."""
        return self._others.prefix

    def adopt(self, goal_prefix: bytes) -> None:
        """Count goals of a killed client as own ones: they are replaced, not waited for."""
        self._others.prefix = goal_prefix

    def drive_to(self, goal: Array) -> None:
        """Set the goal (3,), unless the server has about the same."""
        self.goal = goal
        self._timer.reset()
        self._advance()

    def cancel(self) -> None:
        """Cancel the goal; there is no result."""
        self.goal = None
        self._withdraw()

    def robot_moved(self, T_map_base: Array) -> None:
        """Give up the goal of a robot at a pose (3,) that makes no progress."""
        drive = self._drive
        if drive is None or not drive.request.is_accepted:
            return
        remaining_m = drive.request.remaining_m
        is_longer = drive.progress.update(T_map_base, remaining_m, self._now_s())
        if is_longer and remaining_m is not None:
            self._on_longer(remaining_m)
        timeout_s = self._settings.progress_timeout
        if 0.0 < timeout_s <= drive.progress.idle_s:
            self._withdraw()
            self._end(False, f'no progress for {timeout_s:.0f} s')

    def _advance(self) -> None:
        """Send the goal if the server does not have it, and may have it."""
        goal = self.goal
        if goal is None:
            self._timer.cancel()
            return
        if not self._keeps_waiting(goal):
            return
        logger = self._node.get_logger()
        if self._others.is_taken():
            logger.info('waiting: the robot drives for somebody else', throttle_duration_sec=10.0)
        elif not self._client.server_is_ready():
            name = self._settings.navigate_to_pose_action
            logger.warning(f'no server of {name} yet', throttle_duration_sec=WARN_PERIOD_S)
        elif self._retries.may_send(self._now_s()):
            self._send(goal)

    def _keeps_waiting(self, goal: Array) -> bool:
        """Check the goal that the server has; returns whether another one may be sent."""
        drive = self._drive
        if drive is None:
            return True
        if drive.failure:
            return self._settle(drive)
        now_s = self._now_s()
        if drive.request.is_unanswered(now_s):
            self._drive = None
            if self._retries.add_unanswered():
                self._end(False, f'no answer for {drive.request.answer_timeout_s:.0f} s')
                return False
            return True
        is_gone = drive.request.is_accepted and self._is_server_gone(drive)
        if is_gone or drive.request.is_silent(now_s):
            self._node.get_logger().warning(
                'the navigator is silent: asking again', throttle_duration_sec=WARN_PERIOD_S
            )
            self._drive = None
            return True
        return not drive.request.is_same(goal)

    def _is_server_gone(self, drive: _Drive) -> bool:
        """Whether there is no server any more, or another one has come since the goal was sent.

        A server that was killed counts as ready for a while.
        """
        return not self._client.server_is_ready() or bool(self._servers() - drive.servers)

    def _servers(self) -> set[bytes]:
        return action_servers(self._node, self._settings.navigate_to_pose_action)

    def _settle(self, drive: _Drive) -> bool:
        """Report a failure, unless somebody else has replaced the goal; then it is sent again."""
        if self._others.is_taken():
            self._drive = None
            return True
        if monotonic() - drive.failed_s >= _SETTLE_S:
            self._drive = None
            self._end(False, drive.failure)
        return False

    def _send(self, goal: Array) -> None:
        now_s = self._now_s()
        request = DriveRequest(goal, now_s, self._retries.answer_timeout_s)
        drive = _Drive(request, DriveProgress(goal), self._servers())
        self._drive = drive
        message = NavigateToPose.Goal()
        message.pose = messages.pose_stamped_msg(goal, self._frame_id, self._node.now_ns)
        sent = self._client.send_goal_async(
            message, lambda feedback: self._on_feedback(feedback, drive), self._others.new_id()
        )
        sent.add_done_callback(lambda future: self._on_response(future, drive))

    def _on_feedback(self, message: NavigateToPose.Impl.FeedbackMessage, drive: _Drive) -> None:
        drive.request.add_feedback(message.feedback.distance_remaining, self._now_s())

    def _on_response(self, future: Future, drive: _Drive) -> None:
        handle = future.result()
        if drive is not self._drive:
            if handle.accepted:
                # Replaced by another goal, or cancelled, before the server responded.
                handle.cancel_goal_async()
            return
        if not handle.accepted:
            self._drive = None
            self._rejected()
            return
        self._retries.add_accepted()
        drive.request.is_accepted = True
        drive.handle = handle
        handle.get_result_async().add_done_callback(lambda done: self._on_done(done, drive))

    def _rejected(self) -> None:
        name = self._settings.navigate_to_pose_action
        self._node.get_logger().warning(
            f'goal rejected by the server of {name}', throttle_duration_sec=WARN_PERIOD_S
        )
        if self._retries.add_rejected(self._now_s()) and not self._others.is_taken():
            self._end(False, f'goal rejected by the server of {name}')

    def _on_done(self, future: Future, drive: _Drive) -> None:
        if drive is not self._drive:
            return  # the result of a goal that was replaced
        ended = future.result()
        if ended.status == GoalStatus.STATUS_SUCCEEDED:
            self._drive = None
            self._end(True, '')
            return
        status = _STATUS_NAMES.get(ended.status, f'ended with status {ended.status}')
        code = f'{status}, error code {ended.result.error_code}'
        drive.failure = str(ended.result.error_msg) or code
        drive.failed_s = monotonic()

    def _withdraw(self) -> None:
        """Have the server drop its goal."""
        drive = self._drive
        self._drive = None
        if drive is not None and drive.handle is not None and not drive.failure:
            drive.handle.cancel_goal_async()

    def _end(self, is_success: bool, reason: str) -> None:
        self.goal = None
        if reason:
            self._node.get_logger().info(f'target not reached: {reason}')
        self._on_result(is_success, reason)

    def _now_s(self) -> float:
        return self._node.elapsed_time.now_s()
