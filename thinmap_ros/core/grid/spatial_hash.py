"""Spatial hash: finds the points near a point, by number."""

import math


class SpatialHash:
    """Numbers by square of the plane.

    The time of a query does not depend on the number of points elsewhere.
    """

    def __init__(self, edge_m: float) -> None:
        self._edge_m = edge_m
        self._numbers: dict[tuple[int, int], set[int]] = {}
        self._bucket_of: dict[int, tuple[int, int]] = {}

    def insert(self, number: int, x: float, y: float) -> None:
        """Add a number at a point, or move it there, m.

        A point that is not finite removes the number.
        """
        if not (math.isfinite(x) and math.isfinite(y)):
            self.remove(number)
            return
        bucket = (math.floor(x / self._edge_m), math.floor(y / self._edge_m))
        if self._bucket_of.get(number) != bucket:
            self.remove(number)
            self._bucket_of[number] = bucket
            self._numbers.setdefault(bucket, set()).add(number)

    def remove(self, number: int) -> None:
        """Remove a number, if present."""
        bucket = self._bucket_of.pop(number, None)
        if bucket is not None:
            self._numbers[bucket].discard(number)
            if not self._numbers[bucket]:
                del self._numbers[bucket]

    def query_radius(self, x: float, y: float, reach_m: float) -> list[int]:
        """All numbers within reach_m of a point, m, sorted.

        Some more distant ones may be among them.
        """
        if not (math.isfinite(x) and math.isfinite(y)):
            return []
        low_col, high_col = (
            math.floor((x + reach) / self._edge_m) for reach in (-reach_m, reach_m)
        )
        low_row, high_row = (
            math.floor((y + reach) / self._edge_m) for reach in (-reach_m, reach_m)
        )
        found: list[int] = []
        for col in range(low_col, high_col + 1):
            for row in range(low_row, high_row + 1):
                found.extend(self._numbers.get((col, row), ()))
        return sorted(found)
