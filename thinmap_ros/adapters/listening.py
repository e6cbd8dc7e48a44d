"""How nodes listen: only while active, and what a message says wrongly is counted and said, and the node goes on."""

from collections import deque
from collections.abc import Callable
from time import monotonic
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import LaserScan

from thinmap_ros.adapters.live_node import LiveNode
from thinmap_ros.core.errors import InputError

_QUIET_S = 5.0
_SILENT_S = 3.0
_LONGEST_GAP_NS = 5_000_000_000


def listen(node: LiveNode, kind: type, topic: str, take: Callable[[Any], None], profile: QoSProfile) -> None:
    """Subscribe to a topic. A message that `take` refuses with InputError is dropped with a warning, throttled."""
    _Listener(node, kind, topic, take, profile)


class _Listener:
    """A subscription, and what is to be known of it."""

    def __init__(
        self, node: LiveNode, kind: type, topic: str, take: Callable[[Any], None], profile: QoSProfile
    ) -> None:
        self._node, self._topic, self._take = node, topic, take
        self._is_scan = kind is LaserScan
        self._is_latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        self._held: Any = None
        self._said_at = -_QUIET_S
        self._last_ns = 0
        self._steps_ns: deque[int] = deque(maxlen=50)
        node.health.expects(topic)
        events = SubscriptionEventCallbacks(message_lost=self._on_lost) if self._is_scan else None
        node.create_subscription(kind, topic, self._on_message, profile, event_callbacks=events)
        if self._is_scan:
            node.health.complain_of_silence(topic, _SILENT_S)
        if self._is_latched:
            node.when_activated(self._take_held)

    def _on_message(self, message: Any) -> None:
        node = self._node
        node.health.heard(self._topic)
        if self._is_scan:
            self._count_gaps(message)
        node.settle()
        if not node.is_active:
            self._held = message if self._is_latched else None
        elif self._is_scan and node.is_paused:
            node.health.tell('last scan not taken', 'paused')
        else:
            self._guarded(message)

    def _count_gaps(self, message: LaserScan) -> None:
        """Count the scans that never came: a laser's stamps are evenly spaced."""
        ns = 1_000_000_000 * message.header.stamp.sec + message.header.stamp.nanosec
        step_ns, self._last_ns = ns - self._last_ns, ns
        if not 0 < step_ns < _LONGEST_GAP_NS:
            return
        usual_ns = min(self._steps_ns, default=step_ns)
        self._steps_ns.append(step_ns)
        self._node.health.dropped(f'{self._topic}: gaps between the stamps', round(step_ns / usual_ns) - 1)

    def _guarded(self, message: Any) -> None:
        try:
            self._take(message)
        except InputError as error:
            self._node.health.refused(self._topic, str(error))
            if monotonic() - self._said_at >= _QUIET_S:
                self._said_at = monotonic()
                self._node.get_logger().warning(f'{self._topic}: {error}')

    def _take_held(self) -> None:
        message, self._held = self._held, None
        if message is not None:
            self._guarded(message)

    def _on_lost(self, event: Any) -> None:
        self._node.health.dropped(f'{self._topic}: the queue was full, older ones gave way', event.total_count_change)
