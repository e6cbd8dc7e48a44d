"""A robot in the simulator: pipeline, strategy and navigator, each called as on a live graph."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter, part
from thinmap_ros.core.errors import ConfigError, quoted
from thinmap_ros.core.exploration.explorer import Explorer, ExplorerConfig
from thinmap_ros.core.exploration.mission import (
    DriveTo,
    InputWatchdog,
    Mission,
    MissionGoal,
    MissionState,
)
from thinmap_ros.core.exploration.strategy import Decision, Observation, Strategy
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.planning.path_follower import HeardMotion, Motion, PathFollowerConfig
from thinmap_ros.core.planning.wavefront import WavefrontConfig
from thinmap_ros.core.scan import Scan, with_newest
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import Estimate
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS, RobotConfig
from thinmap_ros.sim.simulation import STEP_NS, SensorReadings, Simulation
from thinmap_ros.strategies import DEFAULT, make_strategy

CONTROL_STEPS = 2
CONTROL_PERIOD_S = CONTROL_STEPS * STEP_NS / SECOND_NS
# The period of the candidate search; thinning costs more than all other stages.
SCANS_PER_GRAPH = 5
# Beyond, and within, the radius with which paths are planned.
_INFLATION_M = 0.35
_STOP_MARGIN_M = 0.01
_GIVE_WAY_MARGIN_M = 0.11  # beyond the radii of both robots
# Receives each decision, and the estimated pose (3,) at which it was made.
Watch = Callable[[Decision, Array], None]


@dataclass(frozen=True)
class Options(Config):
    """Options of an exploration, beside world and start. Its map has cells of 10 cm.

    kidnap_at_s: time at which the robot is carried elsewhere (s); None: never.
    """

    strategy: str = parameter(DEFAULT, 'Exploration strategy, or package.module:factory.')
    seed: int = parameter(0, 'Seed of all noise: the same seed gives the same result.', low=0)
    speed_m_s: float = parameter(0.2, 'Largest speed of the robot (m/s).', low=0.01, high=10.0)
    localization: str = parameter(
        'truth', 'Poses by SLAM, or the true ones.', choices=('slam', 'truth')
    )
    robot: str = parameter(
        '2dx',
        'Simulated robot: a Pioneer, or a MiR100 with its two lasers.',
        choices=tuple(sorted(PRESETS)),
    )
    laser: LaserScannerConfig = part(LaserScannerConfig)
    time_limit_s: float = parameter(
        20_000.0, 'Simulated time after which the exploration ends (s).', low=0.0
    )
    kidnap_at_s: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kidnap_at_s is not None and not isinstance(self.kidnap_at_s, float | int):
            raise ConfigError(f'kidnap_at_s = {quoted(self.kidnap_at_s)}: expected a float or None')


@dataclass(eq=False)
class RunLog:
    """Stamps and poses (3,), true and estimated, of all scans; times of all decisions."""

    stamps_ns: list[int] = field(default_factory=list)
    true_poses: list[Array] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    decision_s: list[float] = field(default_factory=list)


class SimulatedRobot:
    """A robot that explores, alone or with others; it is called step by step.

    name: in its team; moment: the newest readings of its sensors; command: speed, m/s, and turn
    rate, rad/s; mission: what it has decided so far; watch: see `Watch`; yielded_s: time for which
    it has given way.
    """

    def __init__(self, simulation: Simulation, options: Options, name: str = 'robot1') -> None:
        """Raises ConfigError where there is no such strategy."""
        driving = _navigator_config(simulation.robot.config, options.speed_m_s)
        explorer = ExplorerConfig(planner=driving.planner, controller=driving.controller)
        self.simulation = simulation
        self.pipeline = _pipeline(simulation, options)
        self.navigator = Navigator(driving)
        self.name = name
        self.mission = _mission(make_strategy(options.strategy, explorer))
        self.log = RunLog()
        self.moment = SensorReadings(0, np.zeros(3), ())
        self.command = (0.0, 0.0)
        self.watch: Watch | None = None
        self.yielded_s = 0.0
        self._goal: Array | None = None  # that the navigator has
        self._observation: Observation | None = None
        self._scans: tuple[Scan, ...] = ()  # the newest of each laser
        # The odometry is zero at the start.
        self._T_map_odom = simulation.robot.T_world_base
        self._stop_reason = ''  # as of the navigator

    @property
    def explorer(self) -> Explorer:
        """Its strategy, as a robot of a team has it."""
        assert isinstance(self.mission.strategy, Explorer)
        return self.mission.strategy

    @property
    def pose(self) -> Array:
        """Estimated pose (3,) now."""
        return se2.compose(self._T_map_odom, self.moment.T_odom_base)

    @property
    def motion(self) -> Motion:
        """The motion that it tells the others."""
        robot = self.simulation.robot
        return Motion(self.name, self.pose, robot.v, robot.w)

    @property
    def radius_m(self) -> float:
        """Radius of the body."""
        return self.simulation.robot.config.radius_m

    @property
    def is_finished(self) -> bool:
        """Whether nothing is left to explore."""
        decision = self.mission.decision
        return decision is not None and decision.finished

    def ending(self, limit_s: float) -> tuple[bool, str]:
        """Whether the strategy ended the exploration, which came to something, and why it ended."""
        end = self.mission.end
        reason = end.reason if self.is_finished else f'time limit of {limit_s:.0f} s'
        words = filter(None, (reason, self._stop_reason))
        return self.is_finished and end.has_explored, '; '.join(words)

    def sense(self) -> None:
        """Read the sensors."""
        self.moment = self.simulation.read_sensors()

    def map_scan(self, scan: Scan) -> Estimate | None:
        """Localize and map a scan of this moment; stop the robot where it must not drive on.

        None where nothing can be decided by this scan.
        """
        estimate = self.pipeline.step(scan, self.moment.T_odom_base).estimate
        self.log_poses(scan, estimate)
        self._stop_reason = _stop_reason(estimate)
        if self._stop_reason:
            self.navigator.reset_velocity()
            self.command = (0.0, 0.0)
        return None if estimate.blind_reason else estimate

    def log_poses(self, scan: Scan, estimate: Estimate) -> None:
        """Log the true and the estimated pose of a scan."""
        self.log.stamps_ns.append(scan.stamp_ns)
        self.log.poses.append(estimate.T_map_base)
        self.log.true_poses.append(self.simulation.robot.T_world_base)

    def decide(self, observation: Observation, T_map_odom: Array) -> None:
        """Choose a target by an observation; T_map_odom (3,): of its scan."""
        self._T_map_odom = T_map_odom
        self._observation = observation
        self._scans = with_newest(self._scans, observation.scan)
        self.navigator.topology = observation.topology
        # A robot that has finished looks on: others may leave it something.
        self.mission.state = MissionState.EXPLORING
        # Processor time of this thread: other processes do not count.
        began = time.thread_time()
        order = self.mission.step(observation)
        self.log.decision_s.append(time.thread_time() - began)
        if self.watch is not None and self.mission.decision is not None:
            self.watch(self.mission.decision, observation.T_map_base)
        self._drive_to(order.goal if isinstance(order, DriveTo) else None)

    def _drive_to(self, goal: Array | None) -> None:
        """Give the navigator a goal (3,), unless it has it; None: none."""
        if goal is None:
            self.navigator.cancel()
        elif self._goal is None or not np.array_equal(goal, self._goal):
            self.navigator.set_goal(*(float(number) for number in goal))
        self._goal = goal

    def decide_anew(self) -> None:
        """Forget all decisions and the goal; the robot stops first."""
        self._drive_to(None)
        self._observation = None
        self.command = (0.0, 0.0)
        self.mission = _mission(self.mission.strategy)

    def control(self, others: Iterable[HeardMotion]) -> None:
        """Command the robot until the next step, with right of way among others."""
        observation = self._observation
        if observation is None or self._stop_reason:
            return
        T_map_base = self.pose
        navigator = self.navigator
        wanted = navigator.step(T_map_base, observation.patch, self._scans, CONTROL_PERIOD_S)
        own = Motion(self.name, T_map_base, wanted.v, wanted.w)
        distance_m = 2.0 * self.radius_m + _GIVE_WAY_MARGIN_M
        command = navigator.allowed(own, wanted, others, distance_m, CONTROL_PERIOD_S)
        if command is not wanted:
            self.yielded_s += CONTROL_PERIOD_S
        self.command = (command.v, command.w)
        if command.state in ('failed', 'reached') and self._goal is not None:
            self.mission.drive_ended(command.state == 'reached', command.reason)
            self._goal = None


def _mission(strategy: Strategy) -> Mission:
    """An exploration without limits."""
    return Mission(MissionGoal(), strategy, InputWatchdog(), 0.0)


def ground_truth_poses(simulation: Simulation) -> Callable[[Scan, Array], Estimate]:
    """Pose source that replaces the localizer by the true pose of the simulator."""

    def locate(scan: Scan, T_odom_base: Array) -> Estimate:
        T_map_base = simulation.robot.T_world_base
        return Estimate(
            T_map_base, np.zeros((3, 3)), se2.compose(T_map_base, se2.invert(T_odom_base))
        )

    return locate


def _pipeline(simulation: Simulation, options: Options) -> Pipeline:
    """The pipeline of a robot that begins where it stands in a simulation."""
    x, y, theta = simulation.robot.T_world_base.tolist()
    localizer = LocalizerConfig(initial_x_m=x, initial_y_m=y, initial_yaw_rad=theta)
    # A beam without return has observed free space up to the laser's range.
    grid = replace(PAPER_GRID, no_return_clear_range_m=options.laser.range_max_m)
    topology = TopologyConfig(robot_radius_m=simulation.robot.config.planned_radius_m)
    source = ground_truth_poses(simulation) if options.localization == 'truth' else None
    return Pipeline(PipelineConfig(localizer, grid, topology, SCANS_PER_GRAPH), source)


def _navigator_config(robot: RobotConfig, speed_m_s: float) -> NavigatorConfig:
    """The default, for a body of another size, too."""
    radius_m = robot.planned_radius_m
    planner = WavefrontConfig(robot_radius_m=radius_m, inflation_radius_m=radius_m + _INFLATION_M)
    controller = PathFollowerConfig(max_speed_m_s=speed_m_s)
    return NavigatorConfig(planner, controller, stop_radius_m=radius_m - _STOP_MARGIN_M)


def _stop_reason(estimate: Estimate) -> str:
    """Why the robot must not drive on; '' for no reason."""
    if estimate.blind_reason:
        return f'laser blind ({estimate.blind_reason})'
    return estimate.mount_fault
