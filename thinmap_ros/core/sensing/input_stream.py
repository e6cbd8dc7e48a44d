"""Whether the measurements of a source are received often enough, and in time."""

from collections import deque
from statistics import median

from thinmap_ros.core.se2 import SECOND_NS

_USUAL_INTERVALS = 5
_GAP_INTERVALS = 3.0  # a longer silence is no low rate
# Two clocks of machines that are not synchronized drift apart by up to 1e-4.
_DRIFT = 2e-4
# A message may overtake another one. Several before the newest stamp: the clock was set back.
_SET_BACK = 2
# Stamps of one source grow. Two that do not, within so long: the diagnostics look once a second.
_MIXED = 2
_MIXED_NS = 2 * SECOND_NS


class Lateness:
    """How late measurements are received: their age, less its least value before.

    Their clock may be another one than that of the receiver, and may be set: only the change of the
    age counts. Measurements that are late from the first one on cannot be told from another clock.
    late_ns: of the last measurement.
    """

    def __init__(self, limit_ns: int) -> None:
        """limit_ns: up to which the clocks may drift."""
        self.late_ns = 0
        self._limit_ns = limit_ns
        self._least_age_ns: float | None = None
        self._newest_ns = 0
        self._set_back = 0
        self._received_ns = 0

    def add(self, stamp_ns: int, received_ns: int, age_ns: int) -> None:
        """Add a measurement; age_ns: its age when it was received, but for a constant."""
        least_ns = self._least_age_ns
        self._set_back = self._set_back + 1 if stamp_ns < self._newest_ns else 0
        if least_ns is None or self._set_back >= _SET_BACK:
            least_ns = age_ns
            self._newest_ns = stamp_ns
            self._set_back = 0
        elif self.late_ns <= self._limit_ns:
            # Not while it is late: a lasting delay must not become the usual one.
            least_ns += _DRIFT * max(received_ns - self._received_ns, 0)
        self._least_age_ns = min(least_ns, age_ns)
        self.late_ns = round(age_ns - self._least_age_ns)
        self._newest_ns = max(stamp_ns, self._newest_ns)
        self._received_ns = received_ns


class InputStream:
    """The measurements of a source, which a robot needs at least every timeout_ns."""

    def __init__(self, name: str, timeout_ns: int, late_limit_ns: int) -> None:
        """name: in faults. late_limit_ns: how late a measurement may be received."""
        self._name = name
        self._timeout_ns = timeout_ns
        self._late_limit_ns = late_limit_ns
        self._lateness = Lateness(late_limit_ns)
        self._received_ns: int | None = None
        self._stamp_ns: int | None = None
        self._repeated_ns: deque[int] = deque(maxlen=_MIXED)
        self._intervals_ns: deque[int] = deque(maxlen=_USUAL_INTERVALS)

    def add(self, stamp_ns: int, received_ns: int, age_ns: int) -> None:
        """Add a measurement: time at which it was received, and its age then, but for a constant.

        The time is one that does not jump.
        """
        if self._received_ns is not None:
            self._intervals_ns.append(received_ns - self._received_ns)
        self._received_ns = received_ns
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            self._repeated_ns.append(received_ns)
        self._stamp_ns = stamp_ns
        self._lateness.add(stamp_ns, received_ns, age_ns)

    def is_mixed(self, now_ns: int) -> bool:
        """Whether stamps did not grow lately: two sources measure at once."""
        times_ns = self._repeated_ns
        return len(times_ns) == _MIXED and now_ns - times_ns[0] <= _MIXED_NS

    def fault(self, now_ns: int) -> str:
        """Why the robot cannot rely on the measurements; '' for no reason, and before the first."""
        if self._received_ns is None:
            return ''
        silent_ns = now_ns - self._received_ns
        usual_ns = median(self._intervals_ns) if self._is_rate_known() else 0.0
        is_slow = usual_ns > self._timeout_ns
        if is_slow and silent_ns <= _GAP_INTERVALS * usual_ns:
            expected_hz = SECOND_NS / self._timeout_ns
            rate_hz = SECOND_NS / usual_ns
            return f'{self._name} at {rate_hz:.1f} Hz: expected at least {expected_hz:.1f} Hz'
        if silent_ns > self._timeout_ns:
            return f'{self._name} silent for {silent_ns / SECOND_NS:.1f} s'
        late_ns = self._lateness.late_ns
        if late_ns > self._late_limit_ns:
            expected_s = self._late_limit_ns / SECOND_NS
            late_s = late_ns / SECOND_NS
            return f'{self._name} {late_s:.1f} s late: expected at most {expected_s:.1f} s'
        return ''

    def _is_rate_known(self) -> bool:
        return len(self._intervals_ns) == _USUAL_INTERVALS
