"""Where the laser sits on the robot: from /tf_static, or from a parameter where the user chose so."""

import numpy as np
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from thinmap_ros.adapters import messages, parameters, qos
from thinmap_ros.core import se2
from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.core.se2 import Array


class LaserMount:
    """The pose of each laser frame on the robot.

    Looked up in the static transforms. A node whose robot publishes none is given the parameter `laser_pose`
    [x m, y m, yaw rad]; it then holds for every frame. Nothing is ever assumed: without either, `pose` is None.
    """

    def __init__(self, node: Node) -> None:
        self._base_frame = str(parameters.declare_value(node, 'base_frame', 'base_link', 'frame of the robot'))
        given = parameters.declare_value(
            node, 'laser_pose', '', 'laser on the robot as "x,y,yaw" (m, m, rad); empty: from /tf_static'
        )
        self._fixed = _parse_pose(str(given)) if given else None
        self._parents: dict[str, tuple[str, Array]] = {}
        if self._fixed is None:
            node.create_subscription(TFMessage, '/tf_static', self._on_static, qos.STATIC_TRANSFORMS)

    def pose(self, frame_id: str) -> Array | None:
        """T_base_laser (3,) of a laser frame, or None as long as it is not known."""
        if self._fixed is not None:
            return self._fixed
        T = np.zeros(3)
        for _ in range(len(self._parents) + 1):
            if frame_id == self._base_frame:
                return T
            if frame_id not in self._parents:
                return None
            frame_id, step = self._parents[frame_id]
            T = se2.compose(step, T)
        return None  # frames that are each other's parents

    def _on_static(self, message: TFMessage) -> None:
        for transform in message.transforms:
            moved, turned = transform.transform.translation, transform.transform.rotation
            try:
                step = se2.pose(moved.x, moved.y, messages.yaw_of(turned))
            except InputError:
                continue  # a transform that is none tells nothing: its frame stays unknown
            self._parents[transform.child_frame_id] = (transform.header.frame_id, step)


def _parse_pose(text: str) -> Array:
    try:
        x, y, yaw = (float(part) for part in text.split(','))
        T = se2.pose(x, y, yaw)
    except ValueError:
        T = np.full(3, np.nan)
    if not se2.is_finite(T):
        raise ConfigError(f'laser_pose = {text!r}: expected "x,y,yaw" in m, m, rad')
    return T
