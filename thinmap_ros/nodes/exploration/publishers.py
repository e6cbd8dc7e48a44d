"""Whether somebody publishes a topic."""

from time import monotonic

from rclpy.node import Node

_PERIOD_S = 1.0


class PublisherCheck:
    """Whether somebody publishes one of some topics; looked up once a second."""

    def __init__(self, node: Node, *topics: str) -> None:
        self._node = node
        self._topics = topics
        self._is_found = False
        self._checked_s = -_PERIOD_S

    def is_found(self) -> bool:
        """Whether there is a publisher."""
        if monotonic() - self._checked_s >= _PERIOD_S:
            self._set(any(self._count(topic) > 0 for topic in self._topics))
        return self._is_found

    def message_received(self) -> None:
        """Register a message: its publisher may not be discovered yet."""
        self._set(True)

    def _count(self, topic: str) -> int:
        # rclpy counts the publishers of a name as it is, without the node's remapping rules.
        return int(self._node.count_publishers(self._node.resolve_topic_name(topic)))

    def _set(self, is_found: bool) -> None:
        self._is_found = is_found
        self._checked_s = monotonic()
