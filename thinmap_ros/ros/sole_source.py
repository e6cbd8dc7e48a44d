"""Of several publishers of a topic, the first is followed.

rclpy does not tell the publisher of a message, but the message's number at its publisher and when
it was received: each publisher numbers its messages one by one. `private_rclpy` takes the publisher
from rcl itself, but of a Bool alone.
"""

from collections.abc import Callable
from dataclasses import dataclass
from time import time_ns
from typing import Any

from rclpy.node import Node

from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.ros.diagnostics import WARN, NodeDiagnostics

# After a time without a message of the followed publisher, the next one is followed: a driver that
# was killed is on the graph for up to 20 s. A simulation may be paused for a while.
_SILENCE_NS = 3 * SECOND_NS
_PAUSE_NS = 30 * SECOND_NS
_MAX_SOURCES = 8  # that are known at a time
_UNKNOWN = 0.5  # periods between the expected time and that of a message, where none is known


@dataclass
class _Stream:
    """Messages of one publisher: number and time of the last, ns; mean time between two, ns."""

    number: int
    received_ns: int
    period_ns: float = 0.0
    is_refused: bool = False

    def surprise(self, number: int, received_ns: int) -> float | None:
        """How far from the expected time a message with a number was received, in periods.

        None where it cannot belong to this stream: it is an old one, or in the time since the last
        one the publisher cannot have sent those between them.
        """
        steps = number - self.number
        elapsed_ns = received_ns - self.received_ns
        if steps <= 0 or (steps - 1) * self.period_ns > 2.0 * elapsed_ns:
            return None
        if not self.period_ns:
            return _UNKNOWN
        return abs(elapsed_ns - steps * self.period_ns) / self.period_ns

    def add(self, number: int, received_ns: int) -> None:
        """Add a message that belongs to this stream."""
        period_ns = max(received_ns - self.received_ns, 0) / (number - self.number)
        self.period_ns += 0.2 * (period_ns - self.period_ns) if self.period_ns else period_ns
        self.number = number
        self.received_ns = received_ns


class SoleSource:
    """Tells the messages of the publisher that is followed from those of others.

    At the moment at which the numbers of both are the same, one message may be mistaken.
    """

    def __init__(
        self,
        count_publishers: Callable[[], int],
        silence_ns: int = _SILENCE_NS,
        now_ns: Callable[[], int] = time_ns,
    ) -> None:
        """silence_ns: time without a message after which another publisher is followed.

        now_ns: the clock of the times of receipt.
        """
        self._count_publishers = count_publishers
        self._now_ns = now_ns
        self._silence_ns = silence_ns
        self._followed: _Stream | None = None
        self._rivals: list[_Stream] = []
        self._alone_ns: int | None = None  # since when the graph has one publisher

    def accepts(self, info: dict[str, Any]) -> bool:
        """Whether a message is to be used; info: what rclpy gives with it.

        A middleware without numbers of messages has all of them accepted.
        """
        number = info.get('publication_sequence_number')
        if number is None:
            return True
        received_ns = int(info['received_timestamp'])
        stream = self._stream(number, received_ns)
        if stream is not self._followed:
            stream.is_refused = self._is_of_another(stream, received_ns)
            if stream.is_refused:
                return False
            self._followed = stream
            self._rivals = []
        return True

    def _is_of_another(self, stream: _Stream, received_ns: int) -> bool:
        """Whether a stream that is not followed is of another publisher than the one that is."""
        if self._followed is None:
            return False
        if self._count_publishers() > 1:
            self._alone_ns = None
            return abs(received_ns - self._followed.received_ns) < self._silence_ns
        if self._alone_ns is None:
            self._alone_ns = self._now_ns()
        # The last messages of a rival are still in the queue when it has left the graph.
        return stream.is_refused and received_ns <= self._alone_ns

    def _stream(self, number: int, received_ns: int) -> _Stream:
        """The stream to which a message is added, a new one where it belongs to none."""
        known = [*([self._followed] if self._followed else []), *self._rivals]
        surprises = [(each.surprise(number, received_ns), each) for each in known]
        fitting = [(surprise, each) for surprise, each in surprises if surprise is not None]
        if fitting:
            stream = min(fitting, key=lambda pair: pair[0])[1]
            stream.add(number, received_ns)
            return stream
        stream = _Stream(number, received_ns)
        self._rivals = [*self._rivals[1 - _MAX_SOURCES :], stream]
        return stream


class SourceByFrame:
    """The publisher that is followed for each frame: several lasers may share a topic."""

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self._topic = node.resolve_topic_name(topic)
        self._sources: dict[str, SoleSource] = {}

    def accepts(self, message: Any, info: dict[str, Any]) -> bool:
        """Whether a message with a header is to be used; info: what rclpy gives with it."""
        frame = message.header.frame_id
        if frame not in self._sources and len(self._sources) >= _MAX_SOURCES:
            self._sources.clear()
        source = self._sources.setdefault(frame, SoleSource(self._count_publishers))
        return source.accepts(info)

    def _count_publishers(self) -> int:
        return int(self._node.count_publishers(self._topic))


def follow_one_clock(node: Node, diagnostics: NodeDiagnostics) -> None:
    """Let a node in simulated time follow the first publisher of /clock; others are reported.

    rclpy sets the time by each message on /clock: between two simulations or bags it would jump to
    and fro, and the node would be reset each time.
    """
    topic = node.resolve_topic_name('/clock')
    subscription = next((each for each in node.subscriptions if each.topic_name == topic), None)
    if subscription is None:
        return
    source = SoleSource(lambda: int(node.count_publishers(topic)), _PAUSE_NS)
    set_time = subscription.callback
    cause = f'{topic}: from another publisher'
    diagnostics.set_drop_total(cause, 0)  # the thread of a shared clock adds no key

    def set_time_of_source(message: Any, info: dict[str, Any]) -> None:
        if source.accepts(info):
            set_time(message)
        else:
            diagnostics.count_drops(cause, 1)

    subscription.callback = set_time_of_source
    diagnostics.check_sole_publisher(topic, WARN)
