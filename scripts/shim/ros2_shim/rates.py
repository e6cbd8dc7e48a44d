"""Rate of received messages."""

import statistics
from collections import deque


class Rates:
    """Mean rate and standard deviation over a window of messages, reported once per second."""

    def __init__(self, window: int) -> None:
        self._gaps_s: deque[float] = deque(maxlen=window)
        self._last_s: float | None = None
        self._told_s: float | None = None

    def heard(self, now_s: float) -> str | None:
        """Add a message received at a time (s); returns a report of two lines if one is due."""
        if self._last_s is not None:
            self._gaps_s.append(now_s - self._last_s)
        self._last_s = now_s
        if self._told_s is None:
            self._told_s = now_s
        if not self._gaps_s or now_s < self._told_s + 1.0:
            return None
        self._told_s = now_s
        return self._told()

    def _told(self) -> str:
        mean = statistics.fmean(self._gaps_s)
        rate = 1.0 / mean if mean > 0.0 else 0.0
        return (
            f'average rate: {rate:.3f}\n\tmin: {min(self._gaps_s):.3f}s '
            f'max: {max(self._gaps_s):.3f}s std dev: {statistics.pstdev(self._gaps_s):.5f}s '
            f'window: {len(self._gaps_s)}'
        )
