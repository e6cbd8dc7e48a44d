"""A simulated robot: /cmd_vel in; /scan, /odom, /tf, /clock and the true pose out.

Commands are Twist or TwistStamped, as their publishers choose. ~/set_pose teleports the robot.
"""

from dataclasses import dataclass
from time import monotonic

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMsg
from sensor_msgs.msg import LaserScan
from std_msgs.msg import UInt32
from tf2_msgs.msg import TFMessage

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError, InputError, quoted
from thinmap_ros.core.se2 import Array
from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.diagnostics import OK, WARN, NodeDiagnostics
from thinmap_ros.ros.lockstep import NONE, TIMEOUT_DESCRIPTION, TIMEOUT_S, TOPICS, Lockstep
from thinmap_ros.ros.velocity.commands import VelocitySubscription
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS, DifferentialDriveRobot
from thinmap_ros.sim.simulation import STEP_NS, SensorReadings, Simulation
from thinmap_ros.sim.world import World

_COMMAND_TIMEOUT_NS = 500_000_000
_REPEAT_S = 0.25


@dataclass(frozen=True)
class SimConfig(Config):
    """Parameters of the simulation."""

    world: str = parameter(
        'room_10x10', 'World or map YAML file, or the name of a world of the package.'
    )
    robot: str = parameter('2dx', 'Preset of the robot.', choices=tuple(PRESETS))
    start: str = parameter('', 'Start as "x,y,theta" (m, m, rad). Empty: the start of the world.')
    seed: int = parameter(0, 'Seed of all noise.', low=0, high=2**31 - 1)
    real_time_factor: float = parameter(1.0, 'Simulated seconds per second.', low=0.01, high=1000.0)
    lockstep: str = parameter(
        NONE,
        'Topic whose message for each scan is awaited, so that nothing is lost at high rates. '
        'none: time never waits.',
        choices=TOPICS,
    )
    lockstep_timeout_s: float = parameter(TIMEOUT_S, TIMEOUT_DESCRIPTION, low=0.1, high=3600.0)
    wait_for_subscribers: int = parameter(
        0, 'Time stands still until scan has this many subscribers.', low=0, high=100
    )
    publish_tf: bool = parameter(True, 'Publish odom -> base_link and base_link -> laser.')


class _SimPublishers:
    """Publishes what the simulated robot senses, the time, and the ground truth."""

    def __init__(self, node: Node, scan_time_s: float, publish_tf: bool) -> None:
        """scan_time_s: time between two scans. publish_tf: also publish the transforms."""
        self._scan_time_s = scan_time_s
        self._clock = node.create_publisher(ClockMsg, '/clock', qos.STREAM)
        self._scan = node.create_publisher(LaserScan, 'scan', qos.STREAM)
        self._odom = node.create_publisher(Odometry, 'odom', qos.STREAM)
        self._truth = node.create_publisher(PoseStamped, 'ground_truth', qos.STREAM)
        self._collisions = node.create_publisher(UInt32, 'collisions', qos.LATCHED)
        self._tf = node.create_publisher(TFMessage, '/tf', qos.STREAM)
        self._tf_static = node.create_publisher(TFMessage, '/tf_static', qos.STATIC_TRANSFORMS)
        self._publish_tf = publish_tf
        self._last_collisions = -1
        self._last_scan: LaserScan | None = None

    def publish_laser_pose(self, T_base_laser: Array) -> None:
        if self._publish_tf:
            transform = messages.transform_msg(T_base_laser, 'base_link', 'laser', 0)
            self._tf_static.publish(TFMessage(transforms=[transform]))

    def publish(self, moment: SensorReadings, robot: DifferentialDriveRobot) -> None:
        """Publish a moment; the scan, if there is one, comes last."""
        ns = moment.stamp_ns
        self._publish_clock(ns)
        self._publish_odometry(moment, robot)
        self._truth.publish(messages.pose_stamped_msg(robot.T_world_base, 'world', ns))
        if robot.collisions != self._last_collisions:
            self._last_collisions = robot.collisions
            self._collisions.publish(UInt32(data=robot.collisions))
        if moment.scan is not None:
            self._last_scan = messages.scan_msg(moment.scan, 'laser', self._scan_time_s)
            self._scan.publish(self._last_scan)

    def repeat_scan(self, moment: SensorReadings, robot: DifferentialDriveRobot) -> None:
        """Publish the last scan again, with time and odometry of a moment."""
        if self._last_scan is not None:
            self._publish_clock(moment.stamp_ns)
            self._scan.publish(self._last_scan)
            self._publish_odometry(moment, robot)

    def _publish_clock(self, ns: int) -> None:
        self._clock.publish(ClockMsg(clock=messages.time_msg(ns)))

    def _publish_odometry(self, moment: SensorReadings, robot: DifferentialDriveRobot) -> None:
        velocity = (robot.v, robot.w)
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


