"""The exploration of a robot, as the demo requests it: its goal, map, progress and result."""

from collections.abc import Callable
from contextlib import suppress
from time import monotonic
from typing import Any

from action_msgs.msg import GoalStatus
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.task import Future

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.nodes.parts.drives import GoalResult
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.maps import received_map, received_update, updates_topic

# Without an answer for this time, the goal is sent again: an explorer that has just been discovered
# may be unable to answer.
_RESEND_S = 10.0


class RequestedExploration:
    """Client of the action explore of a robot; its names begin with a prefix, '' or 'robot1/'.

    status: the newest one, None before; result: ready for JSON, None before the end.
    """

    def __init__(
        self,
        node: Node,
        prefix: str,
        time_limit_s: float,
        on_map: Callable[[GridPatch], None],
        on_progress: Callable[[], None],
    ) -> None:
        """time_limit_s: simulated time after which the exploration ends; 0: none.

        on_map: receives each map; on_progress: called for each new status.
        """
        self.status: ExplorationStatus | None = None
        self.result: dict[str, Any] | None = None
        self._node = node
        self._goal = Explore.Goal(time_limit_s=time_limit_s)
        self._action = f'{prefix}explore'
        self._on_progress = on_progress
        self._sent: Any = None
        self._sent_at = 0.0
        self._accepted = False
        self._client = ActionClient(node, Explore, self._action)
        self._subscribe(f'{prefix}map', on_map)

    def _subscribe(self, topic: str, on_map: Callable[[GridPatch], None]) -> None:
        receiver = MapReceiver()

        def on_update(message: OccupancyGridUpdate) -> None:
            with suppress(InputError):  # of a map that has not come yet
                patch = received_update(receiver, message)
                if patch is not None:
                    on_map(patch)

        def on_whole(message: OccupancyGrid) -> None:
            on_map(received_map(receiver, message))

        node = self._node
        node.create_subscription(OccupancyGrid, topic, on_whole, qos.LATCHED)
        updates = updates_topic(node, topic)
        node.create_subscription(OccupancyGridUpdate, updates, on_update, qos.STREAM)

    def request(self) -> None:
        """Send the goal, again if there is no answer for a while."""
        if self._accepted or not self._client.server_is_ready():
            return
        if self._sent is not None and monotonic() - self._sent_at < _RESEND_S:
            return
        self._sent_at = monotonic()
        self._sent = self._client.send_goal_async(self._goal, self._on_feedback)
        self._sent.add_done_callback(self._on_accepted)

    @property
    def doing(self) -> str:
        """What the robot does, in words; '' before the first status."""
        status = self.status
        if status is None:
            return ''
        if status.state != ExplorationStatus.EXPLORING:
            return str(status.reason)
        position = status.target_position
        return (
            f'to the end node at {position.x:.1f}, {position.y:.1f}'
            if status.has_target
            else 'looking around'
        )

    def _on_accepted(self, future: Future) -> None:
        if future is not self._sent:
            return  # replaced by a newer goal
        self._accepted = True
        GoalResult(self._node, self._action, future.result(), self._on_result)

    def _on_feedback(self, message: Explore.Impl.FeedbackMessage) -> None:
        self.status = message.feedback.status
        self._on_progress()

    def _on_result(self, ended: Any) -> None:
        status: ExplorationStatus = ended.result.status
        if ended.status == GoalStatus.STATUS_UNKNOWN:
            status.reason = 'the explorer was started again, and does not know the exploration'
        end_ns = messages.stamp_ns(status.header.stamp)
        self.result = {
            'finished': ended.status == GoalStatus.STATUS_SUCCEEDED
            and status.reason_code != ExplorationStatus.BUDGET_EXHAUSTED,
            'reason': status.reason,
            'start_ns': end_ns - round(1e9 * messages.seconds(status.elapsed)),
            'end_ns': end_ns,
        }
        self.status = status
        self._on_progress()
