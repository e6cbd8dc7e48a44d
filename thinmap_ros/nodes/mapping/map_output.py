"""The map as others read it, and the exact grid for thinmap's own nodes."""

from dataclasses import dataclass

from nav_msgs.msg import MapMetaData, OccupancyGrid
from rclpy.node import Node

from thinmap_msgs.msg import ProbabilityGrid
from thinmap_ros.core.grid.correctable import CorrectableGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.nodes.mapping.map_values import MapOutputConfig
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.decoding.map_identity import FollowedMap


@dataclass(frozen=True)
class _Identity:
    """Which map it is, and how it is shown; load_ns, corrected_ns, map_id: as in the messages."""

    load_ns: int
    corrected_ns: int
    map_id: int
    config: MapOutputConfig


@dataclass(frozen=True, eq=False)
class _Version:
    """The map at a stamp: cells in percent."""

    identity: _Identity
    patch: GridPatch
    stamp_ns: int

    def continues(self, before: '_Version | None') -> bool:
        """Whether it is the same map as before, with the same rectangle of cells."""
        return (
            before is not None
            and self.identity == before.identity
            and self.patch.frame == before.patch.frame
            and self.patch.shape == before.patch.shape
        )


class MapPublishers:
    """Publishes the map for others, and the exact grid for thinmap's own nodes, when they change.

    load_ns: time at which the map was begun or loaded; followed: knows its id.
    """

    def __init__(self, node: Node, config: MapOutputConfig) -> None:
        self.config = config
        self._frame = parameters.declare_map_frame(node)
        self.load_ns = 0
        self.followed = FollowedMap()
        self._map = node.create_publisher(OccupancyGrid, 'map', qos.LATCHED)
        self._metadata = node.create_publisher(MapMetaData, 'map_metadata', qos.LATCHED)
        self._grid = node.create_publisher(ProbabilityGrid, 'grid', qos.LATCHED)
        self._local_grid = node.create_publisher(ProbabilityGrid, 'local_grid', qos.LATCHED)
        self._published: _Version | None = None

    def publish_map(self, grid: CorrectableGrid, stamp_ns: int) -> None:
        """Publish all of the map and of the grid, each if it has changed since the last call."""
        identity = _Identity(self.load_ns, grid.corrected_ns, self.followed.id, self.config)
        version = _Version(identity, grid.shown.known_area(), stamp_ns)
        before = self._published
        self._published = version
        if before is None or not version.continues(before):
            self._publish_map(version)
            self._publish_grid(version)
            return
        changed = version.patch.changes_since(before.patch)
        if changed is None:
            return
        self._publish_grid(version)
        shown = [self.config.shown(each.patch.part(changed)) for each in (before, version)]
        if shown[1].changes_since(shown[0]) is not None:
            self._publish_map(version)

    def map_message(self, patch: GridPatch, stamp_ns: int) -> OccupancyGrid:
        """Message of the topic map."""
        shown = self.config.shown(patch)
        return messages.grid_msg(shown, self._frame, stamp_ns, self.load_ns)

    def publish_local_grid(self, window: GridPatch, stamp_ns: int, corrected_ns: int) -> None:
        """Publish the part of the grid that a scan has changed."""
        message = messages.probability_grid_msg(
            window, self._frame, stamp_ns, self.load_ns, corrected_ns, self.followed.id
        )
        self._local_grid.publish(message)

    def _publish_map(self, version: _Version) -> None:
        message = self.map_message(version.patch, version.stamp_ns)
        self._map.publish(message)
        self._metadata.publish(message.info)

    def _publish_grid(self, version: _Version) -> None:
        identity = version.identity
        exact = messages.probability_grid_msg(
            version.patch,
            self._frame,
            version.stamp_ns,
            identity.load_ns,
            identity.corrected_ns,
            identity.map_id,
        )
        self._grid.publish(exact)
