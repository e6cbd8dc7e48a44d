"""How nodes listen.

Only while active, and what a message says wrongly is counted and said, and the node goes on.
What of a stream did not come is counted too.
"""

from collections import deque
from collections.abc import Callable
from time import monotonic
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import LaserScan

from thinmap_ros.core.errors import InputError
from thinmap_ros.ros.lifecycle_node import ThinmapNode

_QUIET_S = 5.0
_SILENT_S = 3.0
_LONGEST_GAP_NS = 5_000_000_000  # longer gaps are pauses of the sensor, no losses


def subscribe_guarded(
    node: ThinmapNode, kind: type, topic: str, process: Callable[[Any], None], profile: QoSProfile
) -> None:
    """Subscribe to a topic.

    A message that `process` refuses with InputError is dropped with a warning, throttled.
    """
    _Listener(node, kind, topic, process, profile)


class _Listener:
    """A subscription, and what is to be known of it."""

    def __init__(
        self,
        node: ThinmapNode,
        kind: type,
        topic: str,
        process: Callable[[Any], None],
        profile: QoSProfile,
    ) -> None:
        self._node = node
        self._topic = topic
        self._process = process
        self._is_scan = kind is LaserScan
        self._is_latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        self._held: Any = None
        self._said_at = -_QUIET_S
        self._last_ns = 0
        self._set_backs = 0
        self._losses = MessageLossCounter()
        node.diagnostics.expect_topic(topic)
        node.create_subscription(kind, topic, self._on_message, profile)
        if self._is_scan:
            node.diagnostics.add_timeout_check(topic, _SILENT_S)
        if self._is_latched:
            node.add_activation_callback(self._process_held)

    def _on_message(self, message: Any, info: dict[str, Any]) -> None:
        node = self._node
        node.diagnostics.message_received(self._topic)
        last_ns = self._last_ns
        self._last_ns = _stamp_ns(message)
        if not self._is_latched:
            self._count_losses(info.get('publication_sequence_number'))
        node.handle_time_jump()
        if self._is_left_over(last_ns):
            node.diagnostics.count_drops(f'{self._topic}: from before the clock jumped back', 1)
        elif not node.is_active:
            self._held = message if self._is_latched else None
        elif not (self._is_scan and node.is_paused):
            self._guarded(message)

    def _is_left_over(self, last_ns: int) -> bool:
        """Whether a message has waited here since before the clock was set back.

        It goes on where the stream was then.

        With the first that does not, the stream has arrived in the new time.
        """
        node = self._node
        if self._set_backs == node.time_jumps.count:
            return False
        if node.time_jumps.is_before(last_ns) and node.time_jumps.is_before(self._last_ns):
            return True
        self._set_backs = node.time_jumps.count
        return False

    def _count_losses(self, number: int | None) -> None:
        lost, missing = self._losses.record(self._last_ns, number)
        self._node.diagnostics.count_drops(
            f'{self._topic}: lost in transport or in a full queue', lost
        )
        if self._is_scan:
            self._node.diagnostics.count_drops(f'{self._topic}: gaps between the stamps', missing)

    def _guarded(self, message: Any) -> None:
        try:
            self._process(message)
        except InputError as error:
            self._node.diagnostics.message_rejected(self._topic, str(error))
            if monotonic() - self._said_at >= _QUIET_S:
                self._said_at = monotonic()
                self._node.get_logger().warning(f'{self._topic}: {error}')

    def _process_held(self) -> None:
        message = self._held
        self._held = None
        if message is not None:
            self._guarded(message)


class MessageLossCounter:
    """What of a stream was lost on the way, or never sent.

    Counts by the numbers that a publisher gives its messages, and by their evenly spaced stamps.

    Either alone is not enough: numbers of two publishers are mixed up, and a sensor that was silent
    has lost nothing.
    """

    def __init__(self) -> None:
        self._last_ns = 0
        self._last_number = 0
        self._steps_ns: deque[int] = deque(maxlen=50)

    def record(self, stamp_ns: int, number: int | None) -> tuple[int, int]:
        """Take note of a message and of its number, None where the middleware gives none.

        Returns how many between it and the last one were lost on the way, and how many more are
        missing: never sent, or without numbers nobody knows.
        """
        step_ns = stamp_ns - self._last_ns
        self._last_ns = stamp_ns
        skipped = (number or 0) - self._last_number - 1
        self._last_number = number or 0
        if step_ns <= 0:
            return 0, 0
        spaces = round(step_ns / min(self._steps_ns, default=step_ns)) - 1
        self._steps_ns.append(step_ns)
        lost = min(max(skipped, 0), max(spaces, 0))
        return lost, spaces - lost if spaces > 0 and step_ns < _LONGEST_GAP_NS else 0


def _stamp_ns(message: Any) -> int:
    """Stamp of a message as it says it, however strange."""
    return int(1_000_000_000 * message.header.stamp.sec + message.header.stamp.nanosec)
