"""Lockstep: a player or simulation waits for the result of each scan, so that none is lost."""

from time import monotonic
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node

from thinmap_msgs.msg import LocalGrid, LocalizationStatus, TopologicalMap
from thinmap_ros.ros import messages, qos

NONE = 'none'
_TYPES: dict[str, Any] = {
    'pose': PoseWithCovarianceStamped,
    'local_grid': LocalGrid,
    'local_topology': TopologicalMap,
    'localization_status': LocalizationStatus,
}
TOPICS = (NONE, *_TYPES)
# Long: a busy machine, or one that compiles kernels, still publishes a result.
TIMEOUT_S = 10.0
TIMEOUT_DESCRIPTION = 'Time after which lockstep continues without a result (s, machine time).'


class Lockstep:
    """Waits, after each scan, for its result: the message of a topic with the stamp of the scan."""

    def __init__(
        self, node: Node, topic: str, timeout_s: float = TIMEOUT_S, prefix: str = ''
    ) -> None:
        """prefix: of the topic of one of several robots, with a slash."""
        self._node = node
        self._topic = topic
        self._name = f'{prefix}{topic}'
        self._timeout_s = timeout_s
        self._awaited_ns: int | None = None
        self._since = 0.0
        if topic != NONE:
            node.create_subscription(_TYPES[topic], self._name, self._on_message, qos.STREAM)

    def scan_published(self, stamp_ns: int) -> None:
        """Wait for the result of a scan that was published."""
        if self._topic != NONE:
            self._awaited_ns = stamp_ns
            self._since = monotonic()

    @property
    def is_waiting(self) -> bool:
        """Whether the result of the last scan is missing."""
        return self._awaited_ns is not None

    @property
    def waited_s(self) -> float:
        """Time since the last scan was published, s of the machine."""
        return monotonic() - self._since

    def timed_out(self) -> bool:
        """Whether the result has been missing for too long; waiting then ends."""
        if self.waited_s < self._timeout_s:
            return False
        self._node.get_logger().warning(
            f'no /{self._name} for the last scan: continuing without it'
        )
        self._awaited_ns = None
        return True

    def _on_message(self, message: Any) -> None:
        if (
            self._awaited_ns is not None
            and messages.stamp_ns(message.header.stamp) >= self._awaited_ns
        ):
            self._awaited_ns = None
