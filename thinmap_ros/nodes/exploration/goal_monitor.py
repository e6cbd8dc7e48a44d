"""Goals that others have at the server that drives the robot."""

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
PREFIX_BYTES = 8


def action_servers(node: Node, action: str) -> set[bytes]:
    """Ids of the servers of an action that the graph knows: of their status publishers."""
    infos = node.get_publishers_info_by_topic(f'{action}/_action/status')
    return {bytes(info.endpoint_gid) for info in infos}


class _GoalStatuses:
    """Goals of one action that are not at their end, by its last status message."""

    def __init__(self, node: Node, action: str) -> None:
        self._node = node
        self._action = action
        self._active: set[bytes] = set()
        self._servers: set[bytes] = set()
        topic = f'{action}/_action/status'
        node.create_subscription(GoalStatusArray, topic, self._on_status, qos.LATCHED)

    def active(self) -> set[bytes]:
        """Ids of the goals; none once the servers that reported them are gone."""
        if (
            self._active
            and self._servers
            and not self._servers & action_servers(self._node, self._action)
        ):
            self._active.clear()
        return self._active

    def _on_status(self, message: GoalStatusArray) -> None:
        self._servers = action_servers(self._node, self._action)
        self._active = {
            bytes(status.goal_info.goal_id.uuid)
            for status in message.status_list
            if status.status in _ACTIVE
        }


class GoalMonitor:
    """Whether the server of an action drives for somebody else.

    It looks at navigate_through_poses in the same namespace, too, as one robot serves both.
    prefix: PREFIX_BYTES with which the ids of our own goals begin; that of a client that was killed
    makes its goals our own.
    """

    def __init__(self, node: Node, action: str) -> None:
        """action: name of the action navigate_to_pose."""
        self.prefix = uuid4().bytes[:PREFIX_BYTES]
        sibling = action[: action.rfind('/') + 1] + _THROUGH_POSES
        self._actions = [_GoalStatuses(node, name) for name in dict.fromkeys((action, sibling))]

    def new_id(self) -> UUID:
        """Id for a goal of our own."""
        return UUID(uuid=list(self.prefix + uuid4().bytes[PREFIX_BYTES:]))

    def is_taken(self) -> bool:
        """Whether somebody else has a goal there that is not at its end."""
        return any(
            not goal_id.startswith(self.prefix)
            for action in self._actions
            for goal_id in action.active()
        )
