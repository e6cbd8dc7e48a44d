"""The map as others read it, and the exact grid for thinmap's own nodes."""

from dataclasses import dataclass

from nav_msgs.msg import MapMetaData, OccupancyGrid
from rclpy.node import Node

from thinmap_msgs.msg import ProbabilityGrid
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError
from thinmap_ros.core.grid.correctable import CorrectableGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.decoding.map_identity import FollowedMap

TRINARY = 'trinary'
PROBABILITY = 'probability'


@dataclass(frozen=True)
class MapOutputConfig(Config):
    """How the topic map is published."""

    map_values: str = parameter(
        TRINARY,
        'Values of map. trinary: -1 unknown, 0 free, 100 occupied, as slam_toolbox and map_server '
        'publish them. probability: -1 or the probability of occupancy (%).',
        choices=(TRINARY, PROBABILITY),
    )
    occupied_thresh: float = parameter(
        0.65,
        'Probability from which a cell of a trinary map is occupied. Raise it against walls that '
        'people leave behind, lower it for thin obstacles.',
        low=0.0,
        high=1.0,
    )
    free_thresh: float = parameter(
        0.25,
        'Probability up to which a cell of a trinary map is free. Lower it to show only cells as '
        'free that many beams have crossed.',
        low=0.0,
        high=1.0,
    )
    map_update_interval: float = parameter(
        1.0,
        'Time between two messages of map (s). Raise it to save CPU and network traffic with '
        'large maps.',
        low=0.05,
        high=3600.0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.free_thresh < self.occupied_thresh:
            expected = f'expected less than occupied_thresh ({self.occupied_thresh})'
            raise ConfigError(f'free_thresh = {self.free_thresh}: {expected}')

    def shown(self, patch: GridPatch) -> GridPatch:
        """The patch with the values to publish."""
        return patch if self.map_values == PROBABILITY else self.trinary(patch)

    def trinary(self, patch: GridPatch) -> GridPatch:
        """The patch with -1, 0 and 100, in whole percent as map_saver compares them."""
        limits = (round(100.0 * self.free_thresh), round(100.0 * self.occupied_thresh))
        return GridPatch(patch.frame, patch.trinary(*limits))


class MapPublishers:
    """Publishes the map for others, and the exact grid for thinmap's own nodes.

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

    def publish_map(self, grid: CorrectableGrid, stamp_ns: int) -> None:
        """Publish all of the map."""
        patch = grid.shown.known_area()
        message = self.map_message(patch, stamp_ns)
        self._map.publish(message)
        self._metadata.publish(message.info)
        exact = messages.probability_grid_msg(
            patch, self._frame, stamp_ns, self.load_ns, grid.corrected_ns, self.followed.id
        )
        self._grid.publish(exact)

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
