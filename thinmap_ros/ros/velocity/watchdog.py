"""Stops a robot whose next command does not come."""

from collections import deque
from collections.abc import Callable
from statistics import fmean
from threading import Event, Lock, Thread
from time import monotonic

# A command follows every 0.1 s.
_TIMEOUT_S = 0.5
# A simulated robot stands while its clock does; a busy machine must not stop it.
_SIMULATED_TIMEOUT_S = 2.0
_CHECK_PERIOD_S = 0.1
_USUAL_INTERVALS = 10
_INTERVALS = 5.0


class CommandTimeout:
    """Whether a commanded motion has lasted too long without another command; times in s.

    In simulations it is longer, and in slow ones, whose commands are far apart, several usual
    intervals.
    """

    def __init__(self, is_simulated: bool) -> None:
        self._is_simulated = is_simulated
        self._intervals_s: deque[float] = deque(maxlen=_USUAL_INTERVALS)
        self._sent_s: float | None = None  # of the last command, if that was a motion
        self._is_expired = False

    @property
    def limit_s(self) -> float:
        """Longest time without a command."""
        if not self._is_simulated:
            return _TIMEOUT_S
        usual_s = fmean(self._intervals_s) if self._intervals_s else 0.0
        return max(_SIMULATED_TIMEOUT_S, _INTERVALS * usual_s)

    def add(self, is_motion: bool, now_s: float) -> None:
        """Register a command."""
        if self._sent_s is not None:
            self._intervals_s.append(now_s - self._sent_s)
        self._sent_s = now_s if is_motion else None
        self._is_expired = False

    def expires(self, now_s: float) -> bool:
        """Whether the time is over: once for a command."""
        if self._sent_s is None or self._is_expired or now_s - self._sent_s <= self.limit_s:
            return False
        self._is_expired = True
        return True


class CommandWatchdog:
    """Publishes a stop where no command has followed a motion in time.

    It has a thread of its own: timers run neither while the clock of their node stands nor while a
    step of the node takes long.
    """

    def __init__(
        self,
        publish: Callable[[float, float], None],
        on_stop: Callable[[float], None],
        timeout: CommandTimeout,
    ) -> None:
        """publish: called with each command, v (m/s) and w (rad/s), from one thread at a time.

        on_stop: called in the thread after a stop, with the time without a command, s.
        """
        self._publish = publish
        self._on_stop = on_stop
        self._timeout = timeout
        self._lock = Lock()
        self._closed = Event()
        self._thread = Thread(target=self._watch, daemon=True)
        self._thread.start()

    def send(self, v: float, w: float) -> None:
        """Publish a command."""
        with self._lock:
            self._publish(v, w)
            self._timeout.add(v != 0.0 or w != 0.0, monotonic())

    def close(self) -> None:
        """End: nothing is published from now on but by `send`."""
        self._closed.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._closed.wait(_CHECK_PERIOD_S):
            with self._lock:
                is_stopped = self._timeout.expires(monotonic())
                if is_stopped:
                    self._publish(0.0, 0.0)
            if is_stopped:
                self._on_stop(self._timeout.limit_s)
