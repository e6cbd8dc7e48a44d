"""Messages of a bag that are due, for a clock that runs, pauses, steps or loops."""

from collections.abc import Iterator

from thinmap_ros.core.errors import InputError
from thinmap_ros.logs import storage
from thinmap_ros.logs.readers.bag import SCAN, Bag
from thinmap_ros.logs.storage import RawMessage


def is_scan(message: RawMessage) -> bool:
    """Whether a message is a laser scan, the unit of steps and lockstep."""
    return message.type_name == SCAN


class Playback:
    """Plays selected topics of a bag from an offset.

    Latched messages are available from the start: `known_before` holds the last message of each
    such topic before the offset, and all static transforms of the bag, because sensor poses are
    needed before the first measurement.
    """

    def __init__(self, bag: Bag, topics: set[str], start_offset_s: float, loop: bool) -> None:
        """Read up to the offset. Raises InputError if the bag ends before it."""
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
        """Whether all messages have been played."""
        return self._next is None

    @property
    def clock_ns(self) -> int:
        """Time of the bag, ns, never beyond the next message."""
        return self.played_ns if self._next is None else min(self.played_ns, self._next.log_ns)

    def advance(self, ns: float) -> None:
        """Advance the time of the bag, ns."""
        self.played_ns += int(ns)

    def pop_due(self) -> RawMessage | None:
        """Next message that is due, or None. A loop restarts after the last message."""
        if self._next is None or self._next.log_ns > self.played_ns:
            return None
        return self._take()

    @property
    def due_scan(self) -> str:
        """Topic of the next message where it is a scan that is due; else ''."""
        following = self._next
        is_due = following is not None and following.log_ns <= self.played_ns
        return following.topic if following is not None and is_due and is_scan(following) else ''

    def hold(self) -> None:
        """Stop the time of the bag at the next message: it is held back."""
        self.played_ns = self.clock_ns

    def step(self) -> list[RawMessage]:
        """Messages up to and including the next scan; without scans, the next message."""
        has_scans = any(self._bag.topics[topic] == SCAN for topic in self._topics)
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
        latched = {t for t in self._topics if storage.is_latched(t, self._bag.offers.get(t, []))}
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
