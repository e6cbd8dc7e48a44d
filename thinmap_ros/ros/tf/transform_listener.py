"""Transforms between the frames of a robot, from /tf and /tf_static."""

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from tf2_msgs.msg import TFMessage

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.logs.transforms import TransformBuffer
from thinmap_ros.ros import qos
from thinmap_ros.ros.tf.transform_reader import TransformReader


class TransformListener:
    """A buffer that is filled from /tf and /tf_static."""

    def __init__(
        self, node: Node, received: Callable[[Any, bool], None] = lambda transform, is_static: None
    ) -> None:
        """received: is called with each transform that is read, and whether it is static."""
        self._node = node
        self._received = received
        self._buffer = TransformBuffer()
        self._subscribe('/tf', qos.TRANSFORMS, is_static=False)
        self._subscribe('/tf_static', qos.STATIC_TRANSFORMS, is_static=True)

    def lookup(self, target_frame: str, source_frame: str, stamp_ns: int | None = None) -> Array:
        """Pose of the source frame in the target frame, T_target_source (3,).

        stamp_ns: None for the newest. Raises InputError with the reason where it is unknown.
        """
        return self._buffer.lookup(target_frame, source_frame, stamp_ns)

    def clear(self) -> None:
        """Forget all but the static transforms: the time was set back."""
        self._buffer.clear()

    def _subscribe(self, topic: str, profile: QoSProfile, is_static: bool) -> None:
        reader = TransformReader(self._buffer.is_used)

        def add(data: bytes) -> None:
            try:
                for transform in reader.read(data):
                    self._received(transform, is_static)
                    self._add(transform, is_static)
            except InputError as error:
                self._warn(error)

        self._node.create_subscription(TFMessage, topic, add, profile, raw=True)

    def _add(self, transform: Any, is_static: bool) -> None:
        try:
            self._buffer.add(transform, is_static)
        except InputError as error:
            self._warn(error)

    def _warn(self, error: InputError) -> None:
        self._node.get_logger().warning(f'/tf: {error}', throttle_duration_sec=5.0)
