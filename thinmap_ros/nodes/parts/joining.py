"""Parts of the map joiner: maps of robots in, the joint map out, in turns of work."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from geometry_msgs.msg import Pose
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from thinmap_msgs.msg import JoinStatus, KeyframePoses, RegionArray
from thinmap_msgs.msg import Keyframe as KeyframeMsg
from thinmap_msgs.msg import RobotMap as RobotMapMsg
from thinmap_msgs.msg import TopologicalMap as TopologicalMapMsg
from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.places.place_odds import JOIN_ODDS
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.joining.messages import KeyframeMessage, checked_poses
from thinmap_ros.core.slam.joining.pieces import ReceivedKeyframes, RobotKeyframes
from thinmap_ros.core.slam.joining.team import Bend, RobotMap, Team, TeamGraph, TeamMap, merged
from thinmap_ros.core.stage import MAX_ODDS
from thinmap_ros.core.topology.graph import TopologicalMap, topology_from_msg
from thinmap_ros.core.topology.regions import RegionMap, membership_of
from thinmap_ros.core.topology.segmentation import RegionTracker
from thinmap_ros.nodes.parts.topology import region_array_msg
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.maps import UNKNOWN, subscribe_to_map
from thinmap_ros.ros.private_rclpy import given_parameters
from thinmap_ros.ros.subscription import subscribe_all


@dataclass(frozen=True, eq=False)
class Merge:
    """A joint map, and how the maps of the robots bend in it."""

    merged: TeamMap
    regions: RegionMap
    bend: Bend


class JointMap:
    """Merges maps again and again; ids of nodes and regions stay."""

    def __init__(self) -> None:
        self.bend = Bend()
        self._merged: TeamMap | None = None
        self._graph = TeamGraph()
        self._regions = RegionTracker()

    def merge(self, maps: Mapping[str, RobotMap], places: Mapping[str, Array]) -> Merge:
        """Merge maps at their places (3,) in the world, bent where their keyframes are known."""
        known = {name: robot.keyframes for name, robot in maps.items() if robot.keyframes}
        bend = self._graph.bend(known, places)
        joint = merged(maps, places, self._merged, bend.poses)
        return Merge(joint, self._regions.update(joint.patch), bend)

    def take(self, merge: Merge) -> None:
        """Continue from a joint map, which is published."""
        self.bend = merge.bend
        self._merged = merge.merged

    def begin_ids_again(self) -> None:
        """Forget the ids of nodes: a map was separated."""
        self._merged = None


# As map_merge names them: /robot1/map_merge/init_pose_x.
_INITIAL_POSE = re.compile(r'(/\S*)/map_merge/init_pose_(x|y|z|yaw)')
_CONFIDENCE = 'estimation_confidence'


@dataclass(frozen=True)
class MapJoinerConfig(Config):
    """Which maps are joined, when, and under which names the joint map is published.

    Names are as in m-explore's map_merge where it has them.
    """

    robot_map_topic: str = parameter(
        'map', 'Name of the maps of the robots (nav_msgs/OccupancyGrid), without their namespaces.'
    )
    robot_map_updates_topic: str = parameter(
        '',
        'Name of the updates of these maps (map_msgs/OccupancyGridUpdate). Empty: robot_map_topic '
        'with _updates.',
    )
    robot_namespace: str = parameter(
        '', 'Join only maps with this in the name of their topic. Empty: all maps.'
    )
    merged_map_topic: str = parameter('merged_map', 'Name of the joint map that is published.')
    world_frame: str = parameter('world', 'Frame of the joint map.')
    known_init_poses: bool = parameter(
        False,
        'Begin with the poses of /ROBOT/map_merge/init_pose_x, _y and _yaw, which scans refine. '
        'false: the place of each map is searched for.',
    )
    merging_rate: float = parameter(
        1.0,
        'Greatest rate of the joint map (Hz). Lower it to save CPU with many large maps.',
        low=0.001,
        high=100.0,
    )
    discovery_rate: float = parameter(
        0.5, 'Rate at which new robots are looked for (Hz).', low=0.001, high=100.0
    )
    estimation_rate: float = parameter(
        0.5,
        'Greatest rate of searches for the place of a map in another one (Hz). Lower it to save '
        'CPU; maps are then joined later.',
        low=0.001,
        high=100.0,
    )
    join_odds: float = parameter(
        JOIN_ODDS,
        'Odds of its place with which a map is joined. Raise it where parts of the building look '
        'alike; joins then come later.',
        low=10.0,
        high=1e12,
    )


def declare_initial_poses(node: Node) -> dict[str, Array]:
    """Declare the initial poses that the node was given, by the namespace of the robot, (3,)."""
    found = [_INITIAL_POSE.fullmatch(name) for name in given_parameters(node)]
    poses: dict[str, dict[str, float]] = {}
    for match in found:
        if match is not None:
            value = parameters.declare_parameter(
                node, match[0], 0.0, 'Initial pose of the robot in the world (m, rad).'
            )
            poses.setdefault(match[1], {})[match[2]] = float(value)
    return {
        name: se2.pose(*(given.get(axis, 0.0) for axis in ('x', 'y', 'yaw')))
        for name, given in poses.items()
    }


def warn_of_confidence(node: Node) -> None:
    """Name the parameter that takes the place of map_merge's confidence."""
    if given_parameters(node).pop(_CONFIDENCE, None) is not None:
        node.get_logger().warning(
            f'{_CONFIDENCE} is not used: join_odds decides which maps are joined (default '
            f'{JOIN_ODDS:g}, at most one wrong join in so many)'
        )


