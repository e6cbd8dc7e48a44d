"""Velocity commands on cmd_vel, as Twist or TwistStamped: published and received."""

import math
from collections import deque
from collections.abc import Callable
from statistics import fmean
from threading import Event, Lock, Thread
from time import monotonic

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from thinmap_ros.ros import messages, parameters, qos, stop_topic
from thinmap_ros.ros.diagnostics import (
    ERROR,
    WARN,
    NodeDiagnostics,
    full_name,
    publisher_names,
    subscriber_names,
)
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.private_rclpy import RCLError
from thinmap_ros.ros.time_jumps import STEADY

# A command follows every 0.1 s.
_TIMEOUT_S = 0.5
# A simulated robot stands while its clock does; a busy machine must not stop it.
_SIMULATED_TIMEOUT_S = 2.0
_WATCH_PERIOD_S = 0.1
_USUAL_INTERVALS = 10
_INTERVALS = 5.0


class CommandTimeout:
    """Whether a commanded motion has lasted too long without another command; times in s.

    In simulations it is longer, and in slow ones, whose commands are far apart, several usual
    intervals.
    """

    def __init__(self, is_simulated: bool, limit_s: float = _TIMEOUT_S) -> None:
        """limit_s: where the time is that of the machine."""
        self._is_simulated = is_simulated
        self._least_s = _SIMULATED_TIMEOUT_S if is_simulated else limit_s
        self._intervals_s: deque[float] = deque(maxlen=_USUAL_INTERVALS)
        self._sent_s: float | None = None  # of the last command, if that was a motion
        self._is_expired = False

    @property
    def limit_s(self) -> float:
        """Longest time without a command."""
        usual_s = fmean(self._intervals_s) if self._is_simulated and self._intervals_s else 0.0
        return max(self._least_s, _INTERVALS * usual_s)

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
        publish: Callable[[float, float], object],
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
        self._is_moving = Event()
        self._thread = Thread(target=self._watch, daemon=True)
        self._thread.start()

    def send(self, v: float, w: float) -> None:
        """Publish a command."""
        with self._lock:
            self._publish(v, w)
            is_motion = v != 0.0 or w != 0.0
            self._timeout.add(is_motion, monotonic())
            self._wake(is_motion)

    def close(self) -> None:
        """End: nothing is published from now on but by `send`."""
        with self._lock:
            self._closed.set()
            self._wake(True)
        self._thread.join()

    def _wake(self, is_moving: bool) -> None:
        """Have the thread look while the robot moves; a closed one is to end."""
        if is_moving or self._closed.is_set():
            self._is_moving.set()
        else:
            self._is_moving.clear()

    def _watch(self) -> None:
        while self._is_moving.wait() and not self._closed.wait(_WATCH_PERIOD_S):
            with self._lock:
                is_stopped = self._timeout.expires(monotonic())
                if is_stopped:
                    self._publish(0.0, 0.0)
                    self._wake(False)
            if is_stopped:
                self._on_stop(self._timeout.limit_s)


TOPIC = 'cmd_vel'
UNSTAMPED = 'geometry_msgs/msg/Twist'
STAMPED = 'geometry_msgs/msg/TwistStamped'
KINDS: dict[str, type] = {UNSTAMPED: Twist, STAMPED: TwistStamped}
_CHECK_PERIOD_S = 0.25
# Checks, one a second, after which the type changes: a subscriber that follows the type of the
# publishers, as the simulated robot, is given the time to do so.
_MISMATCHES = 2
_ECHO_S = 0.5  # after a robot is held, motions from before are still received
_REPORT_S = 2.0  # a report stays so long: diagnostics look once a second
_ACKNOWLEDGEMENT = Duration(seconds=1.0)


def declare_stamped(node: Node) -> bool:
    """Declare the parameter `enable_stamped_cmd_vel` and return its value."""
    return bool(
        parameters.declare_parameter(
            node,
            'enable_stamped_cmd_vel',
            False,
            'Type of cmd_vel while nobody subscribes to it, or to both types. Otherwise it is the '
            'type of the subscriptions. true: geometry_msgs/TwistStamped in base_frame, as drivers '
            'of ros2_control and TurtleBot 4, and Nav2 from Kilted on. false: geometry_msgs/Twist, '
            'as Nav2 in Jazzy.',
        )
    )


def base_subscriptions(node: Node) -> list[TopicEndpointInfo]:
    """Subscriptions to cmd_vel, but of nodes that publish it: they look at each other."""
    name = node.resolve_topic_name(TOPIC)
    drivers = publisher_names(node, name)
    found = node.get_subscriptions_info_by_topic(name)
    return [info for info in found if full_name(info) not in drivers]


