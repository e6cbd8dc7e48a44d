"""Exact-time synchronizer of two topics."""

from collections import OrderedDict
from typing import Generic, TypeVar

Left = TypeVar('Left')
Right = TypeVar('Right')


class StampMatcher(Generic[Left, Right]):
    """Pairs the messages of two topics that carry exactly the same stamp, in any order.

    A message without a partner within `capacity` later messages is dropped and counted.
    """

    def __init__(self, capacity: int = 50) -> None:
        self._lefts: OrderedDict[int, Left] = OrderedDict()
        self._rights: OrderedDict[int, Right] = OrderedDict()
        self._capacity = capacity
        self.dropped = 0

    def add_left(self, stamp_ns: int, value: Left) -> tuple[Left, Right] | None:
        """Add a message of the first topic; returns its pair if that is complete."""
        partner = self._rights.pop(stamp_ns, None)
        if partner is not None:
            return value, partner
        self._lefts[stamp_ns] = value
        if len(self._lefts) > self._capacity:
            self._lefts.popitem(last=False)
            self.dropped += 1
        return None

    def add_right(self, stamp_ns: int, value: Right) -> tuple[Left, Right] | None:
        """Add a message of the second topic; returns its pair if that is complete."""
        partner = self._lefts.pop(stamp_ns, None)
        if partner is not None:
            return partner, value
        self._rights[stamp_ns] = value
        if len(self._rights) > self._capacity:
            self._rights.popitem(last=False)
            self.dropped += 1
        return None
