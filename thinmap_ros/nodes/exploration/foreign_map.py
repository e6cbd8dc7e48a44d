"""The map of any publisher: a SLAM, a map server or a costmap."""

from collections.abc import Callable
from dataclasses import replace

from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.grid.patch import GridPatch, occupancy_from_costs
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.logs import decode
from thinmap_ros.nodes.parts.mission import ExplorationSettings
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.maps import updates_topic
from thinmap_ros.ros.subscription import subscribe_guarded


class ForeignMap:
    """Newest map of a topic, with its updates.

    is_changed: whether it has changed since somebody set this to False.
    """

    def __init__(
        self,
        node: ThinmapNode,
        settings: ExplorationSettings,
        map_frame: str,
        is_used: Callable[[], bool],
    ) -> None:
        """is_used: whether this map is needed; else its messages are only kept."""
        self.is_changed = False
        self._settings = settings
        self._map_frame = map_frame
        self._is_used = is_used
        self._unread: OccupancyGrid | None = None
        self._map = MapReceiver()
        updates = settings.costmap_updates_topic or updates_topic(node, self.topic)
        subscribe_guarded(node, OccupancyGrid, self.topic, self._on_map, qos.LATCHED)
        subscribe_guarded(node, OccupancyGridUpdate, updates, self._on_update, qos.STREAM)

    @property
    def topic(self) -> str:
        """Name of the topic."""
        return self._settings.costmap_topic

    def reset(self) -> None:
        """Discard the map."""
        self._unread = None
        self._map = MapReceiver()
        self.is_changed = False

    def patch(self) -> GridPatch | None:
        """The map as occupancy; None before the first. Raises InputError where it is invalid."""
        self._read_kept()
        patch = self._map.patch
        if patch is None:
            return None
        patch = occupancy_from_costs(patch) if self._settings.is_costmap else patch
        return replace(patch, is_replaced=True)

    def _on_map(self, message: OccupancyGrid) -> None:
        self._unread = message
        if self._is_used():
            self._read_kept()
        self.is_changed = True

    def _on_update(self, message: OccupancyGridUpdate) -> None:
        self._read_kept()
        self._check_frame(message.header.frame_id)
        # Stamps of costmaps and of their updates are times of different clocks, or 0.
        if self._map.update(0, *decode.map_update(message)):
            self.is_changed = True

    def _read_kept(self) -> None:
        message = self._unread
        self._unread = None
        if message is not None:
            self._check_frame(message.header.frame_id)
            self._map.replace(messages.grid_from_msg(message))

    def _check_frame(self, frame_id: str) -> None:
        if frame_id.lstrip('/') not in ('', self._map_frame):
            raise InputError(
                f'map in frame {quoted(frame_id)}: expected that of the parameter map_frame, '
                f'{quoted(self._map_frame)}'
            )
