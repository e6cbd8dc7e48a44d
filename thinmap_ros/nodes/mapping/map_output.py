"""The map as others read it, and the exact grid for thinmap's own nodes."""

from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node

from thinmap_msgs.msg import LocalGrid, ProbabilityGrid
from thinmap_ros.core.grid.mapper import MapUpdate, WholeMap
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.nodes.mapping.map_topic import MapTopic
from thinmap_ros.nodes.mapping.map_values import MapIdentity, MapOutputConfig, MapVersion
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.localized_scan import ReceivedScan
from thinmap_ros.ros.maps import FollowedMap


class MapPublishers:
    """Publishes the map for others, and the exact grid for thinmap's own nodes, when they change.

    frame_id: of the map; load_ns: time at which it was begun or loaded; followed: knows its id.
    """

    def __init__(self, node: Node, config: MapOutputConfig) -> None:
        self.config = config
        self.frame_id = parameters.declare_map_frame(node)
        self.load_ns = 0
        self.followed = FollowedMap()
        self._map = MapTopic(node, self.frame_id)
        self._grid = node.create_publisher(ProbabilityGrid, 'grid', qos.LATCHED)
        self._local_grid = node.create_publisher(LocalGrid, 'local_grid', qos.LATCHED)
        self._published: MapVersion | None = None

    def publish_map(self, whole: WholeMap, stamp_ns: int) -> None:
        """Publish what of map and grid has changed since the last call."""
        identity = MapIdentity(self.load_ns, whole.corrected_ns, self.followed.id, self.config)
        version = MapVersion(identity, whole.patch, stamp_ns)
        changed = version.changes_since(self._published)
        self._published = version
        if changed is not None:
            self._grid.publish(
                messages.whole_map_msg(
                    whole, self.frame_id, stamp_ns, self.load_ns, self.followed.id
                )
            )
        self._map.publish(version, changed)

    def map_message(self, patch: GridPatch, stamp_ns: int) -> OccupancyGrid:
        """Message of the topic map."""
        shown = self.config.shown(patch)
        return messages.grid_msg(shown, self.frame_id, stamp_ns, self.load_ns)

    def publish_local_grid(self, update: MapUpdate, localized: ReceivedScan) -> None:
        """Publish the part of a grid that a scan has changed, and the scan."""
        if update.changes is None:
            return
        cells = messages.probability_grid_msg(
            update.changes,
            self.frame_id,
            localized.scan.stamp_ns,
            self.load_ns,
            update.corrected_ns,
            self.followed.id,
        )
        self._local_grid.publish(
            LocalGrid(
                header=cells.header,
                localized=localized.message,
                grid=cells,
                is_rerendering=update.is_rerendering,
            )
        )
