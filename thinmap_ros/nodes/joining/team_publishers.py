"""What map_joiner publishes: the joint map, its graph and regions, and where each map lies."""

import math

from geometry_msgs.msg import Pose
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from thinmap_msgs.msg import JoinStatus, RegionArray, RobotMap, TopologicalMap
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.joining.team import Team, TeamMap
from thinmap_ros.core.stage import MAX_ODDS
from thinmap_ros.core.topology.regions import RegionMap, membership_of
from thinmap_ros.nodes.parts.topology import region_array_msg
from thinmap_ros.ros import messages, qos


class TeamPublishers:
    """Topics merged_map, merged_topology, merged_regions and join_status, and transforms."""

    def __init__(self, node: Node, map_topic: str, world_frame: str) -> None:
        """map_topic: name of the joint map."""
        self._node = node
        self._frame = world_frame
        self._map = node.create_publisher(OccupancyGrid, map_topic, qos.LATCHED)
        self._graph = node.create_publisher(TopologicalMap, 'merged_topology', qos.LATCHED)
        self._regions = node.create_publisher(RegionArray, 'merged_regions', qos.LATCHED)
        self._status = node.create_publisher(JoinStatus, 'join_status', qos.LATCHED)
        self._transforms = node.create_publisher(TFMessage, '/tf_static', qos.STATIC_TRANSFORMS)

    def publish_map(self, merged: TeamMap, regions: RegionMap) -> None:
        """Publish the joint map, its graph and its regions."""
        now_ns = self._now_ns
        frame = self._frame
        membership = membership_of(merged.graph, regions)
        self._map.publish(messages.grid_msg(merged.patch, frame, now_ns))
        self._graph.publish(messages.topology_msg(merged.graph, frame, now_ns))
        self._regions.publish(region_array_msg(membership, frame, now_ns))

    def publish_places(self, team: Team, places: dict[str, Array]) -> None:
        """Publish where the maps lie: status and transforms to their frames, NAMESPACE/map."""
        now_ns = self._now_ns
        header = messages.header(self._frame, now_ns)
        maps = [_robot_map(team, name, places.get(name)) for name in sorted(team.maps)]
        self._status.publish(JoinStatus(header=header, maps=maps))
        transforms = [
            messages.transform_msg(T, self._frame, map_frame_of(name), now_ns)
            for name, T in places.items()
        ]
        if transforms:
            self._transforms.publish(TFMessage(transforms=transforms))

    @property
    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)


def map_frame_of(name: str) -> str:
    """Frame of the map of a robot, by its namespace, for all robots in one tree."""
    return f'{name}/map'.lstrip('/')


def _robot_map(team: Team, name: str, place: Array | None) -> RobotMap:
    """The state of a map; its link, or the pair that comes nearest to one."""
    linked = [(link.matches, link.log_odds, link.b) for link in team.links_of(name)]
    tried = [
        (0, log_odds, other)
        for pair, log_odds in team.log_odds.items()
        if name in pair
        for other in pair - {name}
    ]
    matches, log_odds, other = max(linked or tried, default=(0, -math.inf, ''))
    return RobotMap(
        name=name,
        is_joined=place is not None,
        pose=Pose() if place is None else messages.pose_msg(place),
        other=other,
        join_odds=math.exp(min(log_odds, math.log(MAX_ODDS))),
        matches=matches,
    )
