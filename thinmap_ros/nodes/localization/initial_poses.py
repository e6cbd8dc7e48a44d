"""Initial poses of a user, in any frame."""

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.se2 import Array, rotated_covariance
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import subscribe_guarded
from thinmap_ros.ros.tf import TransformListener


class InitialPoses:
    """Subscribes to initialpose; calls `process` with pose (3,) and covariance (3, 3), map frame.

    Poses in other frames are transformed by the newest transforms.
    """

    def __init__(
        self,
        node: ThinmapNode,
        map_frame: str,
        process: Callable[[Array, Array], None],
        transform_received: Callable[[Any, bool], None],
    ) -> None:
        """transform_received: is called with each transform, and whether it is static."""
        self._map_frame = map_frame
        self._process = process
        self._transforms = TransformListener(node, transform_received)
        subscribe_guarded(node, PoseWithCovarianceStamped, 'initialpose', self.add_pose, qos.STREAM)

    def add_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Process a message. Raises InputError where it is invalid, or its frame unknown."""
        pose = messages.pose_from_msg(message.pose.pose)
        covariance = messages.covariance_from_msg(message)
        frame = message.header.frame_id.lstrip('/')
        if frame not in ('', self._map_frame):
            T_map_frame = self._lookup(frame)
            pose = se2.compose(T_map_frame, pose)
            covariance = rotated_covariance(covariance, float(T_map_frame[2]))
        self._process(pose, covariance)

    def _lookup(self, frame: str) -> Array:
        try:
            return self._transforms.lookup(self._map_frame, frame)
        except InputError as error:
            expected = f'expected a frame connected to {quoted(self._map_frame)}'
            raise InputError(f'frame {quoted(frame)}: {error}: {expected}') from error
