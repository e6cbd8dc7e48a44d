"""Places that could not be reached.

They are put aside, tried again after a while and before the end, forgotten in time.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

Place = tuple[float, float]
_SAME_PLACE_M = 1.0
_TRIES = 3
_PAUSE_S = 5.0
_FADE = 10.0


@dataclass
class _Failure:
    at: Place
    stamp_ns: int
    times: int = 0


class Failures:
    """What failed at about which place (x, y), m: ids of nodes come and go, places stay."""

    def __init__(self, blacklist_timeout_s: float) -> None:
        self._retry_ns = blacklist_timeout_s * 1e9
        self._failures: list[_Failure] = []

    def add(self, place: Place, stamp_ns: int) -> None:
        """Note a failure at a place."""
        failure = self._at(place)
        if failure is None:
            failure = _Failure(place, stamp_ns)
            self._failures.append(failure)
        failure.times = failure.times + 1
        failure.stamp_ns = stamp_ns

    def has(self, place: Place) -> bool:
        """Whether something failed at about this place."""
        return self._at(place) is not None

    def may_try_again(self, place: Place) -> bool:
        """Whether something failed there, but not too often to be tried again before the end."""
        failure = self._at(place)
        return failure is not None and failure.times < _TRIES

    def to_try(self, places: Mapping[int, Place], stamp_ns: int) -> set[int]:
        """Ids of the places where nothing failed, or a while ago.

        Else, before the end, of those that failed least. The latter after a pause: a door may be
        free by then. What failed too often is tried no more, unless so much else is left to do that
        the failure fades from memory.
        """
        first = self._left(places, stamp_ns, self._retry_ns)
        if not first:
            return self._left(places, stamp_ns, _PAUSE_S * 1e9)
        self._failures = [
            f for f in self._failures if stamp_ns - f.stamp_ns < _FADE * self._retry_ns
        ]
        return first

    def _left(self, places: Mapping[int, Place], stamp_ns: int, pause_ns: float) -> set[int]:
        left = set()
        for node_id, place in places.items():
            failure = self._at(place)
            if failure is None or (
                failure.times < _TRIES and stamp_ns - failure.stamp_ns > pause_ns
            ):
                left.add(node_id)
        return left

    def _at(self, place: Place) -> _Failure | None:
        if not self._failures:
            return None
        near = min(self._failures, key=lambda f: math.dist(f.at, place), default=None)
        return near if near and math.dist(near.at, place) <= _SAME_PLACE_M else None
