"""How nodes listen: what a message says wrongly is said in a warning, and the node goes on without it."""

from collections.abc import Callable
from time import monotonic
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile

from thinmap_ros.core.errors import InputError

_QUIET_S = 5.0


def listen(node: Node, kind: type, topic: str, take: Callable[[Any], None], profile: QoSProfile) -> None:
    """Subscribe to a topic. A message that `take` refuses with InputError is dropped with a warning, throttled."""
    said_at = -_QUIET_S

    def guarded(message: Any) -> None:
        nonlocal said_at
        try:
            take(message)
        except InputError as error:
            if monotonic() - said_at >= _QUIET_S:
                said_at = monotonic()
                node.get_logger().warning(f'{topic}: {error}')

    node.create_subscription(kind, topic, guarded, profile)