class CommandPublisher:
    """Publishes velocities on cmd_vel, in the type that the base subscribes to.

    DDS allows a process one type for each topic, so the publisher is created again when the base
    turns out to have the other one. While the robot is held, each motion that another publisher
    commands is answered with a zero.
    """

    def __init__(self, node: ThinmapNode, base_frame: str, is_stamped: bool) -> None:
        """base_frame: frame of stamped commands; is_stamped: type while nobody subscribes."""
        self._node = node
        self._frame = base_frame
        self._preferred = STAMPED if is_stamped else UNSTAMPED
        self._kind = self._preferred
        self._lock = Lock()
        self._is_wanted = False
        self._publisher: Publisher | None = None
        self._guard: Subscription | None = None
        self._mismatches = 0
        self._held_s = math.inf
        self._answered_s = -math.inf
        node.diagnostics.add_check(ERROR, self._fault)
        node.diagnostics.add_update_callback(self._follow_base)

    def open(self) -> None:
        """Create the publisher, at once or as soon as that is possible; in the node's thread."""
        self._is_wanted = True
        if self._publisher is not None:
            return
        wanted = self._wanted_kind()
        others = [] if base_subscriptions(self._node) else list(KINDS.keys() - {wanted})
        for kind in (wanted, *others):
            try:
                publisher = self._node.create_publisher(KINDS[kind], TOPIC, qos.STREAM)
            except RCLError:
                continue  # of another node in this process, the other type
            with self._lock:
                self._kind = kind
                self._publisher = publisher
            return

    def close(self) -> None:
        """Destroy the publisher; in the node's thread."""
        self._is_wanted = False
        self._destroy()

    def send(self, v: float, w: float) -> bool:
        """Publish a velocity, m/s and rad/s; from any thread. Returns False without a publisher."""
        twist = messages.twist_msg(v, w)
        with self._lock:
            if self._publisher is None:
                return False
            if self._kind == UNSTAMPED:
                self._publisher.publish(twist)
            else:
                header = messages.header(self._frame, self._node.now_ns)
                self._publisher.publish(TwistStamped(header=header, twist=twist))
            return True

    def wait_until_received(self) -> None:
        """Wait until all subscribers have received what was sent, at most for a second."""
        with self._lock:
            if self._publisher is not None:
                self._publisher.wait_for_all_acked(_ACKNOWLEDGEMENT)

    def hold(self, is_held: bool) -> None:
        """Whether the robot is held: motions that others command are answered."""
        if not is_held:
            self._held_s = math.inf
            self._end_guard()
            return
        self._held_s = min(self._held_s, monotonic())
        self.open()
        if self._guard is None and self._publisher is not None:
            self._guard = self._node.create_subscription(
                KINDS[self._kind], TOPIC, self._on_command, qos.SENSOR
            )

    def _on_command(self, message: Twist | TwistStamped) -> None:
        twist = message.twist if isinstance(message, TwistStamped) else message
        if twist == Twist():
            return
        self.send(0.0, 0.0)
        if monotonic() - self._held_s > _ECHO_S:
            self._answered_s = monotonic()

    def _destroy(self) -> None:
        self._end_guard()
        with self._lock:
            if self._publisher is not None:
                self._node.destroy_publisher(self._publisher)
                self._publisher = None

    def _end_guard(self) -> None:
        if self._guard is not None:
            self._node.destroy_subscription(self._guard)
            self._guard = None

    def _wanted_kind(self) -> str:
        kinds = {info.topic_type for info in base_subscriptions(self._node)}.intersection(KINDS)
        return self._preferred if not kinds or self._preferred in kinds else kinds.pop()

    def _follow_base(self) -> None:
        """Change to the type of the base, if it has had the other one for some time."""
        if not self._is_wanted:
            return
        is_other = self._kind != self._wanted_kind() and bool(base_subscriptions(self._node))
        self._mismatches = self._mismatches + 1 if is_other else 0
        if self._publisher is not None and self._mismatches >= _MISMATCHES:
            self._destroy()
        if self._publisher is None:
            self.open()
            self._node.get_logger().info(f'{TOPIC}: published as {self._kind}')
            if self._held_s < math.inf:
                self.hold(True)

    def _fault(self) -> str:
        """Why commands are not received, or who drives a robot that is held; '' for nothing."""
        if self._is_wanted and self._publisher is None:
            return (
                f'{TOPIC}: not published: subscribed to as {self._wanted_kind()}, and another node '
                'of this process uses the other type'
            )
        if monotonic() - self._answered_s > _REPORT_S:
            return ''
        name = self._node.resolve_topic_name(TOPIC)
        obeying = subscriber_names(self._node, self._node.resolve_topic_name(stop_topic.TOPIC))
        obeying = [*obeying, self._node.get_fully_qualified_name()]
        names = sorted(set(publisher_names(self._node, name)) - set(obeying))
        if not names:
            return ''
        return (
            f'{", ".join(names)} drives the stopped robot: {name} has several '
            'publishers: expected a multiplexer, which alone can hold it (twist_mux)'
        )


