"""Simulator, pipeline, strategy and navigator in a closed loop, without ROS."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter, part
from thinmap_ros.core.errors import ConfigError, quoted
from thinmap_ros.core.exploration.explorer import ExplorerConfig
from thinmap_ros.core.exploration.mission import Drives, Odometer
from thinmap_ros.core.exploration.strategy import Decision, Observation, Strategy
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.planning.navigator import Command, Navigator, NavigatorConfig
from thinmap_ros.core.planning.path_follower import PathFollowerConfig
from thinmap_ros.core.planning.wavefront import WavefrontConfig
from thinmap_ros.core.scan import Scan, with_newest
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import Estimate
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.coverage import ObservableCells
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS, RobotConfig
from thinmap_ros.sim.simulation import STEP_NS, SensorReadings, Simulation
from thinmap_ros.sim.world import World
from thinmap_ros.strategies import DEFAULT, make_strategy

CONTROL_STEPS = 2
# The period of the candidate search; thinning costs more than all other stages.
SCANS_PER_GRAPH = 5
# Beyond, and within, the radius with which paths are planned.
_INFLATION_M = 0.35
_STOP_MARGIN_M = 0.01
# Receives each decision, and the estimated pose (3,) at which it was made.
Watch = Callable[[Decision, Array], None]
# Command of a robot at a pose (3,) for the next seconds, as others allow it to drive.
RightOfWay = Callable[[Array, Command, float], Command]


def drives_alone(T_map_base: Array, command: Command, period_s: float) -> Command:
    """The command of a robot without others."""
    return command


@dataclass(eq=False)
class RunLog:
    """Stamps and poses (3,), true and estimated, of all scans; coverage over time."""

    stamps_ns: list[int] = field(default_factory=list)
    true_poses: list[Array] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    coverage: list[tuple[float, float]] = field(default_factory=list)
    decision_s: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class ExplorationOutcome:
    """How an exploration ended; finished: whether the strategy ended it, and has explored."""

    finished: bool
    reason: str
    collisions: int


class Mishap(Protocol):
    """An incident during exploration, such as a kidnapping."""

    @property
    def is_lost(self) -> bool:
        """Whether the robot is lost."""

    def intercepts(self, loop: 'ClosedLoop', scan: Scan, T_odom_base: Array) -> bool:
        """Whether the loop shall not process a scan."""

    def add_estimate(self, loop: 'ClosedLoop', scan: Scan, estimate: Estimate) -> None:
        """Receive the estimate of a scan."""

    def command(self, T_odom_base: Array, period_s: float) -> Command:
        """Command of a lost robot at a pose (3,) of its odometry."""


@dataclass
class _Drive:
    """The goal (3,) that the navigator has, and the last command (v, w).

    Speeds in m/s and rad/s. drives: what came of all of them; odometer: of the estimated poses.
    """

    goal: Array | None = None
    drives: Drives = field(default_factory=Drives)
    odometer: Odometer = field(default_factory=Odometer)
    command: tuple[float, float] = (0.0, 0.0)


class ClosedLoop:
    """Simulator, pipeline, strategy and navigator, each called in turn as the live graph would."""

    def __init__(
        self,
        simulation: Simulation,
        pipeline: Pipeline,
        strategy: Strategy,
        navigator: Navigator,
        mishap: Mishap | None = None,
        watch: Watch | None = None,
    ) -> None:
        self.simulation = simulation
        self.pipeline = pipeline
        self.strategy = strategy
        self.navigator = navigator
        self.mishap = mishap
        self._watch = watch
        self.log = RunLog()
        self.decision: Decision | None = None
        self._observation: Observation | None = None
        self._scans: tuple[Scan, ...] = ()  # the newest of each laser
        self._drive = _Drive()
        # The odometry is zero at the start.
        self._T_map_odom = simulation.robot.T_world_base
        self._stop_reason = ''  # as of the navigator

    def run(
        self,
        goal: ObservableCells,
        limit_s: float,
        show: Callable[[float, float], None],
        scans_per_show: int = 5,
    ) -> ExplorationOutcome:
        """Explore until the strategy is finished or the time is up.

        `show` receives time (s) and coverage with every `scans_per_show`-th scan.
        """
        moment = self.simulation.read_sensors()
        steps = 0
        while moment.stamp_ns < limit_s * 1e9:
            for scan in moment.scans:
                self._process_scan(scan, moment.T_odom_base)
                if len(self.log.poses) % scans_per_show == 1:
                    show(*self._measure(goal))
            if self.is_finished:
                break
            if steps % CONTROL_STEPS == 0:
                self.control(moment)
            moment = self.simulation.step(*self.command)
            steps = steps + 1
        self.pipeline.finish()
        show(*self._measure(goal))
        finished, reason = self.ending(limit_s)
        return ExplorationOutcome(finished, reason, self.simulation.robot.collisions)

    def ending(self, limit_s: float) -> tuple[bool, str]:
        """Whether the strategy ended the exploration, which came to something, and why it ended."""
        words = [f'time limit of {limit_s:.0f} s']
        shortcoming = ''
        if self.decision is not None and self.is_finished:
            drive = self._drive
            shortcoming = drive.drives.shortcoming(self.decision, drive.odometer.distance_m)
            words = [self.decision.reason, shortcoming]
        reason = '; '.join(word for word in [*words, self._stop_reason] if word)
        return self.is_finished and not shortcoming, reason

    @property
    def is_finished(self) -> bool:
        """Whether the strategy is finished and the robot is not lost."""
        lost = self.mishap is not None and self.mishap.is_lost
        return self.decision is not None and self.decision.finished and not lost

    def _process_scan(self, scan: Scan, T_odom_base: Array) -> None:
        """Process one scan through localization, map and graph to a decision."""
        if self.mishap is not None and self.mishap.intercepts(self, scan, T_odom_base):
            return
        estimate = self.map_scan(scan, T_odom_base)
        is_carried = self.mishap is not None and self.mishap.is_lost
        if not (estimate.blind_reason or is_carried):
            self.decide(scan, estimate)

    def map_scan(self, scan: Scan, T_odom_base: Array) -> Estimate:
        """Localize and map one scan; stop the robot where it must not drive on."""
        estimate = self.pipeline.step(scan, T_odom_base).estimate
        self.log_poses(scan, estimate)
        self._stop_reason = _stop_reason(estimate)
        if self._stop_reason:
            self.navigator.reset_velocity()
            self._drive.command = (0.0, 0.0)
        return estimate

    def log_poses(self, scan: Scan, estimate: Estimate) -> None:
        """Log the true and the estimated pose of a scan."""
        self.log.stamps_ns.append(scan.stamp_ns)
        self.log.poses.append(estimate.T_map_base)
        self.log.true_poses.append(self.simulation.robot.T_world_base)
        if self.mishap is not None:
            self.mishap.add_estimate(self, scan, estimate)

    def decide(self, scan: Scan, estimate: Estimate) -> None:
        """Choose a target in the present map."""
        observation = Observation(
            self.pipeline.topology.map, self.pipeline.grid.known_area(), scan, estimate.T_map_base
        )
        self.decide_on(observation, estimate.T_map_odom)

    def decide_on(self, observation: Observation, T_map_odom: Array) -> None:
        """Choose a target by an observation; T_map_odom (3,): of its scan."""
        self._T_map_odom = T_map_odom
        self._observation = observation
        self._scans = with_newest(self._scans, observation.scan)
        self.navigator.topology = observation.topology
        # Processor time of this thread: other processes do not count.
        began = time.thread_time()
        self.decision = self.strategy.step(*observation)
        self.log.decision_s.append(time.thread_time() - began)
        if self._watch is not None:
            self._watch(self.decision, observation.T_map_base)
        self._drive.odometer.add_pose(observation.T_map_base)
        before = self._drive.goal
        goal = self._drive.drives.follow(self.decision.target, self.strategy)
        self._drive.goal = goal
        if goal is None:
            self.navigator.cancel()
        elif before is None or not np.array_equal(goal, before):
            self.navigator.set_goal(*(float(number) for number in goal))

    def _target_failed(self, reason: str) -> None:
        self._drive.drives.add_result(False, reason)
        self.strategy.target_failed(reason)

    def decide_anew(self) -> None:
        """Forget the last decision and its goal; the robot stops first."""
        self.navigator.cancel()
        self.decision = None
        self._observation = None
        self._drive = _Drive()

    @property
    def command(self) -> tuple[float, float]:
        """Speed, m/s, and turn rate, rad/s, that the robot is commanded."""
        return self._drive.command

    def pose_at(self, T_odom_base: Array) -> Array:
        """Estimated pose (3,) of the robot at a pose (3,) of its odometry."""
        return se2.compose(self._T_map_odom, T_odom_base)

    def control(self, moment: SensorReadings, right_of_way: RightOfWay = drives_alone) -> None:
        """Command the robot until the next step; right_of_way: among other robots."""
        period_s = CONTROL_STEPS * STEP_NS / 1e9
        if self.mishap is not None and self.mishap.is_lost:
            lost = self.mishap.command(moment.T_odom_base, period_s)
            self._drive.command = (lost.v, lost.w)
            return
        observation = self._observation
        if observation is None or self._stop_reason:
            return
        T_map_base = self.pose_at(moment.T_odom_base)
        command = self.navigator.step(T_map_base, observation.patch, self._scans, period_s)
        command = right_of_way(T_map_base, command, period_s)
        self._drive.command = (command.v, command.w)
        if command.state == 'failed':
            self._target_failed(command.reason)
        if command.state == 'reached' and self._drive.goal is not None:
            self._drive.drives.add_result(True, '')
        if command.state in ('failed', 'reached'):
            self._drive.goal = None

    def _measure(self, goal: ObservableCells) -> tuple[float, float]:
        seconds = self.simulation.stamp_ns / 1e9
        self.log.coverage.append((seconds, goal.coverage(self.pipeline.grid.known_area())))
        return self.log.coverage[-1]


def ground_truth_poses(simulation: Simulation) -> Callable[[Scan, Array], Estimate]:
    """Pose source that replaces the localizer by the true pose of the simulator."""

    def locate(scan: Scan, T_odom_base: Array) -> Estimate:
        T_map_base = simulation.robot.T_world_base
        return Estimate(
            T_map_base, np.zeros((3, 3)), se2.compose(T_map_base, se2.invert(T_odom_base))
        )

    return locate


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
    robot: str = parameter('2dx', 'Simulated robot.', choices=tuple(PRESETS))
    laser: LaserScannerConfig = part(LaserScannerConfig)
    time_limit_s: float = parameter(
        20_000.0, 'Simulated time after which the exploration ends (s).', low=0.0
    )
    kidnap_at_s: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kidnap_at_s is not None and not isinstance(self.kidnap_at_s, float | int):
            raise ConfigError(f'kidnap_at_s = {quoted(self.kidnap_at_s)}: expected a float or None')


def make_loop(
    world: World,
    start: Array,
    options: Options,
    mishap: Mishap | None = None,
    watch: Watch | None = None,
) -> ClosedLoop:
    """Make all parts by the options. Raises ConfigError where there is no such strategy."""
    robot = PRESETS[options.robot]
    radius_m = robot.planned_radius_m
    simulation = Simulation(world, start, robot, options.laser, options.seed)
    x, y, theta = (float(number) for number in start)
    localizer = LocalizerConfig(initial_x_m=x, initial_y_m=y, initial_yaw_rad=theta)
    source = ground_truth_poses(simulation) if options.localization == 'truth' else None
    # A beam without return has observed free space up to the laser's range.
    grid = replace(PAPER_GRID, no_return_clear_range_m=options.laser.range_max_m)
    topology = TopologyConfig(robot_radius_m=radius_m)
    pipeline = Pipeline(PipelineConfig(localizer, grid, topology, SCANS_PER_GRAPH), source)
    strategy = make_strategy(options.strategy, explorer_config(robot, options.speed_m_s))
    navigator = Navigator(_navigator_config(robot, options.speed_m_s))
    return ClosedLoop(simulation, pipeline, strategy, navigator, mishap, watch)


def explorer_config(robot: RobotConfig, speed_m_s: float) -> ExplorerConfig:
    """The default for a body and a speed, as of its navigator."""
    navigator = _navigator_config(robot, speed_m_s)
    return ExplorerConfig(planner=navigator.planner, controller=navigator.controller)


def _navigator_config(robot: RobotConfig, speed_m_s: float) -> NavigatorConfig:
    """The default, for a body of another size, too."""
    radius_m = robot.planned_radius_m
    planner = WavefrontConfig(robot_radius_m=radius_m, inflation_radius_m=radius_m + _INFLATION_M)
    controller = PathFollowerConfig(max_speed_m_s=speed_m_s)
    return NavigatorConfig(planner, controller, stop_radius_m=radius_m - _STOP_MARGIN_M)


def no_progress(seconds: float, coverage: float) -> None:
    """Show no progress."""


def _stop_reason(estimate: Estimate) -> str:
    """Why the robot must not drive on; '' for no reason."""
    if estimate.blind_reason:
        return f'laser blind ({estimate.blind_reason})'
    return estimate.mount_fault
