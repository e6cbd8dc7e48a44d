"""Goals that others have at the server that drives the robot."""

from collections import deque
from uuid import uuid4

from action_msgs.msg import GoalStatus, GoalStatusArray
from rclpy.node import Node
from unique_identifier_msgs.msg import UUID

from thinmap_ros.ros import qos

_ACTIVE = (
    GoalStatus.STATUS_ACCEPTED,
    GoalStatus.STATUS_EXECUTING,
    GoalStatus.STATUS_CANCELING,
)
_THROUGH_POSES = 'navigate_through_poses'
_MAX_OWN = 1000


class _GoalStatuses:
    """Goals of one action that are not at their end, by its last status message."""

    def __init__(self, node: Node, action: str) -> None:
        self._node = node
        self._topic = f'{action}/_action/status'
        self._active: set[bytes] = set()
        self._servers: set[bytes] = set()
        node.create_subscription(GoalStatusArray, self._topic, self._on_status, qos.LATCHED)

    def active(self) -> set[bytes]:
        """Ids of the goals; none once the servers that reported them are gone."""
        if self._active and self._servers and not self._servers & self._present_servers():
            self._active.clear()
        return self._active

    def _on_status(self, message: GoalStatusArray) -> None:
        self._servers = self._present_servers()
        self._active = {
            bytes(status.goal_info.goal_id.uuid)
            for status in message.status_list
            if status.status in _ACTIVE
        }

    def _present_servers(self) -> set[bytes]:
        infos = self._node.get_publishers_info_by_topic(self._topic)
        return {bytes(info.endpoint_gid) for info in infos}


class GoalMonitor:
    """Whether the server of an action drives for somebody else.

    It looks at navigate_through_poses in the same namespace, too, as one robot serves both.
    """

    def __init__(self, node: Node, action: str) -> None:
        """action: name of the action navigate_to_pose."""
        self._own: deque[bytes] = deque(maxlen=_MAX_OWN)
        sibling = action[: action.rfind('/') + 1] + _THROUGH_POSES
        self._actions = [_GoalStatuses(node, name) for name in dict.fromkeys((action, sibling))]

    def new_id(self) -> UUID:
        """Id for a goal of our own."""
        goal_id = uuid4().bytes
        self._own.append(goal_id)
        return UUID(uuid=list(goal_id))

    def is_taken(self) -> bool:
        """Whether somebody else has a goal there that is not at its end."""
        return any(action.active().difference(self._own) for action in self._actions)
