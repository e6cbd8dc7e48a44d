"""Velocity commands on cmd_vel, as Twist or TwistStamped: published and received."""

from collections.abc import Callable

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.diagnostics import WARN, NodeDiagnostics
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.velocity.watchdog import CommandTimeout, CommandWatchdog

TOPIC = 'cmd_vel'
KINDS: dict[str, type] = {
    'geometry_msgs/msg/Twist': Twist,
    'geometry_msgs/msg/TwistStamped': TwistStamped,
}
_CHECK_PERIOD_S = 0.25
_ACKNOWLEDGEMENT = Duration(seconds=1.0)


def declare_stamped(node: Node) -> bool:
    """Declare the parameter `enable_stamped_cmd_vel` and return its value."""
    return bool(
        parameters.declare_parameter(
            node,
            'enable_stamped_cmd_vel',
            False,
            'Type of cmd_vel. true: geometry_msgs/TwistStamped in base_frame, for drivers of '
            'ros2_control and TurtleBot 4 and beside Nav2 from Kilted on. false: '
            'geometry_msgs/Twist, as Nav2 in Jazzy.',
        )
    )


class VelocityPublisher:
    """Publishes velocity commands on cmd_vel, and reports other publishers of it.

    A motion that no other command follows in time is ended with a stop: see `CommandWatchdog`. So
    is one that was commanded before a step of the node failed, at once.
    """

    def __init__(self, node: ThinmapNode, base_frame: str, is_stamped: bool) -> None:
        """base_frame: frame of stamped commands."""
        self._node = node
        self._frame = base_frame
        self._is_stamped = is_stamped
        kind = TwistStamped if is_stamped else Twist
        self._publisher = node.create_publisher(kind, TOPIC, qos.STREAM)
        self._interruption = ''
        self._is_moving = False  # as commanded last
        self._watchdog = CommandWatchdog(
            self._send, self._on_interruption, CommandTimeout(node.elapsed_time.is_simulated)
        )
        # A joystick or Nav2's behaviors may share the topic on purpose.
        node.diagnostics.check_sole_publisher(TOPIC, WARN)
        node.diagnostics.add_check(WARN, lambda: self._interruption)
        node.add_failure_callback(self._on_failure)

    @property
    def is_interrupted(self) -> bool:
        """Whether the watchdog has stopped the robot since the last command."""
        return bool(self._interruption)

    def stop(self) -> None:
        """Publish a stop, the last command, and wait until it is received.

        A publisher that is gone sends nothing.
        """
        self._watchdog.close()
        self.publish(0.0, 0.0)
        self._publisher.wait_for_all_acked(_ACKNOWLEDGEMENT)

    def publish(self, v: float, w: float) -> None:
        """Publish a command: v m/s ahead, w rad/s to the left."""
        self._interruption = ''
        self._is_moving = v != 0.0 or w != 0.0
        self._watchdog.send(v, w)

    def _send(self, v: float, w: float) -> None:
        twist = messages.twist_msg(v, w)
        if not self._is_stamped:
            self._publisher.publish(twist)
            return
        header = messages.header(self._frame, self._node.get_clock().now().nanoseconds)
        self._publisher.publish(TwistStamped(header=header, twist=twist))

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
        self._kind = 'geometry_msgs/msg/Twist'
        self._subscription = self._subscribe()
        diagnostics.expect_topic(topic)
        diagnostics.add_check(WARN, self._other_types)
        wall = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(_CHECK_PERIOD_S, self._follow_publishers, clock=wall)

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
