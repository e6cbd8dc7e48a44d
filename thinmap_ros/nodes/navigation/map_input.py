"""The map that the navigator plans on: thinmap's grid, or the map of another node."""

from dataclasses import dataclass

from thinmap_msgs.msg import LocalGrid, ProbabilityGrid
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.grid.edits import KeepOut
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.core.sensing.synchronizer import InputStream
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.localized_scan import map_update_from_msg
from thinmap_ros.ros.maps import UNKNOWN, subscribe_to_map
from thinmap_ros.ros.subscription import subscribe_guarded
from thinmap_ros.ros.time_jumps import ElapsedTime

# grid_mapper answers each scan: several of the slowest laser that a robot drives by, at 2.5 Hz.
_WARN_S = 2.0


@dataclass(frozen=True)
class MapTimeoutConfig(Config):
    """How old the map of grid_mapper may be."""

    map_timeout_s: float = parameter(
        5.0,
        'Time without a message on local_grid after which the robot stands, until the next (s): '
        'grid_mapper has ended, or hangs. 0: it drives on with the last map. Raise it if a slow '
        'machine makes the robot stop. Maps of other nodes have no time-out.',
        low=0.0,
        high=1000.0,
    )


class MapInput:
    """The newest map: grid and local_grid of grid_mapper, or else map, of whatever SLAM.

    grid is published where it changes, local_grid for each scan: it shows that grid_mapper lives.

    pose_map_id: id of the map that the pose of the robot is in; keep_out: where it must not drive.
    """

    def __init__(self, time: ElapsedTime, timeout_s: float) -> None:
        """timeout_s: as `MapTimeoutConfig`."""
        self.keep_out = KeepOut()
        self._time = time
        self._timeout_s = timeout_s
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
        timeouts_s = [_WARN_S, self._timeout_s] if self._timeout_s > 0.0 else [_WARN_S]
        self._streams = [_mapper_stream(seconds) for seconds in timeouts_s]

    @property
    def warning(self) -> str:
        """Why the map is older than the pose; '' where it is not."""
        return self._streams[0].fault(self._time.now_ns())

    def has_two_mappers(self) -> bool:
        """Whether local_grid comes from two sources."""
        return self._streams[0].is_mixed(self._time.now_ns())

    @property
    def fault(self) -> str:
        """Why the robot must not drive on this map; '' for no reason."""
        if UNKNOWN in (self._map_id, self.pose_map_id) or self._map_id == self.pose_map_id:
            return self._streams[-1].fault(self._time.now_ns()) if self._timeout_s > 0.0 else ''
        return 'the pose is in another map than the one on grid (was the localizer restarted?)'

    def _on_grid(self, message: ProbabilityGrid) -> None:
        self._has_grid = True
        self._map_id = message.map_id
        self._map.replace(messages.grid_from_msg(message))

    def _on_local_grid(self, message: LocalGrid) -> None:
        window = map_update_from_msg(message).changes
        stamp_ns = messages.stamp_ns(message.header.stamp)
        for stream in self._streams:
            stream.add(stamp_ns, self._time.now_ns(), self._time.age_ns(stamp_ns))
        map_id = message.grid.map_id
        if UNKNOWN not in (map_id, self._map_id) and map_id != self._map_id:
            self._map = MapReceiver()
        self._map_id = map_id
        if window is not None:
            self._map.paste(window)

    def _on_map(self, patch: GridPatch) -> None:
        if not self._has_grid:
            self._map.replace(patch)


def _mapper_stream(timeout_s: float) -> InputStream:
    timeout_ns = round(timeout_s * SECOND_NS)
    return InputStream('grid_mapper', timeout_ns, timeout_ns)
