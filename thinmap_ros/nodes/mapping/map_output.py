"""The map as others read it, and the exact grid for thinmap's own nodes."""

from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node

from thinmap_msgs.msg import LocalGrid, ProbabilityGrid
from thinmap_ros.core.grid.correctable import CorrectableGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.nodes.mapping.map_topic import MapTopic
from thinmap_ros.nodes.mapping.map_values import MapOutputConfig
from thinmap_ros.nodes.mapping.map_version import MapIdentity, MapVersion
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.decoding.map_identity import FollowedMap
from thinmap_ros.ros.localized_scan import LocalizedScan


class MapPublishers:
    """Publishes the map for others, and the exact grid for thinmap's own nodes, when they change.

    load_ns: time at which the map was begun or loaded; followed: knows its id.
    """

    def __init__(self, node: Node, config: MapOutputConfig) -> None:
        self.config = config
        self._frame = parameters.declare_map_frame(node)
        self.load_ns = 0
        self.followed = FollowedMap()
        self._map = MapTopic(node, self._frame)
        self._grid = node.create_publisher(ProbabilityGrid, 'grid', qos.LATCHED)
        self._local_grid = node.create_publisher(LocalGrid, 'local_grid', qos.LATCHED)
        self._published: MapVersion | None = None

    def publish_map(self, grid: CorrectableGrid, stamp_ns: int) -> None:
        """Publish what of map and grid has changed since the last call."""
        identity = MapIdentity(self.load_ns, grid.corrected_ns, self.followed.id, self.config)
        version = MapVersion(identity, grid.shown.known_area(), stamp_ns)
        changed = version.changes_since(self._published)
        self._published = version
        if changed is not None:
            self._grid.publish(self._grid_message(version.patch, stamp_ns, grid.corrected_ns))
        self._map.publish(version, changed)

    def map_message(self, patch: GridPatch, stamp_ns: int) -> OccupancyGrid:
        """Message of the topic map."""
        shown = self.config.shown(patch)
        return messages.grid_msg(shown, self._frame, stamp_ns, self.load_ns)

    def publish_local_grid(
        self, window: GridPatch, grid: CorrectableGrid, localized: LocalizedScan
    ) -> None:
        """Publish the part of a grid that a scan has changed, and the scan."""
        cells = self._grid_message(window, localized.scan.stamp_ns, grid.corrected_ns)
        self._local_grid.publish(
            LocalGrid(
                header=cells.header,
                localized=localized.message,
                grid=cells,
                is_rerendering=grid.is_rerendering,
            )
        )

    def _grid_message(self, patch: GridPatch, stamp_ns: int, corrected_ns: int) -> ProbabilityGrid:
        return messages.probability_grid_msg(
            patch, self._frame, stamp_ns, self.load_ns, corrected_ns, self.followed.id
        )
