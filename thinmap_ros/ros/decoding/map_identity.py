"""Which map a pose, a grid or a graph belongs to: ids that the localizer gives out.

A localizer gives its map an id when it begins or loads one, and says which one a reset has
replaced. The id 0 is that of a map whose localizer has none, such as another package's.
"""

import time
from enum import Enum

UNKNOWN = 0


def new_map_id() -> int:
    """An id that no other map has."""
    return time.time_ns()


class Origin(Enum):
    """Which map a message is of: the one that is followed, the previous one, or another."""

    SAME = 0
    STALE = 1
    OTHER = 2


class FollowedMap:
    """The id of the map that a node has, learned from messages."""

    def __init__(self, map_id: int = UNKNOWN) -> None:
        self.id = map_id
        self._left = UNKNOWN

    def leave(self) -> None:
        """The node has loaded another map: its id is that of the next message."""
        self._left = self.id or self._left
        self.id = UNKNOWN

    def origin(self, map_id: int) -> Origin:
        """Origin of a message with an id; a node without a map follows the first that it hears."""
        if map_id in (UNKNOWN, self.id):
            return Origin.SAME
        if map_id == self._left:
            return Origin.STALE
        if self.id == UNKNOWN:
            self.id = map_id
            return Origin.SAME
        return Origin.OTHER
