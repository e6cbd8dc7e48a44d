"""What of a stream did not come: lost on the way, or never sent."""

from collections import deque

_LONGEST_GAP_NS = 5_000_000_000  # whoever says nothing for longer was silent


class Losses:
    """Counts by the numbers that a publisher gives its messages, and by their evenly spaced stamps.

    Either alone is not enough: numbers of two publishers are mixed up, and a sensor that was silent
    has lost nothing.
    """

    def __init__(self) -> None:
        self._last_ns = 0
        self._last_number = 0
        self._steps_ns: deque[int] = deque(maxlen=50)

    def came(self, stamp_ns: int, number: int | None) -> tuple[int, int]:
        """Take note of a message and of its number, None where the middleware gives none.

        Returns how many between it and the last one were lost on the way, and how many more are
        missing: never sent, or without numbers nobody knows.
        """
        step_ns = stamp_ns - self._last_ns
        self._last_ns = stamp_ns
        skipped = (number or 0) - self._last_number - 1
        self._last_number = number or 0
        if step_ns <= 0:
            return 0, 0
        spaces = round(step_ns / min(self._steps_ns, default=step_ns)) - 1
        self._steps_ns.append(step_ns)
        lost = min(max(skipped, 0), max(spaces, 0))
        return lost, spaces - lost if spaces > 0 and step_ns < _LONGEST_GAP_NS else 0
