"""Time that waits for the nodes.

With it a log or a simulation can run at any rate, and no scan is lost.
"""

from time import monotonic
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node

from thinmap_msgs.msg import LocalizationStatus, TopologicalMap
from thinmap_ros.ros import messages, qos

NONE = 'none'
_TYPES: dict[str, Any] = {
    'pose': PoseWithCovarianceStamped,
    'local_map': OccupancyGrid,
    'local_topology': TopologicalMap,
    'localization_status': LocalizationStatus,
}
TOPICS = (NONE, *_TYPES)
# Long: a machine that is busy, or compiles, is not one on which a scan leads to nothing.
PATIENCE_S = 10.0
PATIENCE_WORDS = 'in lockstep, go on without an answer after so long, s of the machine'


class Lockstep:
    """Waits, after each scan, for the message of a topic that carries the scan's stamp.

    What the scan led to.
    """

    def __init__(self, node: Node, topic: str, timeout_s: float = PATIENCE_S) -> None:
        self._node = node
        self._topic = topic
        self._timeout_s = timeout_s
        self._awaited_ns: int | None = None
        self._since = 0.0
        if topic != NONE:
            node.create_subscription(_TYPES[topic], topic, self._on_message, qos.STREAM)

    def scan_published(self, stamp_ns: int) -> None:
        """Take note that a scan was published."""
        if self._topic != NONE:
            self._awaited_ns = stamp_ns
            self._since = monotonic()

    @property
    def is_waiting(self) -> bool:
        """Whether the answer to the last scan is still to come."""
        return self._awaited_ns is not None

    @property
    def waited_s(self) -> float:
        """How long the last scan has been waiting, s of the machine's time."""
        return monotonic() - self._since

    def timed_out(self) -> bool:
        """Whether patience is at an end; then waiting ends as well."""
        if self.waited_s < self._timeout_s:
            return False
        self._node.get_logger().warning(f'no /{self._topic} for the last scan: going on without it')
        self._awaited_ns = None
        return True

    def _on_message(self, message: Any) -> None:
        if (
            self._awaited_ns is not None
            and messages.stamp_ns(message.header.stamp) >= self._awaited_ns
        ):
            self._awaited_ns = None
