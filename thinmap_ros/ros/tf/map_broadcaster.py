"""The transform from the map to the odometry frame, published ahead of time."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from tf2_msgs.msg import TFMessage

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.se2 import Array
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.tf.sole_broadcaster import SoleBroadcaster


@dataclass(frozen=True)
class BroadcastConfig(Config):
    """How map_frame -> odom_frame is published."""

    publish_tf: bool = parameter(
        True,
        'Publish the transform from map_frame to odom_frame on /tf. false: another node does.',
    )
    transform_publish_period: float = parameter(
        0.05,
        'Time between two transforms (s). 0: one with each scan. Lower it where lookups find a '
        'transform that is too old, raise it to save CPU.',
        low=0.0,
        high=10.0,
    )
    transform_tolerance: float = parameter(
        0.2,
        'Time by which transforms are dated into the future (s), so that lookups at the present '
        'time succeed. Raise it for slow scanners and networks, lower it where a late correction '
        'of the map must be seen at once.',
        low=0.0,
        high=10.0,
    )


class MapBroadcaster:
    """Publishes the last T_map_odom periodically, dated `transform_tolerance` ahead.

    For a robot without odometry, odom_frame -> base_frame is published, too: the identity.
    """

    def __init__(
        self, node: ThinmapNode, map_frame: str, odom_frame: str, identity_frame: str = ''
    ) -> None:
        """identity_frame: name of the base frame if nobody else publishes its transform."""
        self._node = node
        self._frames = [(map_frame, odom_frame)]
        if identity_frame:
            self._frames.append((odom_frame, identity_frame))
        self._config = parameters.declare_config(
            node, BroadcastConfig, self._on_config, live=('transform_tolerance',)
        )
        self._T_map_odom: Array | None = None
        self._sole: SoleBroadcaster | None = None
        if not self._config.publish_tf:
            return
        self._publisher = node.create_publisher(TFMessage, '/tf', qos.TRANSFORMS)
        self._sole = SoleBroadcaster(node, self._frames)
        if self._config.transform_publish_period > 0.0:
            node.create_active_timer(self._config.transform_publish_period, self._publish)

    def _on_config(self, config: BroadcastConfig) -> None:
        self._config = config

    def update(self, T_map_odom: Array) -> None:
        """Publish another transform (3,) from now on."""
        is_first = self._T_map_odom is None
        self._T_map_odom = T_map_odom
        if self._config.publish_tf and (is_first or self._config.transform_publish_period == 0.0):
            self._publish()

    def received(self, transform: Any, is_static: bool) -> None:
        """A geometry_msgs/TransformStamped was received, of this node or another one."""
        if self._sole is not None:
            self._sole.add(transform, is_static)

    def reset(self) -> None:
        """Publish nothing until the next `update`."""
        self._T_map_odom = None

    def _publish(self) -> None:
        if self._T_map_odom is None:
            return
        ahead_ns = round(1e9 * self._config.transform_tolerance)
        stamp_ns = self._node.get_clock().now().nanoseconds + ahead_ns
        if self._sole is not None:
            self._sole.add_own(stamp_ns)
        poses = [self._T_map_odom, np.zeros(3)]
        self._publisher.publish(
            TFMessage(
                transforms=[
                    messages.transform_msg(T, parent, child, stamp_ns)
                    for T, (parent, child) in zip(poses, self._frames, strict=False)
                ]
            )
        )
