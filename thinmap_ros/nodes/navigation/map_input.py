"""The map that the navigator plans on: thinmap's grid, or the map of another node."""

from thinmap_msgs.msg import LocalGrid, ProbabilityGrid
from thinmap_ros.core.grid.keep_out import KeepOut
from thinmap_ros.core.grid.map_receiver import MapReceiver
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.decoding.map_identity import UNKNOWN
from thinmap_ros.ros.decoding.map_updates import subscribe_to_map
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.localized_scan import map_update_from_msg
from thinmap_ros.ros.subscription import subscribe_guarded


class MapInput:
    """The newest map: grid and local_grid of grid_mapper, or else map, of whatever SLAM.

    pose_map_id: id of the map that the pose of the robot is in; keep_out: where it must not drive.
    """

    def __init__(self) -> None:
        self.keep_out = KeepOut()
        self.reset()

    @property
    def patch(self) -> GridPatch | None:
        """The map, or None before one is received."""
        return self._map.patch

    def subscribe(self, node: ThinmapNode) -> None:
        """Start to receive maps."""
        subscribe_guarded(node, ProbabilityGrid, 'grid', self._on_grid, qos.LATCHED)
        subscribe_guarded(node, LocalGrid, 'local_grid', self._on_local_grid, qos.LATCHED)
        subscribe_to_map(node, 'map', self._on_map)

    def reset(self) -> None:
        """Discard the map, and not the keep-out areas: they are published where they change."""
        self._map = MapReceiver()
        self._has_grid = False
        self._map_id = UNKNOWN
        self.pose_map_id = UNKNOWN

    @property
    def fault(self) -> str:
        """Why the robot must not drive on this map; '' for no reason."""
        if UNKNOWN in (self._map_id, self.pose_map_id) or self._map_id == self.pose_map_id:
            return ''
        return 'the pose is in another map than the one on grid (was the localizer restarted?)'

    def _on_grid(self, message: ProbabilityGrid) -> None:
        self._has_grid = True
        self._map_id = message.map_id
        self._map.replace(messages.grid_from_msg(message))

    def _on_local_grid(self, message: LocalGrid) -> None:
        window = map_update_from_msg(message).changes
        map_id = message.grid.map_id
        if UNKNOWN not in (map_id, self._map_id) and map_id != self._map_id:
            self._map = MapReceiver()
        self._map_id = map_id
        if window is not None:
            self._map.paste(window)

    def _on_map(self, patch: GridPatch) -> None:
        if not self._has_grid:
            self._map.replace(patch)