def odds_text(log_odds: float) -> str:
    """Odds as people say them."""
    if math.isinf(log_odds):
        return 'given' if log_odds > 0.0 else 'none'
    return f'log odds {log_odds:.1f}'


_TYPE = 'nav_msgs/msg/OccupancyGrid'


class RobotMaps:
    """Subscribes to map, topology and keyframes of each robot, by its namespace.

    They are found by the names of topics on the graph, as map_merge does.

    patches, graphs: the newest ones; a robot without topological map has no graph.
    """

    def __init__(
        self,
        node: ThinmapNode,
        config: MapJoinerConfig,
        changed: Callable[[str], None],
        replaced: Callable[[str], None],
    ) -> None:
        """Functions that are called with the namespace of a robot.

        changed: its map has changed; replaced: it has begun another map.
        """
        self.patches: dict[str, GridPatch] = {}
        self.graphs: dict[str, TopologicalMap] = {}
        self.names: set[str] = set()
        self._node = node
        self._config = config
        self._changed = changed
        self._replaced = replaced
        self._map_ids: dict[str, int] = {}
        self._keyframes: dict[str, ReceivedKeyframes] = {}
        self._own = node.resolve_topic_name(config.merged_map_topic)

    def map_of(self, name: str) -> RobotMap:
        """The newest map of a robot."""
        return RobotMap(self.patches[name], self.graphs.get(name), self._keyframes_of(name))

    def _keyframes_of(self, name: str) -> RobotKeyframes | None:
        """The keyframes of the map of a robot; None where it sends none, or those of another."""
        received = self._keyframes[name]
        is_of_map = received.map_id == self._map_ids.get(name, UNKNOWN)
        return received.known() if is_of_map else None

    def discover(self) -> None:
        """Subscribe to the maps of robots that have come."""
        config = self._config
        ending = f'/{config.robot_map_topic.strip("/")}'
        for topic, types in self._node.get_topic_names_and_types():
            is_map = topic.endswith(ending) and config.robot_namespace in topic
            name = topic.removesuffix(ending) or '/'
            if is_map and _TYPE in types and topic != self._own and name not in self.names:
                self.names.add(name)
                self._subscribe(name, topic)

    def _subscribe(self, name: str, topic: str) -> None:
        prefix = name.rstrip('/')
        updates = self._config.robot_map_updates_topic
        updates = f'{prefix}/{updates.strip("/")}' if updates else ''
        node = self._node
        received = self._keyframes[name] = ReceivedKeyframes()
        subscribe_to_map(node, topic, partial(self._on_map, name), updates)
        on_topology = partial(self._on_topology, name)
        subscribe_all(
            node,
            (TopologicalMapMsg, f'{prefix}/topology', on_topology, qos.LATCHED),
            (KeyframeMsg, f'{prefix}/keyframes', partial(_take, received), qos.KEYFRAMES),
            (KeyframePoses, f'{prefix}/keyframe_poses', partial(_correct, received), qos.LATCHED),
        )
        node.get_logger().info(f'{name}: a robot with the map {topic}')

    def _on_map(self, name: str, patch: GridPatch) -> None:
        self.patches[name] = patch
        self._changed(name)

    def _on_topology(self, name: str, message: TopologicalMapMsg) -> None:
        self.graphs[name] = topology_from_msg(message)
        before = self._map_ids.get(name, UNKNOWN)
        self._map_ids[name] = message.map_id
        if UNKNOWN not in (before, message.map_id) and before != message.map_id:
            self._replaced(name)


