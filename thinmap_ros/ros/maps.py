"""Maps on topics: which map a message belongs to, and updates of a map."""

import time
from collections.abc import Callable
from enum import Enum

from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.logs import decode
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import subscribe_guarded

UNKNOWN = 0


def new_map_id() -> int:
    """An id that no other map has."""
    return time.time_ns()


class Origin(Enum):
    """Which map a message is of: the one that is followed, the previous one, or another."""

    SAME = 0
    STALE = 1
    OTHER = 2


class FollowedMap:
    """The id of the map that a node has, learned from messages.

    A localizer gives its map an id when it begins or loads one. The id 0 is that of a map whose
    localizer has none, such as another package's.
    """

    def __init__(self, map_id: int = UNKNOWN) -> None:
        self.id = map_id
        self._left = UNKNOWN

    def leave(self) -> None:
        """The node has loaded another map: its id is that of the next message."""
        self._left = self.id or self._left
        self.id = UNKNOWN

    def origin(self, map_id: int) -> Origin:
        """Origin of a message with an id; a node without a map follows the first that it hears."""
        if map_id in (UNKNOWN, self.id):
            return Origin.SAME
        if map_id == self._left:
            return Origin.STALE
        if self.id == UNKNOWN:
            self.id = map_id
            return Origin.SAME
        return Origin.OTHER


def updates_topic(node: Node, topic: str) -> str:
    """Full name of the topic with the updates of a map, as RViz and costmaps name it.

    It follows the topic of the map, also where that is remapped.
    """
    return f'{node.resolve_topic_name(topic)}_updates'


def subscribe_to_map(
    node: ThinmapNode, topic: str, process: Callable[[GridPatch], None], updates: str = ''
) -> None:
    """Subscribe to a map and to its updates; process: receives the map whenever it has changed.

    updates: topic of the updates; '': that of the map with _updates.
    """
    receiver = MapReceiver()

    def on_map(message: OccupancyGrid) -> None:
        process(received_map(receiver, message))

    def on_update(message: OccupancyGridUpdate) -> None:
        patch = received_update(receiver, message)
        if patch is not None:
            process(patch)

    subscribe_guarded(node, OccupancyGrid, topic, on_map, qos.LATCHED)
    name = updates or updates_topic(node, topic)
    subscribe_guarded(node, OccupancyGridUpdate, name, on_update, qos.STREAM)


def received_map(receiver: MapReceiver, message: OccupancyGrid) -> GridPatch:
    """The map after a whole one. Raises InputError as `messages.grid_from_msg`."""
    whole = messages.grid_from_msg(message)
    receiver.replace(whole, messages.stamp_ns(message.header.stamp))
    return receiver.patch or whole


def received_update(receiver: MapReceiver, message: OccupancyGridUpdate) -> GridPatch | None:
    """The map after an update; None where it has not changed.

    Raises InputError where the update is invalid or does not fit: the next whole map heals it.
    """
    is_new = receiver.update(messages.stamp_ns(message.header.stamp), *decode.map_update(message))
    return receiver.patch if is_new else None
