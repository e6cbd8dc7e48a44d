"""The stop of a robot: a latched std_msgs/Bool, true as long as the robot has to stand."""

from collections.abc import Callable
from typing import Any

from std_msgs.msg import Bool

from thinmap_ros.ros import qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import AdaptiveSubscription

TOPIC = 'stop'


def subscribe_to_stop(node: ThinmapNode, on_stop: Callable[[bool], None]) -> None:
    """Subscribe to the stop, also of a publisher that does not latch it, whatever the node does."""

    def received(message: Bool, info: dict[str, Any]) -> None:
        node.diagnostics.message_received(TOPIC)
        on_stop(bool(message.data))

    node.diagnostics.expect_topic(TOPIC)
    AdaptiveSubscription(node, Bool, TOPIC, received, qos.LATCHED)
