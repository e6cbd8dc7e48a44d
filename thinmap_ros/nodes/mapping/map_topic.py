"""The topic map: the whole map, and updates of what has changed in it."""

from collections import Counter

from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import MapMetaData, OccupancyGrid
from rclpy.event_handler import PublisherEventCallbacks, QoSPublisherMatchedInfo
from rclpy.node import Node

from thinmap_ros.core.grid.patch import GridPatch, Margins
from thinmap_ros.nodes.mapping.map_version import MapVersion
from thinmap_ros.ros import diagnostics, messages, qos
from thinmap_ros.ros.decoding.map_updates import updates_topic

# Calls after which a whole map follows an update, whoever subscribes: an update that was lost, for
# a reason that no publisher knows, is missing for so long.
_CALLS_BEHIND = 10
# Room of a map that grows, a share of its length: it grows again when the room is used up.
_ROOM = 0.25


class MapTopic:
    """Publishes map and map_metadata, or map_updates.

    The map is whole where its rectangle grows or it is another map, and as long as somebody
    subscribes to map and not to map_updates. Else map_updates has the rectangle that has changed;
    the whole map follows ten calls later, or once a subscriber comes.
    Where all subscribe to both, the rectangle has room to grow; else it ends at the known cells.
    """

    def __init__(self, node: Node, frame_id: str) -> None:
        events = PublisherEventCallbacks(matched=self._on_matched)
        self._node = node
        self._frame_id = frame_id
        self._map = node.create_publisher(OccupancyGrid, 'map', qos.LATCHED, event_callbacks=events)
        self._metadata = node.create_publisher(MapMetaData, 'map_metadata', qos.LATCHED)
        self._updates = node.create_publisher(
            OccupancyGridUpdate,
            updates_topic(node, 'map'),
            qos.STREAM,
            event_callbacks=events,
        )
        self._newest: MapVersion | None = None
        self._shown: GridPatch | None = None  # what those know who have all messages
        self._calls_behind = 0  # since the newest whole map is out of date

    def publish(self, version: MapVersion) -> None:
        """Publish what has changed since the last call."""
        before = self._newest
        self._newest = version
        shown = version.shown()
        if self._shown is None or before is None or not version.extends(before):
            self._publish_whole(version, shown)
        else:
            self._publish_changes(version, self._shown, shown)

    def _publish_changes(self, version: MapVersion, before: GridPatch, shown: GridPatch) -> None:
        needs_whole = self._has_subscriber_of_map_alone()
        margins = before.overhang_of(shown)
        if any(margins):
            wide = before.padded(_with_room(before, margins))
            self._publish_whole(version, shown if needs_whole else _pasted(wide, shown))
            return
        newest = _pasted(before, shown)
        changed = newest.changes_since(before)
        if changed is None and not self._calls_behind:
            return
        self._shown = newest
        self._calls_behind += 1
        if needs_whole or self._calls_behind > _CALLS_BEHIND:
            self._publish_whole(version, shown if needs_whole else newest)
        elif changed is not None:
            self._updates.publish(
                messages.map_update_msg(newest, changed, self._frame_id, version.stamp_ns)
            )

    def _has_subscriber_of_map_alone(self) -> bool:
        """Whether a node subscribes to map more often than to map_updates."""
        subscribers = [
            Counter(diagnostics.subscriber_names(self._node, topic.topic_name))
            for topic in (self._map, self._updates)
        ]
        return bool(subscribers[0] - subscribers[1])

    def _publish_whole(self, version: MapVersion, shown: GridPatch) -> None:
        self._shown = shown
        self._calls_behind = 0
        load_ns = version.identity.load_ns
        message = messages.grid_msg(shown, self._frame_id, version.stamp_ns, load_ns)
        self._map.publish(message)
        self._metadata.publish(message.info)

    def _on_matched(self, matched: QoSPublisherMatchedInfo) -> None:
        """A new subscriber has the newest whole map, and none of the updates since."""
        is_behind = self._calls_behind > 0
        has_come = matched.current_count_change > 0
        if has_come and is_behind and self._newest is not None and self._shown is not None:
            self._publish_whole(self._newest, self._shown)


def _with_room(patch: GridPatch, margins: Margins) -> Margins:
    """Margins with room beyond those that are needed."""
    rows, cols = (round(_ROOM * length) for length in patch.shape)
    top, left, bottom, right = margins
    return (
        top + rows if top else 0,
        left + cols if left else 0,
        bottom + rows if bottom else 0,
        right + cols if right else 0,
    )


def _pasted(wide: GridPatch, patch: GridPatch) -> GridPatch:
    return wide.with_part(*wide.offset_of(patch), patch.cells)
