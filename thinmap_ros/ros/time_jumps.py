"""The clock of the nodes of a process, its jumps, and time for time-outs, which does not jump."""

from collections.abc import Iterator, Sequence
from threading import RLock
from time import monotonic_ns
from typing import Any

from rclpy.clock import Clock, ClockType, JumpThreshold, ROSClock, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node

from thinmap_ros.core.se2 import CLOCK_JUMP_NS
from thinmap_ros.ros.private_rclpy import clock_subscription, share_clock

# Clock of the machine, which nobody sets: for timers.
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
_BACKWARD = JumpThreshold(
    min_forward=None, min_backward=Duration(nanoseconds=-CLOCK_JUMP_NS), on_clock_change=False
)
_ANY = JumpThreshold(
    min_forward=Duration(nanoseconds=CLOCK_JUMP_NS),
    min_backward=Duration(nanoseconds=-CLOCK_JUMP_NS),
    on_clock_change=False,
)


class TimeJumps:
    """Backward jumps of a clock: a bag or a simulation was started again.

    count: of the jumps that were handled.
    """

    def __init__(self, clock: ROSClock) -> None:
        self.count = 0
        self._clock = clock
        self._is_pending = False
        self._before_ns = 0
        self._jump_ns = 0
        self._handle = clock.create_jump_callback(_BACKWARD, post_callback=self._on_jump)

    def pop(self) -> bool:
        """Whether the clock has jumped since the last call."""
        if not self._is_pending:
            return False
        self._is_pending = False
        self.count += 1
        return True

    def is_before(self, stamp_ns: int) -> bool:
        """Whether a stamp belongs to the time just before the last jump."""
        return abs(self._before_ns - stamp_ns) < self._jump_ns // 4

    def _on_jump(self, jump: TimeJump) -> None:
        # Only recorded: the caller, which sets the clock, must not be blocked.
        self._jump_ns = -jump.delta.nanoseconds
        self._before_ns = self._clock.now().nanoseconds + self._jump_ns
        self._is_pending = True  # last: the node has a thread of its own


class ElapsedTime:
    """Time for time-outs and ages, whatever is done to the clock of the node.

    It is the steady clock of the machine; with `use_sim_time` the simulated time without its jumps,
    so that no time elapses while a simulation is paused.
    """

    def __init__(self, clock: ROSClock) -> None:
        self._clock = clock
        self._jumped_ns = 0
        self._jumping = RLock()  # held while the clock jumps
        self._handle = clock.create_jump_callback(
            _ANY, pre_callback=self._jumping.acquire, post_callback=self._on_jump
        )

    @property
    def is_simulated(self) -> bool:
        """Whether the node uses simulated time."""
        return bool(self._clock.ros_time_is_active)

    @property
    def timer_clock(self) -> Clock:
        """Clock of timers; one on the clock of the machine waits for an hour that is set back."""
        return self._clock if self.is_simulated else STEADY

    def now_ns(self) -> int:
        """Time since any moment, ns."""
        if self.is_simulated:
            with self._jumping:
                return int(self._clock.now().nanoseconds) - self._jumped_ns
        return monotonic_ns()

    def now_s(self) -> float:
        """Time since any moment, s."""
        return self.now_ns() / 1e9

    def age_ns(self, stamp_ns: int) -> int:
        """Age of a stamp, ns, but for a constant.

        In simulated time, which jumps together with the stamps, it is exact; a stamp that is
        received before the time that it was made at is new.
        """
        if self.is_simulated:
            return max(int(self._clock.now().nanoseconds) - stamp_ns, 0)
        return monotonic_ns() - stamp_ns

    def _on_jump(self, jump: TimeJump) -> None:
        self._jumped_ns += jump.delta.nanoseconds
        self._jumping.release()


class SharedClock:
    """One subscription of /clock for several nodes, to be spun as if it were a node.

    A thread of its own takes each message: the clock of no node waits for a step of another one.
    """

    timers = guards = clients = services = ()
    executor: Any = None

    def __init__(self, nodes: Sequence[Node]) -> None:
        self.subscriptions = [share_clock(nodes[0], nodes[1:])]
        self.waitables = self.subscriptions[0].event_handlers

    def close(self) -> None:
        """The clocks stand."""
        self.subscriptions[0].destroy()


def shared_clocks(nodes: Sequence[Node]) -> Iterator[SharedClock]:
    """A clock for the nodes of a process that follow the same topic, where there are several."""
    by_topic: dict[str, list[Node]] = {}
    for node in nodes:
        subscription = clock_subscription(node)
        if subscription is not None:
            by_topic.setdefault(subscription.topic_name, []).append(node)
    for followers in by_topic.values():
        if len(followers) > 1:
            yield SharedClock(followers)
