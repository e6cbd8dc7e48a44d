"""Driving by hand: a velocity holds only while a page asks for it again and again."""

from threading import Lock
from time import monotonic
from typing import NamedTuple

from thinmap_ros.core.errors import InputError
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.velocity import (
    CommandPublisher,
    CommandTimeout,
    CommandWatchdog,
    declare_stamped,
)

# With the period of the watchdog, 0.1 s, the robot is stopped 0.3 s after the last request.
_TIMEOUT_S = 0.2
# After the last command the publisher stays as long as a stop may need to be received.
_LINGER_S = 2.0


class TopSpeeds(NamedTuple):
    """Velocity of a joystick that is pushed to its end: ahead m/s, turn rad/s."""

    ahead: float
    turn: float


class HoldTimeout(CommandTimeout):
    """Whether a velocity is no longer asked for, whatever the clock of the node."""

    def __init__(self) -> None:
        super().__init__(is_simulated=False)

    @property
    def limit_s(self) -> float:
        """Longest time without a request."""
        return _TIMEOUT_S


class Teleoperation:
    """Publishes the velocity that one page at a time asks for.

    The publisher exists while somebody drives, or the robot is held: another one of cmd_vel is
    reported by the navigator.
    """

    def __init__(self, node: ThinmapNode, base_frame: str, top: TopSpeeds) -> None:
        self._top = top
        self._output = CommandPublisher(node, base_frame, declare_stamped(node))
        self._lock = Lock()
        self._sent_s = 0.0
        self._holder: int | None = None
        self._watchdog = CommandWatchdog(self._send, lambda seconds: None, HoldTimeout())

    def take(self, page: int) -> bool:
        """Let a page drive; returns whether it begins to. Raises InputError where another does."""
        with self._lock:
            is_free = self._holder is None or monotonic() - self._sent_s > _LINGER_S
            if not is_free and self._holder != page:
                raise InputError('drive: another page drives: expected it to let go')
            self._holder = page
            self._sent_s = monotonic()
        return is_free

    def let_go(self, page: int) -> None:
        """Stop the robot if this page drives: it is gone."""
        if self._holder == page:
            self.halt()
            self._holder = None

    def drive(self, ahead: float, left: float) -> None:
        """Publish a velocity, as shares of the top speeds; it holds for 0.3 s."""
        self._output.open()
        self._watchdog.send(ahead * self._top.ahead, left * self._top.turn)

    def halt(self) -> None:
        """Stop the robot, if somebody drives; from any thread."""
        self._watchdog.send(0.0, 0.0)

    def keep_standing(self) -> None:
        """Stop the robot, whatever drives it."""
        self._output.hold(True)
        self._watchdog.send(0.0, 0.0)

    def tidy(self) -> None:
        """Destroy the publisher when nobody has driven for a while."""
        self._output.hold(False)
        if monotonic() - self._sent_s > _LINGER_S:
            self._output.close()

    def close(self) -> None:
        """Stop the robot, if somebody drives, and wait until that is received."""
        self._watchdog.close()
        self.halt()
        self._output.wait_until_received()

    def _send(self, v: float, w: float) -> None:
        if self._output.send(v, w):
            self._sent_s = monotonic()
