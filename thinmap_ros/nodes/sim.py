"""A simulated robot: /cmd_vel in; /scan, /odom, /tf, /clock and the true pose out.

~/carry puts it elsewhere.
"""

from dataclasses import dataclass
from time import monotonic

import numpy as np
from geometry_msgs.msg import PoseStamped, Twist
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
from thinmap_ros.ros.diagnostics import OK, WARN, Health
from thinmap_ros.ros.lockstep import NONE, PATIENCE_S, PATIENCE_WORDS, TOPICS, Lockstep
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import STEP_NS, SensorReadings, Simulation
from thinmap_ros.sim.world import World

_COMMAND_TIMEOUT_NS = 500_000_000
_REPEAT_S = 0.25


@dataclass(frozen=True)
class SimConfig(Config):
    """Parameters of the simulation."""

    world: str = parameter(
        'room_10x10', 'world or map YAML file, or the name of a world of the package'
    )
    robot: str = parameter('2dx', 'which Pioneer', choices=tuple(PRESETS))
    start: str = parameter('', 'start as "x,y,theta" (m, m, rad); empty: the one of the world')
    seed: int = parameter(0, 'decides all noise', low=0, high=2**31 - 1)
    rate: float = parameter(1.0, 'simulated seconds a second', low=0.01, high=1000.0)
    lockstep: str = parameter(
        NONE, 'wait for what each scan leads to: nothing is lost at high rates', choices=TOPICS
    )
    lockstep_patience_s: float = parameter(PATIENCE_S, PATIENCE_WORDS, low=0.1, high=3600.0)
    hold_for_subscribers: int = parameter(
        0, 'time stands still until /scan has so many subscribers', low=0, high=100
    )
    publish_tf: bool = parameter(True, 'publish odom -> base_link and base_link -> laser')


class SimNode(Node):
    """Steps the simulation in the rhythm of the wall clock, `rate` times as fast."""

    def __init__(self) -> None:
        super().__init__('sim')
        self._config = parameters.declare(self, SimConfig)
        laser = parameters.declare(self, LaserScannerConfig)
        parameters.check_unknown(self)
        world = World.from_patch(*read_world(package_data.world_path(self._config.world)))
        start = _start(self._config.start, world)
        self._sim = Simulation(world, start, PRESETS[self._config.robot], laser, self._config.seed)
        self._scan_time_s = 1.0 / laser.rate_hz
        self._command = (0.0, 0.0)
        self._command_ns = 0
        self._lockstep = Lockstep(self, self._config.lockstep, self._config.lockstep_patience_s)
        self._last_scan: LaserScan | None = None
        self._repeated_at = 0.0
        self._running = False
        self._told_collisions = -1
        self._health = Health(self)
        self._make_topics()
        self._publish_mount()
        wall = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(STEP_NS / 1e9 / self._config.rate, self._tick, clock=wall)

    def _make_topics(self) -> None:
        self._clock_topic = self.create_publisher(ClockMsg, '/clock', qos.STREAM)
        self._scan = self.create_publisher(LaserScan, 'scan', qos.STREAM)
        self._odom = self.create_publisher(Odometry, 'odom', qos.STREAM)
        self._truth = self.create_publisher(PoseStamped, 'ground_truth', qos.STREAM)
        self._collisions = self.create_publisher(UInt32, 'collisions', qos.LATCHED)
        self._tf = self.create_publisher(TFMessage, '/tf', qos.STREAM)
        self._tf_static = self.create_publisher(TFMessage, '/tf_static', qos.STATIC_TRANSFORMS)
        self.create_subscription(Twist, 'cmd_vel', self._on_command, qos.STREAM)
        self.create_subscription(PoseStamped, '~/carry', self._on_carry, qos.STREAM)

    def _on_command(self, message: Twist) -> None:
        self._health.heard('cmd_vel')
        command = (message.linear.x, message.angular.z)
        if not np.isfinite(command).all():
            self._health.refused('cmd_vel', f'command {command}: expected finite numbers')
            return
        self._command = command
        self._command_ns = self._sim.stamp_ns

    def _on_carry(self, message: PoseStamped) -> None:
        """Somebody lifts the robot up and puts it down at a pose in the world.

        Its wheels know nothing of it.
        """
        self._health.heard('~/carry')
        try:
            self._sim.teleport(messages.pose_from(message.pose))
        except InputError as error:
            self._health.refused('~/carry', str(error))

    def _tick(self) -> None:
        if not self._running:
            if self.count_subscribers('scan') < self._config.hold_for_subscribers:
                self._health.state(WARN, 'time stands still: too few nodes listen to the scans')
                return
            self._running = True
            self._health.state(OK, 'running')
            self._publish(self._sim.read_sensors())
            return
        if self._lockstep.waits and self._waits():
            return
        # As a robot's own controller does: without a fresh command it stops.
        fresh = self._sim.stamp_ns - self._command_ns <= _COMMAND_TIMEOUT_NS
        with self._health.timed('simulation'):
            moment = self._sim.step(*(self._command if fresh else (0.0, 0.0)))
        self._publish(moment)

    def _waits(self) -> bool:
        """Whether time has to stand still for the last scan.

        The first one is repeated until somebody answers.
        """
        if self._sim.stamp_ns > 0:
            return not self._lockstep.give_up()
        if monotonic() - self._repeated_at > _REPEAT_S and self._last_scan is not None:
            self._repeated_at = monotonic()
            self._publish_clock(0)
            self._scan.publish(self._last_scan)
            self._odom.publish(self._odometry(self._sim.read_sensors()))
        return True

    def _publish(self, moment: SensorReadings) -> None:
        self._publish_clock(moment.stamp_ns)
        self._odom.publish(self._odometry(moment))
        if self._config.publish_tf:
            transform = messages.transform_msg(
                moment.T_odom_base, 'odom', 'base_link', moment.stamp_ns
            )
            self._tf.publish(TFMessage(transforms=[transform]))
        truth = messages.pose_stamped_msg(self._sim.robot.T_world_base, 'world', moment.stamp_ns)
        self._truth.publish(truth)
        if self._sim.robot.collisions != self._told_collisions:
            self._told_collisions = self._sim.robot.collisions
            self._collisions.publish(UInt32(data=self._told_collisions))
        if moment.scan is not None:
            self._last_scan = messages.scan_msg(moment.scan, 'laser', self._scan_time_s)
            self._scan.publish(self._last_scan)
            self._lockstep.sent(moment.stamp_ns)
            self._repeated_at = monotonic()

    def _publish_clock(self, ns: int) -> None:
        self._clock_topic.publish(ClockMsg(clock=messages.time_msg(ns)))

    def _odometry(self, moment: SensorReadings) -> Odometry:
        velocity = (self._sim.robot.v, self._sim.robot.w)
        return messages.odometry_msg(
            moment.T_odom_base, velocity, ('odom', 'base_link'), moment.stamp_ns
        )

    def _publish_mount(self) -> None:
        if self._config.publish_tf:
            T_base_laser = self._sim.laser.T_base_laser
            transform = messages.transform_msg(T_base_laser, 'base_link', 'laser', 0)
            self._tf_static.publish(TFMessage(transforms=[transform]))


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
