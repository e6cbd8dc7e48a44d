"""The maps of all robots on the graph: found by the names of their topics, as map_merge does."""

from collections.abc import Callable
from functools import partial

import numpy as np

from thinmap_msgs.msg import Keyframe as KeyframeMsg
from thinmap_msgs.msg import KeyframePoses
from thinmap_msgs.msg import TopologicalMap as TopologicalMapMsg
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.slam.joining.messages import KeyframeMessage, checked_poses
from thinmap_ros.core.slam.joining.pieces import ReceivedKeyframes, RobotKeyframes
from thinmap_ros.core.slam.joining.team import RobotMap
from thinmap_ros.core.topology.graph import TopologicalMap, topology_from_msg
from thinmap_ros.nodes.joining.settings import MapJoinerConfig
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.maps import UNKNOWN, subscribe_to_map
from thinmap_ros.ros.subscription import subscribe_guarded

_TYPE = 'nav_msgs/msg/OccupancyGrid'


class RobotMaps:
    """Subscribes to map, topology and keyframes of each robot, by its namespace.

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
        graph = f'{prefix}/topology'
        subscribe_guarded(
            node, TopologicalMapMsg, graph, partial(self._on_topology, name), qos.LATCHED
        )
        subscribe_guarded(
            node, KeyframeMsg, f'{prefix}/keyframes', partial(_take, received), qos.KEYFRAMES
        )
        poses = f'{prefix}/keyframe_poses'
        subscribe_guarded(node, KeyframePoses, poses, partial(_correct, received), qos.LATCHED)
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
