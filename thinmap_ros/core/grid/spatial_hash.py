"""Places by number, found again near a point without looking at all of them."""

import math


class SpatialHash:
    """Which numbers lie in which square of the plane.

    What is near costs the same however many lie elsewhere.
    """

    def __init__(self, edge_m: float) -> None:
        self._edge_m = edge_m
        self._numbers: dict[tuple[int, int], set[int]] = {}
        self._bucket_of: dict[int, tuple[int, int]] = {}

    def put(self, number: int, x: float, y: float) -> None:
        """Add a number at a point, or move it there, m.

        Near to a point that is not finite is nothing.
        """
        if not (math.isfinite(x) and math.isfinite(y)):
            self.drop(number)
            return
        bucket = (math.floor(x / self._edge_m), math.floor(y / self._edge_m))
        if self._bucket_of.get(number) != bucket:
            self.drop(number)
            self._bucket_of[number] = bucket
            self._numbers.setdefault(bucket, set()).add(number)

    def drop(self, number: int) -> None:
        """Forget a number, if it is known."""
        bucket = self._bucket_of.pop(number, None)
        if bucket is not None:
            self._numbers[bucket].discard(number)
            if not self._numbers[bucket]:
                del self._numbers[bucket]

    def near(self, x: float, y: float, reach_m: float) -> list[int]:
        """All numbers within a reach of a point, m, in order.

        Some that are farther off may be among them.
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
