"""The topic map: the whole map, and updates of what has changed in it."""

from collections import Counter

from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import MapMetaData, OccupancyGrid
from rclpy.event_handler import PublisherEventCallbacks, QoSPublisherMatchedInfo
from rclpy.node import Node

from thinmap_ros.core.grid.patch import Bounds, GridPatch, Margins
from thinmap_ros.nodes.mapping.map_values import MapVersion
from thinmap_ros.ros import diagnostics, messages, qos
from thinmap_ros.ros.maps import updates_topic

# Calls after which a whole map follows an update: one that was lost, for a reason that no
# publisher knows, is missing for so long. That of a large map is rarer, so that it is no more
# traffic than this.
_MAX_CALLS_BEHIND = 10
_MAX_REPEATED_BYTES_PER_S = 40e3
# Room of a map that grows, a share of its length: it grows again when the room is used up.
_ROOM = 0.25


class MapTopic:
    """Publishes map and map_metadata, or map_updates.

    The map is whole where its rectangle grows or it is another map, and as long as somebody
    subscribes to map and not to map_updates. Else map_updates has the rectangle that has changed;
    the whole map follows ten calls later (of a map of 100 x 100 m after 100 s), or once a
    subscriber comes.
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

    def publish(self, version: MapVersion, changed: Bounds | None) -> None:
        """Publish what has changed since the last call.

        changed: bounds within the version of all cells that may have; None: none has.
        """
        before = self._newest
        self._newest = version
        if self._shown is None or before is None or not version.extends(before):
            self._publish_whole(version, version.shown())
        elif any(margins := self._shown.overhang_of(version.patch)):
            self._publish_larger(version, self._shown.padded(_with_room(self._shown, margins)))
        else:
            self._publish_changes(version, None if changed is None else version.shown(changed))

    def _publish_larger(self, version: MapVersion, wide: GridPatch) -> None:
        shown = version.shown()
        if not self._has_subscriber_of_map_alone():
            shown = wide.with_part(*wide.offset_of(shown), shown.cells)
        self._publish_whole(version, shown)

    def _publish_changes(self, version: MapVersion, part: GridPatch | None) -> None:
        changed = None if part is None else self._take_in(part)
        if self._shown is None or (changed is None and not self._calls_behind):
            return
        self._calls_behind += 1
        if self._has_subscriber_of_map_alone():
            self._publish_whole(version, version.shown())
        elif self._calls_behind > _calls_between_whole(self._shown, version):
            self._publish_whole(version, self._shown)
        elif changed is not None:
            self._updates.publish(
                messages.map_update_msg(self._shown, changed, self._frame_id, version.stamp_ns)
            )

    def _take_in(self, part: GridPatch) -> GridPatch | None:
        """Take a part into what is shown; returns the rectangle that has changed, if any has."""
        if self._shown is None:
            return None
        row, col = self._shown.offset_of(part)
        rows, cols = part.shape
        changed = part.changes_since(self._shown.part((row, col, row + rows, col + cols)))
        if changed is None:
            return None
        self._shown = self._shown.with_part(row, col, part.cells)
        return part.part(changed)

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


def _calls_between_whole(shown: GridPatch, version: MapVersion) -> float:
    """Calls after which the whole map follows an update."""
    period_s = shown.cells.nbytes / _MAX_REPEATED_BYTES_PER_S
    return max(_MAX_CALLS_BEHIND, period_s / version.identity.config.map_update_interval)


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
