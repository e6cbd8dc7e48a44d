"""The topics of a simulated robot: its sensors and true pose out, commands in."""

from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import LaserScan
from std_msgs.msg import UInt32
from tf2_msgs.msg import TFMessage

from thinmap_ros.core.errors import InputError
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.diagnostics import NodeDiagnostics
from thinmap_ros.ros.velocity import TOPIC as COMMANDS
from thinmap_ros.ros.velocity import VelocitySubscription
from thinmap_ros.sim.simulation import SensorReadings, Simulation

_COMMAND_TIMEOUT_NS = 500_000_000


class _Publishers:
    """Publishes what a simulated robot senses, and the ground truth."""

    def __init__(self, node: Node, prefix: str, scan_time_s: float, publish_tf: bool) -> None:
        """prefix: of the topics of one of several robots, with a slash; ''.

        scan_time_s: time between two scans. publish_tf: also publish the transforms.
        """
        self._scan_time_s = scan_time_s
        self._scan = node.create_publisher(LaserScan, f'{prefix}scan', qos.STREAM)
        self._odom = node.create_publisher(Odometry, f'{prefix}odom', qos.STREAM)
        self._truth = node.create_publisher(PoseStamped, f'{prefix}ground_truth', qos.STREAM)
        self._collisions = node.create_publisher(UInt32, f'{prefix}collisions', qos.LATCHED)
        # Frames of several robots have the same names: each robot has transforms of its own.
        below = prefix or '/'
        self._tf = node.create_publisher(TFMessage, f'{below}tf', qos.STREAM)
        self._tf_static = node.create_publisher(
            TFMessage, f'{below}tf_static', qos.STATIC_TRANSFORMS
        )
        self._publish_tf = publish_tf
        self._last_collisions = -1
        self._last_scan: LaserScan | None = None

    def publish_laser_pose(self, simulation: Simulation) -> None:
        if self._publish_tf:
            T_base_laser = simulation.laser.T_base_laser
            transform = messages.transform_msg(T_base_laser, 'base_link', 'laser', 0)
            self._tf_static.publish(TFMessage(transforms=[transform]))

    def publish(self, moment: SensorReadings, simulation: Simulation) -> None:
        """Publish a moment; the scan, if there is one, comes last."""
        robot = simulation.robot
        self._publish_odometry(moment, simulation)
        truth = messages.pose_stamped_msg(robot.T_world_base, 'world', moment.stamp_ns)
        self._truth.publish(truth)
        if robot.collisions != self._last_collisions:
            self._last_collisions = robot.collisions
            self._collisions.publish(UInt32(data=robot.collisions))
        if moment.scan is not None:
            self._last_scan = messages.scan_msg(moment.scan, 'laser', self._scan_time_s)
            self._scan.publish(self._last_scan)

    def repeat_scan(self, simulation: Simulation) -> None:
        """Publish the last scan again, with the present odometry."""
        if self._last_scan is not None:
            self._scan.publish(self._last_scan)
            self._publish_odometry(simulation.read_sensors(), simulation)

    def _publish_odometry(self, moment: SensorReadings, simulation: Simulation) -> None:
        velocity = (simulation.robot.v, simulation.robot.w)
        frames = ('odom', 'base_link')
        self._odom.publish(
            messages.odometry_msg(moment.T_odom_base, velocity, frames, moment.stamp_ns)
        )
        if self._publish_tf:
            transform = messages.transform_msg(moment.T_odom_base, *frames, moment.stamp_ns)
            self._tf.publish(TFMessage(transforms=[transform]))


@dataclass(frozen=True)
class _VelocityCommand:
    """A velocity command, m/s and rad/s, with the time at which it was received."""

    v: float = 0.0
    w: float = 0.0
    received_ns: int = 0

    def at(self, now_ns: int) -> tuple[float, float]:
        """The velocity at a time; as a robot's controller, it stops without a recent command."""
        is_recent = now_ns - self.received_ns <= _COMMAND_TIMEOUT_NS
        return (self.v, self.w) if is_recent else (0.0, 0.0)


class RobotInterface:
    """A simulated robot on the graph; its topics begin with a prefix, '' or 'robot1/'."""

    def __init__(
        self,
        node: Node,
        prefix: str,
        simulation: Simulation,
        diagnostics: NodeDiagnostics,
        publish_tf: bool,
    ) -> None:
        """publish_tf: whether odom -> base_link and base_link -> laser are published."""
        scan_time_s = 1.0 / simulation.laser.config.scan_rate_hz
        self._node = node
        self._prefix = prefix
        self._simulation = simulation
        self._diagnostics = diagnostics
        self._output = _Publishers(node, prefix, scan_time_s, publish_tf)
        self._command = _VelocityCommand()
        VelocitySubscription(node, diagnostics, self._on_command, f'{prefix}{COMMANDS}')
        self._teleports = f'~/{prefix}set_pose'
        node.create_subscription(PoseStamped, self._teleports, self._on_teleport, qos.STREAM)
        self._output.publish_laser_pose(simulation)

    @property
    def scan_subscribers(self) -> int:
        """Number of subscribers of the scans."""
        return int(self._node.count_subscribers(f'{self._prefix}scan'))

    def move(self) -> None:
        """Drive for one step as commanded."""
        self._simulation.move(*self._command.at(self._simulation.stamp_ns))

    def publish(self) -> bool:
        """Publish the present sensor readings; returns whether there was a scan."""
        moment = self._simulation.read_sensors()
        self._output.publish(moment, self._simulation)
        return moment.scan is not None

    def repeat_scan(self) -> None:
        """Publish the last scan again."""
        self._output.repeat_scan(self._simulation)

    def _on_command(self, v: float, w: float) -> None:
        if not np.isfinite((v, w)).all():
            reason = f'command {(v, w)}: expected finite numbers'
            self._diagnostics.message_rejected(f'{self._prefix}{COMMANDS}', reason)
            return
        self._command = _VelocityCommand(v, w, self._simulation.stamp_ns)

    def _on_teleport(self, message: PoseStamped) -> None:
        """Teleport the robot, for kidnapping tests: the odometry does not change."""
        self._diagnostics.message_received(self._teleports)
        try:
            self._simulation.teleport(messages.pose_from_msg(message.pose))
        except InputError as error:
            self._diagnostics.message_rejected(self._teleports, str(error))
