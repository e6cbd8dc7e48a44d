"""Whether a node's robot explores with others, under which name, and where their maps lie."""

from dataclasses import dataclass

from rclpy.node import Node

from thinmap_msgs.msg import JoinStatus
from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.se2 import Array
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import subscribe_guarded


@dataclass(frozen=True)
class MembershipConfig(Config):
    """The robot's part in a team."""

    team: bool = parameter(
        False,
        'Work with the robots whose maps map_joiner has joined with that of this one. Set it for '
        'explorer, grid_mapper and navigator.',
    )
    team_name: str = parameter(
        '',
        'Name of the robot in its team, which decides ties: that of its map in join_status. '
        'Empty: the namespace.',
    )


def declare_membership(node: Node) -> MembershipConfig:
    """Declare team and team_name; the name is never empty."""
    config = parameters.declare_config(node, MembershipConfig)
    return MembershipConfig(config.team, config.team_name or node.get_namespace())


class JoinedPlaces:
    """Where the maps of the other robots lie in the map of this one, as map_joiner reports it.

    poses (3,): by the names of the robots that are joined with this one.
    """

    def __init__(self, node: ThinmapNode, name: str) -> None:
        """name: of this robot."""
        self.poses: dict[str, Array] = {}
        self._name = name
        subscribe_guarded(node, JoinStatus, '/join_status', self._on_status, qos.LATCHED)

    def _on_status(self, message: JoinStatus) -> None:
        world = {
            each.name: messages.pose_from_msg(each.pose) for each in message.maps if each.is_joined
        }
        own = world.pop(self._name, None)
        if own is None:
            self.poses = {}
            return
        self.poses = {name: se2.between(own, T) for name, T in world.items()}
