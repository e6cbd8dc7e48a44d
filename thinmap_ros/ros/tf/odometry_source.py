"""Odometry of the robot: from its topic, from TF, or none."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from tf2_msgs.msg import TFMessage

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.logs.frames import NONE, SOURCES, TF, TOPIC
from thinmap_ros.logs.transforms import OdometryFrames, TransformOdometry
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import AdaptiveSubscription, subscribe_guarded
from thinmap_ros.ros.tf.transform_reader import TransformReader


@dataclass(frozen=True)
class OdometryInputConfig(Config):
    """Where odometry comes from."""

    odom_source: str = parameter(
        TOPIC,
        'Source of the odometry. topic: nav_msgs/Odometry on odom, in odom_frame and base_frame or '
        'in frames that static transforms connect to these. tf: the transform from odom_frame to '
        'base_frame. none: the robot has no odometry; the localizer follows it by '
        'scan matching alone and publishes odom_frame -> base_frame as identity.',
        choices=SOURCES,
    )


class OdometrySource:
    """Calls `process` with the stamp in ns and T_odom_base (3,) of each sample of the odometry.

    Without odometry the robot never moves in the odometry frame: there is a sample at the stamp of
    each scan, which the node reports by `add_scan_stamp`.
    """

    def __init__(
        self, node: ThinmapNode, base_frame: str, process: Callable[[int, Array], None]
    ) -> None:
        self._node = node
        self._process = process
        self.odom_frame = str(
            parameters.declare_parameter(
                node, 'odom_frame', 'odom', 'Frame of the odometry (REP 105).'
            )
        )
        self.source = parameters.declare_config(node, OdometryInputConfig).odom_source
        self._frames = OdometryFrames(
            self.odom_frame,
            base_frame,
            self._subscribe_static,
            lambda note: node.get_logger().info(f'odom: {note}'),
        )
        self._transforms = TransformOdometry(self.odom_frame, base_frame)
        self._readers = {
            is_static: TransformReader(self._transforms.is_used) for is_static in (False, True)
        }

    def subscribe(self) -> None:
        """Start to receive samples."""
        node = self._node
        if self.source == TOPIC:
            subscribe_guarded(node, Odometry, 'odom', self._on_odometry, qos.STREAM)
        elif self.source == TF:
            self._subscribe_static()
            AdaptiveSubscription(
                node, TFMessage, '/tf', self._on_transforms, qos.TRANSFORMS, raw=True
            )
            node.diagnostics.add_update_callback(self._report)

    def reset(self) -> None:
        """Forget the samples: the time was set back."""
        self._transforms.clear()

    def add_scan_stamp(self, stamp_ns: int) -> None:
        """A scan was made: without odometry, the robot is where it was."""
        if self.source == NONE:
            self._process(stamp_ns, np.zeros(3))

    def _on_odometry(self, message: Odometry) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self._process(stamp_ns, self._frames.pose(message))

    def _subscribe_static(self) -> None:
        AdaptiveSubscription(
            self._node, TFMessage, '/tf_static', self._on_static, qos.STATIC_TRANSFORMS, raw=True
        )

    def _on_static(self, data: bytes, _info: dict[str, Any]) -> None:
        self._add(data, is_static=True)

    def _on_transforms(self, data: bytes, _info: dict[str, Any]) -> None:
        """Add transforms; the sample is that of the newest time at which all of them are known."""
        self._node.handle_time_jump()
        self._add(data, is_static=False)
        if not self._node.is_active:
            return
        try:
            sample = self._transforms.next_sample()
            if sample is not None:
                self._process(*sample)
        except InputError as error:
            self._node.diagnostics.message_rejected('/tf', str(error))

    def _add(self, data: bytes, is_static: bool) -> None:
        try:
            for transform in self._readers[is_static].read(data):
                self._add_transform(transform, is_static)
        except InputError as error:
            self._node.diagnostics.message_rejected('/tf', str(error))

    def _add_transform(self, transform: Any, is_static: bool) -> None:
        try:
            self._transforms.add(transform, is_static)
            if is_static:
                self._frames.add_static(transform)
        except InputError as error:
            self._node.diagnostics.message_rejected('/tf', str(error))

    def _report(self) -> None:
        """Report on /diagnostics what is missing of the chain of transforms."""
        missing = self._transforms.missing
        self._node.diagnostics.set_value('odometry by TF', missing or 'received')
