"""Events of a log in the order of their stamps, where some of them came late."""

import math
from collections.abc import Iterable, Iterator
from itertools import pairwise

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import CLOCK_JUMP_NS
from thinmap_ros.logs.log import Event, OdometryEvent
from thinmap_ros.logs.order.clock_jumps import ClockJumpError, stamp_of


def by_stamp(events: Iterable[Event]) -> Iterator[Event]:
    """Put events in the order of their stamps, within `CLOCK_JUMP_NS`.

    Where the stamps of the odometry step back, too, either it came late as well, or the clock
    stepped back: the order in which the odometry is the shorter path is right.
    """
    waiting = _Waiting()
    try:
        for event in events:
            yield from waiting.add(event)
    except ClockJumpError:
        yield from waiting.rest()
        raise
    yield from waiting.rest()


class _Waiting:
    """Events that an earlier one may still follow, in the order of their arrival."""

    def __init__(self) -> None:
        self._events: list[Event] = []
        self._last: list[OdometryEvent] = []  # the one that was passed on last, if any

    def add(self, event: Event) -> Iterator[Event]:
        """Add an event; yields those that none can precede any more."""
        self._events.append(event)
        while stamp_of(event) - min(map(stamp_of, self._events)) > CLOCK_JUMP_NS:
            yield self._pop()

    def rest(self) -> Iterator[Event]:
        """The events that are left, at the end."""
        while self._events:
            yield self._pop()

    def _pop(self) -> Event:
        stamps = [stamp_of(event) for event in self._events]
        index = stamps.index(min(stamps))
        event = self._events.pop(index if index and self._stamps_are_right() else 0)
        if isinstance(event, OdometryEvent):
            self._last = [event]
        return event

    def _stamps_are_right(self) -> bool:
        """Whether the odometry is the shorter path in the order of its stamps, not of arrival."""
        waiting = [event for event in self._events if isinstance(event, OdometryEvent)]
        arrived = [*self._last, *waiting]
        ordered = sorted(arrived, key=stamp_of)
        return ordered == arrived or _path(ordered) < _path(arrived)


def _path(samples: list[OdometryEvent]) -> float:
    """Length of a path with its turns, m + rad."""
    total = 0.0
    for before, after in pairwise(samples):
        x, y, yaw = se2.between(before.T_odom_base, after.T_odom_base).tolist()
        total += math.hypot(x, y) + abs(yaw)
    return total
