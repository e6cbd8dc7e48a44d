"""Simulated robots: /cmd_vel in; /scan, /odom, /tf, /clock and the true pose out.

Several lasers (`lasers`) have each its topic: /front/scan, /rear/scan.
Commands are Twist or TwistStamped, as their publishers choose. ~/set_pose teleports the robot.
With `robots` of 2 or more each has its namespace, from robot1 on: /robot1/scan, /robot1/tf, ...,
~/robot1/set_pose; there is one /clock. The robots see each other with their lasers, and touch.
"""

from dataclasses import dataclass
from time import monotonic

from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMsg

from thinmap_ros import kernels
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.nodes.parts.simulation import RobotInterface, robot_starts
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.diagnostics import OK, WARN, NodeDiagnostics
from thinmap_ros.ros.localized_scan import NONE, TIMEOUT_DESCRIPTION, TIMEOUT_S, TOPICS, Lockstep
from thinmap_ros.ros.time_jumps import STEADY
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.other_robots import MAX_ROBOTS, simulations_in
from thinmap_ros.sim.robot import LASERS, PRESETS
from thinmap_ros.sim.simulation import STEP_NS, Simulation
from thinmap_ros.sim.world import World

_REPEAT_S = 0.25
_STEP_S = STEP_NS / 1e9
_MOST_STEPS = 4  # at a time: where many are missed, they do not come all at once


@dataclass(frozen=True)
class SimConfig(Config):
    """Parameters of the simulation."""

    world: str = parameter(
        'room_10x10', 'World or map YAML file, or the name of a world of the package.'
    )
    robot: str = parameter('2dx', 'Preset of the robot.', choices=tuple(PRESETS))
    robots: int = parameter(
        1,
        'Number of robots. From 2 on the topics of each are in a namespace: robot1, robot2, ...',
        low=1,
        high=MAX_ROBOTS,
    )
    start: str = parameter(
        '',
        'Start as "x,y,theta" (m, m, rad); several robots start there side by side. Empty: the '
        'start of the world.',
    )
    starts: str = parameter(
        '',
        'Start of each robot, as "x,y,theta; x,y,theta" (m, m, rad). Empty: the starts of the '
        'world, or side by side where it has not so many.',
    )
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
        0,
        'Time stands still until the scans of each laser have this many subscribers.',
        low=0,
        high=100,
    )
    publish_tf: bool = parameter(
        True, 'Publish odom -> base_link and base_link -> the frame of each laser.'
    )


class SimNode(Node):
    """Steps the simulation in the rhythm of the wall clock, `rate` times as fast.

    In real time, steps that a busy machine has missed are made up: nodes that do not follow /clock
    would take the scans for late from then on, and the robot would stand.
    """

    def __init__(self) -> None:
        super().__init__('sim')
        self._config = parameters.declare_config(self, SimConfig)
        laser = parameters.declare_config(
            self, LaserScannerConfig, base=LASERS.get(self._config.robot)
        )
        parameters.reject_unknown(self)
        self._diagnostics = NodeDiagnostics(self)
        self._simulations = _simulations(self._config, laser)
        kernels.sim()
        self._time = self.create_publisher(ClockMsg, '/clock', qos.STREAM)
        prefixes = _prefixes(self._config.robots)
        self._robots = [
            RobotInterface(self, prefix, simulation, self._diagnostics, self._config.publish_tf)
            for prefix, simulation in zip(prefixes, self._simulations, strict=True)
        ]
        timeout_s = self._config.lockstep_timeout_s
        self._locksteps = [
            Lockstep(self, self._config.lockstep, timeout_s, prefix) for prefix in prefixes
        ]
        self._running = False
        self._repeated_s = 0.0
        self._due_s = 0.0  # time of the next step, in real time
        self.create_timer(_STEP_S / self._config.real_time_factor, self._tick, clock=STEADY)

    def _tick(self) -> None:
        if not self._running:
            fewest = min(robot.scan_subscribers for robot in self._robots)
            if fewest < self._config.wait_for_subscribers:
                self._diagnostics.set_state(WARN, 'on hold: too few subscribers of the scans')
                return
            self._running = True
            self._due_s = monotonic() + _STEP_S
            self._diagnostics.set_state(OK, 'running')
            self._publish()
            return
        for _ in range(self._steps_due()):
            if self._is_on_hold():
                self._due_s = monotonic() + _STEP_S  # what was waited for is not made up
                return
            with self._diagnostics.time_step('simulation'):
                for robot in self._robots:
                    robot.move()
            self._publish()
            self._due_s += _STEP_S

    def _steps_due(self) -> int:
        """Steps to make now."""
        if self._config.real_time_factor != 1.0:
            return 1
        missed = int((monotonic() - self._due_s) / _STEP_S)
        return min(max(missed, 0) + 1, _MOST_STEPS)

    @property
    def _stamp_ns(self) -> int:
        return self._simulations[0].stamp_ns

    def _is_on_hold(self) -> bool:
        """Whether the simulation has to wait for the results of the last scans.

        The first scan is repeated until there is a result.
        """
        waiting = [lockstep.is_waiting for lockstep in self._locksteps]
        if self._stamp_ns > 0:
            # Of each that waits: a robot without result does not hide another one.
            late = [each.timed_out() for each in self._locksteps if each.is_waiting]
            return not all(late)
        if any(waiting) and monotonic() - self._repeated_s > _REPEAT_S:
            self._repeated_s = monotonic()
            self._publish_clock()
            for robot, is_waiting in zip(self._robots, waiting, strict=True):
                if is_waiting:
                    robot.repeat_scan()
        return any(waiting)

    def _publish(self) -> None:
        self._publish_clock()
        for robot, lockstep in zip(self._robots, self._locksteps, strict=True):
            if robot.publish():
                lockstep.scan_published(self._stamp_ns)
                self._repeated_s = monotonic()

    def _publish_clock(self) -> None:
        self._time.publish(ClockMsg(clock=messages.time_msg(self._stamp_ns)))


def _simulations(config: SimConfig, laser: LaserScannerConfig) -> list[Simulation]:
    file = package_data.world_path(config.world)
    world = World.from_patch(*read_world(file))
    robot = PRESETS[config.robot]
    given = (config.start, config.starts)
    starts = robot_starts(world, file, config.robots, given, robot.radius_m)
    return simulations_in(world, starts, robot, laser, config.seed)


def _prefixes(count: int) -> list[str]:
    """Prefix of the topics of each robot; of a single one none."""
    return [f'robot{number}/' for number in range(1, count + 1)] if count > 1 else ['']


main = node_main.program(SimNode)

if __name__ == '__main__':
    main()
