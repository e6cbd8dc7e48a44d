"""Tiles of the maps of other robots, in the map of this one."""

from thinmap_msgs.msg import MapTiles, TileRequest
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import JoinedMaps
from thinmap_ros.core.se2 import Array
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import WARN_PERIOD_S, subscribe_guarded
from thinmap_ros.ros.team.membership import JoinedPlaces
from thinmap_ros.ros.team.team_messages import request_msg, tiles_from_msg

TILES = '/team/tiles'
REQUESTS = '/team/tile_requests'


class TileReceiver:
    """Receives the tiles of the other robots, and asks for those that were missed."""

    def __init__(self, node: ThinmapNode, places: JoinedPlaces, name: str) -> None:
        """name: of this robot."""
        self._node = node
        self._places = places
        self._name = name
        self._maps = JoinedMaps()
        self._requests = node.create_publisher(TileRequest, REQUESTS, qos.STREAM)
        subscribe_guarded(node, MapTiles, TILES, self._on_tiles, qos.TILES)

    def completed(self, own: GridPatch) -> GridPatch:
        """The map of this robot, and what others know where it is undecided.

        The map itself where it would be too large, with a warning.
        """
        self._maps.place(self._places.poses)
        try:
            return self._maps.completed(own)
        except InputError as error:
            self._node.get_logger().warning(
                f'maps of other robots are not used: {error}', throttle_duration_sec=WARN_PERIOD_S
            )
            return own

    def take_changes(self) -> list[Array]:
        """Parts (2, 2), m, of the map that others have changed since the last call."""
        return self._maps.take_changes()

    def take_moved(self) -> bool:
        """Whether all of the completed map may have changed since the last call."""
        is_moved = self._maps.is_moved
        self._maps.is_moved = False
        return is_moved

    def _on_tiles(self, message: MapTiles) -> None:
        if message.robot == self._name:
            return
        tiles = tiles_from_msg(message)
        after = self._maps.add(message.robot, message.session, tiles)
        if after is not None:
            header = messages.header('', int(self._node.get_clock().now().nanoseconds))
            self._requests.publish(request_msg(header, message.robot, message.session, after))
