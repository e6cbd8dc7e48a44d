"""Whether a base stops by itself when its commands end: tried on the robot, with a slow turn."""

import time
from collections.abc import Callable

import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.diagnostics import publisher_names
from thinmap_ros.ros.robot_check import Finding
from thinmap_ros.ros.velocity import KINDS, TOPIC

TURN_RAD_S = 0.3
_PERIOD_S = 0.1
_COMMANDED_S = 2.0
_STOPS = 10  # at the end
# A base that turns on after so long has no time-out that helps: at 0.5 m/s it drives a metre.
WATCHED_S = 2.0
# A turn rate is a mean over so long: noise of 0.01 rad is then a fifth of what counts as turning.
_LOOK_S = 0.5
_TURNS_RAD_S = 0.1
# Odometry that takes so many times longer than its stamps is silent.
_PATIENCE = 5.0
_WHAT = 'watchdog of the base'


def try_watchdog(odom_topic: str, base_frame: str) -> Finding:
    """Turn the robot slowly, end the commands without a stop, and look whether it stands.

    Raises InputError where it cannot be tried: no base or odometry, or somebody else drives.
    """
    rclpy.init()
    node = rclpy.create_node('doctor')
    try:
        return BaseTrial(node, odom_topic, base_frame).finding()
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


class BaseTrial:
    """Drives the base of a robot, and receives its odometry, whose stamps are the time."""

    def __init__(self, node: Node, odom_topic: str, base_frame: str) -> None:
        self._node = node
        self._odom_topic = odom_topic
        self._frame = base_frame
        self._yaws: list[tuple[float, float]] = []  # stamp, s, and yaw, rad
        node.create_subscription(Odometry, odom_topic, self._on_odometry, qos.SENSOR)

    def finding(self) -> Finding:
        """Try it; the robot is commanded to stand at the end, whatever happens."""
        if self._turn_rate_after(2.0 * _LOOK_S) > _TURNS_RAD_S:
            raise InputError('the robot turns: expected one that stands')
        kind = self._require_free_base()
        publisher = self._node.create_publisher(kind, TOPIC, qos.STREAM)

        def command(w: float) -> None:
            twist = messages.twist_msg(0.0, w)
            header = messages.header(self._frame, self._node.get_clock().now().nanoseconds)
            is_stamped = kind is TwistStamped
            publisher.publish(TwistStamped(header=header, twist=twist) if is_stamped else twist)

        try:
            rate = self._turn_rate_after(_COMMANDED_S, lambda: command(TURN_RAD_S))
            if rate < _TURNS_RAD_S:
                seen = f'told to turn at {TURN_RAD_S:g} rad/s, it does not: not tried'
                return Finding(_WHAT, False, seen, 'emergency stop, motors off, or cmd_vel unused?')
            rate = self._turn_rate_after(WATCHED_S)
        finally:
            for _ in range(_STOPS):
                command(0.0)
                self._spin()
        if rate < _TURNS_RAD_S:
            return Finding(_WHAT, True, f'stands within {WATCHED_S:g} s after the last command')
        seen = f'turns on at {rate:.2f} rad/s {WATCHED_S:g} s after the last command'
        advice = (
            'a program that dies leaves the robot driving: set the time-out of the driver '
            '(ros2_control: cmd_vel_timeout), or put a multiplexer with one before it'
        )
        return Finding(_WHAT, False, seen, advice)

    def _require_free_base(self) -> type:
        """Type of the commands of the base. Raises InputError without one, or with a driver."""
        name = self._node.resolve_topic_name(TOPIC)
        drivers = publisher_names(self._node, name)
        if drivers:
            raise InputError(f'{name}: published by {", ".join(drivers)}: end it first')
        infos = self._node.get_subscriptions_info_by_topic(name)
        kinds = sorted({info.topic_type for info in infos} & set(KINDS))
        if not kinds:
            raise InputError(f'{name}: nobody subscribes: expected the driver of the base')
        return KINDS[kinds[0]]

    def _on_odometry(self, message: Odometry) -> None:
        yaw = float(messages.pose_from_msg(message.pose.pose)[2])
        self._yaws.append((messages.stamp_ns(message.header.stamp) / SECOND_NS, yaw))

    def _turn_rate_after(self, seconds: float, work: Callable[[], None] = lambda: None) -> float:
        """Call `work` periodically for so long; turn rate at the end, rad/s, without its sign.

        Raises InputError where the odometry is silent.
        """
        begun_s = self._yaws[-1][0] if self._yaws else None
        end = time.monotonic() + _PATIENCE * seconds
        while begun_s is None or self._yaws[-1][0] - begun_s < seconds:
            work()
            self._spin()
            if begun_s is None and self._yaws:
                begun_s = self._yaws[0][0]
            if time.monotonic() > end:
                raise InputError(f'{self._odom_topic}: silent: expected the odometry of the base')
        now_s, yaw = self._yaws[-1]
        then_s, before = [each for each in self._yaws if each[0] <= now_s - _LOOK_S][-1]
        return abs(se2.wrap(yaw - before)) / (now_s - then_s)

    def _spin(self) -> None:
        end = time.monotonic() + _PERIOD_S
        while (left := end - time.monotonic()) > 0.0:
            rclpy.spin_once(self._node, timeout_sec=left)