def _take(received: ReceivedKeyframes, message: KeyframeMsg) -> None:
    messages.require_layout(message)
    decoded = KeyframeMessage.decode(bytes(message.data))
    received.add(message.session, message.map_id, decoded)


def _correct(received: ReceivedKeyframes, message: KeyframePoses) -> None:
    poses = checked_poses(np.asarray(message.poses, dtype=np.float64))
    received.correct(message.session, message.revision, poses)


class TeamPublishers:
    """Topics merged_map, merged_topology, merged_regions and join_status, and transforms."""

    def __init__(self, node: ThinmapNode, map_topic: str, world_frame: str) -> None:
        """map_topic: name of the joint map."""
        self._node = node
        self._frame = world_frame
        self._map = node.create_publisher(OccupancyGrid, map_topic, qos.LATCHED)
        self._graph = node.create_publisher(TopologicalMapMsg, 'merged_topology', qos.LATCHED)
        self._regions = node.create_publisher(RegionArray, 'merged_regions', qos.LATCHED)
        self._status = node.create_publisher(JoinStatus, 'join_status', qos.LATCHED)
        self._transforms = node.create_publisher(TFMessage, '/tf_static', qos.STATIC_TRANSFORMS)

    def publish_map(self, merged: TeamMap, regions: RegionMap) -> None:
        """Publish the joint map, its graph and its regions."""
        now_ns = self._node.now_ns
        frame = self._frame
        membership = membership_of(merged.graph, regions)
        self._map.publish(messages.grid_msg(merged.patch, frame, now_ns))
        self._graph.publish(messages.topology_msg(merged.graph, frame, now_ns))
        self._regions.publish(region_array_msg(membership, frame, now_ns))

    def publish_places(self, team: Team, places: dict[str, Array]) -> None:
        """Publish where the maps lie: status and transforms to their frames, NAMESPACE/map."""
        now_ns = self._node.now_ns
        header = messages.header(self._frame, now_ns)
        maps = [_robot_map(team, name, places.get(name)) for name in sorted(team.maps)]
        self._status.publish(JoinStatus(header=header, maps=maps))
        transforms = [
            messages.transform_msg(T, self._frame, f'{name}/map'.lstrip('/'), now_ns)
            for name, T in places.items()
        ]
        if transforms:
            self._transforms.publish(TFMessage(transforms=transforms))


def _robot_map(team: Team, name: str, place: Array | None) -> RobotMapMsg:
    """The state of a map; its link, or the pair that comes nearest to one."""
    linked = [(link.matches, link.log_odds, link.b) for link in team.links_of(name)]
    tried = [
        (0, log_odds, other)
        for pair, log_odds in team.log_odds.items()
        if name in pair
        for other in pair - {name}
    ]
    matches, log_odds, other = max(linked or tried, default=(0, -math.inf, ''))
    return RobotMapMsg(
        name=name,
        is_joined=place is not None,
        pose=Pose() if place is None else messages.pose_msg(place),
        other=other,
        join_odds=math.exp(min(log_odds, math.log(MAX_ODDS))),
        matches=matches,
    )


class Turns:
    """Kinds of work that take turns: none waits for ever because another one is always ready."""

    def __init__(self) -> None:
        self._last = ''

    def take(self, ready: Sequence[str]) -> str:
        """One of the kinds that are ready, the first that was not the last; '' without any."""
        others = [kind for kind in ready if kind != self._last]
        self._last = next(iter(others or ready), '')
        return self._last
