"""Publishes the keyframes of the map that the localizer makes, for a map of several robots."""

from rclpy.node import Node

from thinmap_msgs.msg import Keyframe, KeyframePoses
from thinmap_ros.core.slam.joining.messages import KeyframeSender
from thinmap_ros.core.slam.localizer import AnyLocalizer, Localizer
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.maps import new_map_id


class KeyframeOutput:
    """Topics keyframes, a message each, and keyframe_poses after a correction, both latched.

    At most one keyframe with each scan: those of a loaded map follow one after another.
    """

    def __init__(self, node: Node, map_frame: str) -> None:
        self._frame = map_frame
        self._keyframes = node.create_publisher(Keyframe, 'keyframes', qos.KEYFRAMES)
        self._poses = node.create_publisher(KeyframePoses, 'keyframe_poses', qos.LATCHED)
        self._sender: KeyframeSender | None = None
        self._session = 0

    def publish(self, stamp_ns: int, localizer: AnyLocalizer, map_id: int) -> None:
        """Publish what is new since the last scan; stamp_ns: of this one."""
        graph = localizer.published_graph if isinstance(localizer, Localizer) else None
        if graph is None:
            self._sender = None
            return
        if self._sender is None or self._sender.loops is not graph:
            self._sender = KeyframeSender(graph)
            self._session = new_map_id()
        header = messages.header(self._frame, stamp_ns)
        poses = self._sender.corrected_poses()
        if poses is not None:
            self._poses.publish(
                KeyframePoses(
                    header=header,
                    session=self._session,
                    revision=self._sender.revision,
                    poses=poses.ravel().tolist(),
                )
            )
        message = self._sender.next_message()
        if message is not None:
            self._keyframes.publish(
                Keyframe(
                    header=header,
                    map_id=map_id,
                    session=self._session,
                    layout=Keyframe.LAYOUT,
                    data=message.encode(),
                )
            )
