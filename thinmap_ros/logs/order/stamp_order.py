"""Events of a log in the order of their stamps, where some of them came late."""

import math
from collections.abc import Iterable, Iterator
from itertools import pairwise

from thinmap_ros.core import se2
from thinmap_ros.core.stamps import CLOCK_JUMP_NS
from thinmap_ros.logs.log import Event, OdometryEvent
from thinmap_ros.logs.order.clock_jumps import ClockJumpError, stamp_of


def by_stamp(events: Iterable[Event]) -> Iterator[Event]:
    """Put events in the order of their stamps, within `CLOCK_JUMP_NS`.

    Where the stamps of the odometry step back, too, either it came late as well, or the clock
    stepped back: the order in which the odometry is the shorter path is right.
    """
    waiting: list[Event] = []
    try:
        for event in events:
            waiting.append(event)
            while stamp_of(event) - min(map(stamp_of, waiting)) > CLOCK_JUMP_NS:
                yield _pop(waiting)
    except ClockJumpError:
        yield from _rest(waiting)
        raise
    yield from _rest(waiting)


def _rest(waiting: list[Event]) -> Iterator[Event]:
    while waiting:
        yield _pop(waiting)


def _pop(waiting: list[Event]) -> Event:
    """Remove the event that is next."""
    stamps = [stamp_of(event) for event in waiting]
    index = stamps.index(min(stamps))
    return waiting.pop(index if index and _stamps_are_right(waiting) else 0)


def _stamps_are_right(events: list[Event]) -> bool:
    """Whether the odometry of events in the order of arrival is the shorter path by its stamps."""
    arrived = [event for event in events if isinstance(event, OdometryEvent)]
    ordered = sorted(arrived, key=stamp_of)
    return ordered == arrived or _path(ordered) < _path(arrived)


def _path(samples: list[OdometryEvent]) -> float:
    """Length of a path with its turns, m + rad."""
    total = 0.0
    for before, after in pairwise(samples):
        x, y, yaw = se2.between(before.T_odom_base, after.T_odom_base).tolist()
        total += math.hypot(x, y) + abs(yaw)
    return total