class VelocityPublisher:
    """Publishes velocity commands on cmd_vel, and reports other publishers of it.

    A motion that no other command follows in time is ended with a stop: see `CommandWatchdog`. So
    is one that was commanded before a step of the node failed, at once.
    """

    def __init__(self, node: ThinmapNode, base_frame: str, is_stamped: bool) -> None:
        """base_frame: frame of stamped commands; is_stamped: type while nobody subscribes."""
        self._node = node
        self._output = CommandPublisher(node, base_frame, is_stamped)
        self._output.open()
        self._interruption = ''
        self._is_moving = False  # as commanded last
        self._watchdog = CommandWatchdog(
            self._output.send, self._on_interruption, CommandTimeout(node.elapsed_time.is_simulated)
        )
        # A joystick or Nav2's behaviors may share the topic on purpose. A page ends what drives
        # before it publishes, as it publishes the stop.
        node.diagnostics.check_sole_publisher(TOPIC, WARN, partners=stop_topic.TOPIC)
        node.diagnostics.add_check(WARN, lambda: self._interruption)
        node.add_failure_callback(self._on_failure)

    @property
    def is_interrupted(self) -> bool:
        """Whether the watchdog has stopped the robot since the last command."""
        return bool(self._interruption)

    def hold(self, is_held: bool) -> None:
        """Whether the robot is held: motions that others command are answered with a zero."""
        self._output.hold(is_held)

    def stop(self) -> None:
        """Publish a stop, the last command, and wait until it is received.

        A publisher that is gone sends nothing.
        """
        self._watchdog.close()
        self.publish(0.0, 0.0)
        self._output.wait_until_received()

    def publish(self, v: float, w: float) -> None:
        """Publish a command: v m/s ahead, w rad/s to the left."""
        self._interruption = ''
        self._is_moving = v != 0.0 or w != 0.0
        self._watchdog.send(v, w)

    def _on_failure(self) -> None:
        """Stand until the next command, which begins at rest."""
        if self._is_moving:
            self.publish(0.0, 0.0)
            self._interruption = 'a step failed: stopped'

    def _on_interruption(self, seconds: float) -> None:
        paused = 'the simulation is paused, or ' if self._node.elapsed_time.is_simulated else ''
        self._interruption = (
            f'no command for {seconds:.1f} s: stopped: {paused}a step takes too long'
        )
        self._node.get_logger().warning(self._interruption)


class VelocitySubscription:
    """Receives the commands on cmd_vel in the type in which they are published.

    DDS allows a process one type for each topic, so the subscription is created again when all
    publishers have the other type.
    """

    def __init__(
        self,
        node: Node,
        diagnostics: NodeDiagnostics,
        on_command: Callable[[float, float], None],
        topic: str = TOPIC,
    ) -> None:
        """on_command: receives v (m/s) and w (rad/s), unchecked; topic: name, of several robots."""
        self._node = node
        self._topic = topic
        self._diagnostics = diagnostics
        self._on_command = on_command
        # A publisher in this process has decided the type.
        self._kind = min(self._published_types().intersection(KINDS), default=UNSTAMPED)
        self._subscription = self._subscribe()
        diagnostics.expect_topic(topic)
        diagnostics.add_check(WARN, self._other_types)
        node.create_timer(_CHECK_PERIOD_S, self._follow_publishers, clock=STEADY)

    def _subscribe(self) -> object:
        return self._node.create_subscription(
            KINDS[self._kind], self._topic, self._on_message, qos.STREAM
        )

    def _on_message(self, message: Twist | TwistStamped) -> None:
        self._diagnostics.message_received(self._topic)
        twist = message.twist if isinstance(message, TwistStamped) else message
        self._on_command(twist.linear.x, twist.angular.z)

    def _published_types(self) -> set[str]:
        name = self._node.resolve_topic_name(self._topic)
        return {info.topic_type for info in self._node.get_publishers_info_by_topic(name)}

    def _follow_publishers(self) -> None:
        published = self._published_types().intersection(KINDS)
        if not published or self._kind in published:
            return
        self._node.destroy_subscription(self._subscription)
        self._kind = published.pop()
        self._subscription = self._subscribe()

    def _other_types(self) -> str:
        others = sorted(self._published_types() - {self._kind})
        if not others:
            return ''
        return f'{self._topic}: ignored publishers of {", ".join(others)}: expected {self._kind}'
