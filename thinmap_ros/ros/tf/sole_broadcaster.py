"""Transforms that another node publishes between frames that this node connects."""

from collections import deque
from collections.abc import Iterable
from time import monotonic
from typing import Any

from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.diagnostics import WARN, full_name
from thinmap_ros.ros.lifecycle_node import ThinmapNode

_RECENT_S = 3.0  # a source that publishes more rarely is one that has ended
_OWN_STAMPS = 2 * qos.TRANSFORMS.depth  # at most the depth is queued


class SoleBroadcaster:
    """Reports on /diagnostics that another node connects the same frames on /tf or /tf_static.

    A subscriber takes the transforms of both, and the robot jumps between two places. A transform
    with a stamp that this node has not published is of another node.
    """

    def __init__(self, node: ThinmapNode, frames: Iterable[tuple[str, str]]) -> None:
        """frames: parent and child of each transform that this node publishes."""
        self._node = node
        self._frames = [(parent.lstrip('/'), child.lstrip('/')) for parent, child in frames]
        self._stamps: deque[int] = deque(maxlen=_OWN_STAMPS)
        self._foreign = ''  # the transform, as text
        self._received_s = 0.0
        self._is_static = False
        # Publishers of a static one when it arrived, by their ids: names are discovered later.
        self._static_sources: set[bytes] = set()
        node.diagnostics.add_check(WARN, self._fault)

    def add_own(self, stamp_ns: int) -> None:
        """Add the stamp of transforms that this node publishes."""
        self._stamps.append(stamp_ns)

    def add(self, transform: Any, is_static: bool) -> None:
        """Add a geometry_msgs/TransformStamped that was received."""
        parent = transform.header.frame_id.lstrip('/')
        child = transform.child_frame_id.lstrip('/')
        is_same = any(child == own for _, own in self._frames) or (child, parent) in self._frames
        is_own = not is_static and messages.stamp_ns(transform.header.stamp) in self._stamps
        if not is_same or is_own:
            return
        self._foreign = f'{parent} -> {child} on {_topic(is_static)}'
        self._received_s = monotonic()
        self._is_static = is_static
        self._static_sources = set(self._others('/tf_static')) if is_static else set()

    def _fault(self) -> str:
        others = self._others(_topic(self._is_static))
        if self._is_static:
            # It was sent once: it is there until one of its possible sources has ended.
            is_present = self._static_sources <= set(others)
        else:
            is_present = monotonic() - self._received_s < _RECENT_S
        if not self._foreign or not is_present:
            self._foreign = ''
            return ''
        names = ', '.join(sorted(set(others.values())))
        return (
            f'{self._foreign}: published by another node, too, one of {names}: '
            'stop it, or set publish_tf: false'
        )

    def _others(self, topic: str) -> dict[bytes, str]:
        """Full names of the nodes that publish a topic, but for this one, by publisher."""
        own = self._node.get_fully_qualified_name()
        infos = self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(topic))
        names = {bytes(info.endpoint_gid): full_name(info) for info in infos}
        return {publisher: name for publisher, name in names.items() if name != own}


def _topic(is_static: bool) -> str:
    return '/tf_static' if is_static else '/tf'