class SimNode(Node):
    """Steps the simulation in the rhythm of the wall clock, `rate` times as fast."""

    def __init__(self) -> None:
        super().__init__('sim')
        self._config = parameters.declare_config(self, SimConfig)
        laser = parameters.declare_config(self, LaserScannerConfig)
        parameters.reject_unknown(self)
        world = World.from_patch(*read_world(package_data.world_path(self._config.world)))
        start = _start(self._config.start, world)
        self._sim = Simulation(world, start, PRESETS[self._config.robot], laser, self._config.seed)
        self._output = _SimPublishers(self, 1.0 / laser.scan_rate_hz, self._config.publish_tf)
        self._command = _VelocityCommand()
        self._lockstep = Lockstep(self, self._config.lockstep, self._config.lockstep_timeout_s)
        self._running = False
        self._repeated_s = 0.0
        self._diagnostics = NodeDiagnostics(self)
        VelocitySubscription(self, self._diagnostics, self._on_command)
        self.create_subscription(PoseStamped, '~/set_pose', self._on_teleport, qos.STREAM)
        self._output.publish_laser_pose(self._sim.laser.T_base_laser)
        wall = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(STEP_NS / 1e9 / self._config.real_time_factor, self._tick, clock=wall)

    def _on_command(self, v: float, w: float) -> None:
        if not np.isfinite((v, w)).all():
            reason = f'command {(v, w)}: expected finite numbers'
            self._diagnostics.message_rejected('cmd_vel', reason)
            return
        self._command = _VelocityCommand(v, w, self._sim.stamp_ns)

    def _on_teleport(self, message: PoseStamped) -> None:
        """Teleport the robot, for kidnapping tests: the odometry does not change."""
        self._diagnostics.message_received('~/set_pose')
        try:
            self._sim.teleport(messages.pose_from_msg(message.pose))
        except InputError as error:
            self._diagnostics.message_rejected('~/set_pose', str(error))

    def _tick(self) -> None:
        if not self._running:
            if self.count_subscribers('scan') < self._config.wait_for_subscribers:
                self._diagnostics.set_state(WARN, 'on hold: too few subscribers of the scans')
                return
            self._running = True
            self._diagnostics.set_state(OK, 'running')
            self._publish(self._sim.read_sensors())
            return
        if self._lockstep.is_waiting and self._is_on_hold():
            return
        with self._diagnostics.time_step('simulation'):
            moment = self._sim.step(*self._command.at(self._sim.stamp_ns))
        self._publish(moment)

    def _is_on_hold(self) -> bool:
        """Whether the simulation has to wait for the result of the last scan.

        The first scan is repeated until there is a result.
        """
        if self._sim.stamp_ns > 0:
            return not self._lockstep.timed_out()
        if monotonic() - self._repeated_s > _REPEAT_S:
            self._repeated_s = monotonic()
            self._output.repeat_scan(self._sim.read_sensors(), self._sim.robot)
        return True

    def _publish(self, moment: SensorReadings) -> None:
        self._output.publish(moment, self._sim.robot)
        if moment.scan is not None:
            self._lockstep.scan_published(moment.stamp_ns)
            self._repeated_s = monotonic()


def _start(text: str, world: World) -> Array:
    if not text:
        if not se2.is_finite(world.start):
            raise ConfigError(f'start: world {world.name} has none: expected "x,y,theta"')
        return world.start
    try:
        x, y, theta = (float(part) for part in text.split(','))
    except ValueError as error:
        raise ConfigError(f'start = {quoted(text)}: expected "x,y,theta" in m, m, rad') from error
    return se2.pose(x, y, theta)


def main() -> None:
    """Run the node."""
    node_main.run(SimNode)


if __name__ == '__main__':
    main()
