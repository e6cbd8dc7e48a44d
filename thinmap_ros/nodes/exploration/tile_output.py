"""The tiles of a robot's own map, for the other robots of its team."""

from thinmap_msgs.msg import MapTiles, TileRequest
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import TileSender
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.maps import new_map_id
from thinmap_ros.ros.subscription import subscribe_guarded
from thinmap_ros.ros.team import REQUESTS, TILES, tiles_msg


class TileOutput:
    """Publishes the tiles that have changed since the last message, or since what is asked for."""

    def __init__(self, node: ThinmapNode, name: str, frame_id: str) -> None:
        """name: of the robot; frame_id: of its map."""
        self._node = node
        self._name = name
        self._frame_id = frame_id
        self._publisher = node.create_publisher(MapTiles, TILES, qos.LATCHED)
        self.reset()
        subscribe_guarded(node, TileRequest, REQUESTS, self._on_request, qos.STREAM)

    def reset(self) -> None:
        """Begin again with another map."""
        self._session = new_map_id()
        self._sender: TileSender | None = None
        self._next_after = 0

    def send(self, patch: GridPatch) -> None:
        """Publish what has changed in the map, if anything has."""
        sender = self._sender_of(patch)
        sender.update(patch)
        if sender.version == self._next_after:
            return
        tiles = sender.changes_after(self._next_after)
        header = messages.header(self._frame_id, int(self._node.get_clock().now().nanoseconds))
        self._publisher.publish(tiles_msg(header, self._name, self._session, tiles))
        self._next_after = sender.version

    def _sender_of(self, patch: GridPatch) -> TileSender:
        """The sender of the lattice of a map: another lattice is another map."""
        sender = self._sender
        if sender is not None:
            if GridPatch(sender.frame, patch.cells[:0, :0]).is_aligned_with(patch):
                return sender
            self.reset()
        self._sender = TileSender(patch.frame)
        return self._sender

    def _on_request(self, message: TileRequest) -> None:
        if message.robot == self._name and message.session == self._session:
            self._next_after = min(self._next_after, message.after)
