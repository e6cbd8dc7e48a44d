"""Which messages of a bag are due, in a time that is told.

It runs, stands still, goes by steps, or begins again.
"""

from collections.abc import Iterator

from thinmap_ros.core.errors import InputError
from thinmap_ros.logs import qos
from thinmap_ros.logs.bag import Bag
from thinmap_ros.logs.storage import RawMessage

_SCAN = 'sensor_msgs/msg/LaserScan'


def is_scan(message: RawMessage) -> bool:
    """Whether a message is a laser scan: what steps and lockstep go by."""
    return message.type_name == _SCAN


class Playback:
    """Goes through chosen topics of a bag from an offset on.

    What is latched is known from the start: `known_before` holds the last message before the offset
    of each such topic, and all static transforms of the bag, as where the sensors sit is known
    before anything is sensed.
    """

    def __init__(self, bag: Bag, topics: set[str], start_offset_s: float, loop: bool) -> None:
        """Read up to the offset. Raises InputError where the bag ends before it."""
        self._bag = bag
        self._topics = topics
        self._loop = loop
        self._first_ns = 0
        self.known_before = self._read_known(start_offset_s)
        self._messages: Iterator[RawMessage] = iter(())
        self._next: RawMessage | None = None
        self.played_ns = 0
        self.laps = 0
        self._begin()

    @property
    def finished(self) -> bool:
        """Whether nothing is left."""
        return self._next is None

    @property
    def clock_ns(self) -> int:
        """Time of the bag, ns: what was played, and never past a message that is still to come."""
        return self.played_ns if self._next is None else min(self.played_ns, self._next.log_ns)

    def advance(self, ns: float) -> None:
        """Let time of the bag pass, ns."""
        self.played_ns += int(ns)

    def due(self) -> RawMessage | None:
        """Next message whose time has come; None where there is none yet.

        After the last one a loop begins again.
        """
        if self._next is None or self._next.log_ns > self.played_ns:
            return None
        return self._take()

    def step(self) -> list[RawMessage]:
        """Messages up to and with the next scan; in a bag without scans the next message."""
        has_scans = any(self._bag.topics[topic] == _SCAN for topic in self._topics)
        taken: list[RawMessage] = []
        while self._next is not None:
            laps = self.laps
            taken.append(self._take())
            if not has_scans or is_scan(taken[-1]) or self.laps > laps:
                break
        if taken and taken[-1].log_ns > self.played_ns:
            self.played_ns = taken[-1].log_ns
        return taken

    def _take(self) -> RawMessage:
        message = self._next
        assert message is not None
        self._next = next(self._messages, None)
        if self._next is None and self._loop:
            self.laps += 1
            self._begin()
        return message

    def _begin(self) -> None:
        self._messages = (m for m in self._bag.messages(self._topics) if m.log_ns >= self._first_ns)
        self._next = next(self._messages, None)
        self.played_ns = 0 if self._next is None else self._next.log_ns

    def _read_known(self, start_offset_s: float) -> list[RawMessage]:
        latched = {t for t in self._topics if qos.is_latched(t, self._bag.offers.get(t, []))}
        static = {topic for topic in latched if topic.endswith('tf_static')}
        known = list(self._bag.messages(static)) if static else []
        last: dict[str, RawMessage] = {}
        begun_ns: int | None = None
        for message in self._bag.messages(self._topics):
            begun_ns = message.log_ns if begun_ns is None else begun_ns
            self._first_ns = begun_ns + int(start_offset_s * 1e9)
            if message.log_ns >= self._first_ns:
                return [*known, *last.values()]
            if message.topic in latched - static:
                last[message.topic] = message
        if begun_ns is not None:
            raise InputError(f'{self._bag.path}: ends before start_offset_s = {start_offset_s}')
        return known
