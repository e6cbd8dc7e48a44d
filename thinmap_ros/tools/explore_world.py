"""Explore a simulated world, no ROS, faster than real time: map, graph, path, picture, report."""

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from tqdm import tqdm

from thinmap_ros.baselines.exploration import (
    DistanceAdvantage,
    ExploreLite,
    InformationGain,
    NearestFrontier,
    VisitAllEndNodes,
)
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.estimate import Estimate
from thinmap_ros.core.exploration.explorer import Explorer, ExplorerConfig
from thinmap_ros.core.exploration.strategy import Decision
from thinmap_ros.core.grid.occupancy import OccupancyConfig
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import ScanLocalizerConfig
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.evaluation.exploration_metrics import (
    Ending,
    EndNodeCensus,
    TargetLog,
    exploration_report,
)
from thinmap_ros.evaluation.kidnapping import Kidnapping
from thinmap_ros.files import graphs as graph_files
from thinmap_ros.files import occupancy_maps as map_files
from thinmap_ros.files import trajectories as trajectory_files
from thinmap_ros.files.atomic import write_text
from thinmap_ros.files.worlds import read_world
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.coverage import Coverable, coverable
from thinmap_ros.sim.laser import Lms200Config
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import STEP_NS, Moment, Simulation
from thinmap_ros.sim.world import World
from thinmap_ros.tools import cli
from thinmap_ros.view import figures

_CONTROL_STEPS = 2
_MEASURE_SCANS = 5
# At the survey's pace; thinning costs more than all else together.
SCANS_PER_GRAPH = 5


class Strategy(Protocol):
    """What decides where to go: ours, and everything that it is compared with."""

    def step(
        self, topology: TopologicalMap, patch: GridPatch, scan: Scan, T_map_base: Array
    ) -> Decision:
        """Say where to go, from the graph, the whole map and a scan made at a pose (3,)."""

    def fail_target(self, reason: str) -> None:
        """Hear that the present target could not be reached."""


STRATEGIES: dict[str, Callable[[], Strategy]] = {
    'position_probability': lambda: Explorer(ExplorerConfig()),
    'paper': lambda: Explorer(ExplorerConfig(mode='paper')),
    'nearest_frontier': NearestFrontier,
    'visit_all_end_nodes': VisitAllEndNodes,
    'explore_lite': ExploreLite,
    'information_gain': InformationGain,
    'distance_advantage': DistanceAdvantage,
}


@dataclass(eq=False)
class Log:
    """Scan by scan: stamps, poses (3,) true and estimated; coverage over time, end nodes met."""

    stamps_ns: list[int] = field(default_factory=list)
    true_poses: list[Array] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    coverage: list[tuple[float, float]] = field(default_factory=list)
    census: EndNodeCensus = field(default_factory=EndNodeCensus)
    decision_s: list[float] = field(default_factory=list)
    targets: TargetLog = field(default_factory=TargetLog)


class ClosedLoop:
    """Simulator, pipeline, strategy and navigator, each called in turn as the live graph would."""

    def __init__(
        self,
        simulation: Simulation,
        pipeline: Pipeline,
        strategy: Strategy,
        navigator: Navigator,
        kidnapping: Kidnapping | None = None,
    ) -> None:
        self.simulation = simulation
        self.pipeline = pipeline
        self.strategy = strategy
        self.navigator = navigator
        self.kidnapping = kidnapping
        self.log = Log()
        self.decision: Decision | None = None
        self._patch: GridPatch | None = None
        self._scan: Scan | None = None
        self._goal: Array | None = None
        self._T_map_odom = np.zeros(3)
        self._command = (0.0, 0.0)

    def run(self, goal: Coverable, limit_s: float, show: Callable[[float, float], None]) -> Ending:
        """Explore until the strategy is finished or the time is up.

        `show` is told time (s) and coverage now and then.
        """
        moment = self.simulation.sense()
        steps = 0
        while moment.stamp_ns < limit_s * 1e9:
            if moment.scan is not None:
                self._take(moment.scan, moment.T_odom_base)
                if len(self.log.poses) % _MEASURE_SCANS == 1:
                    show(*self._measure(goal))
                if self.is_finished:
                    break
            if steps % _CONTROL_STEPS == 0:
                self._control(moment)
            moment = self.simulation.step(*self._command)
            steps = steps + 1
        self.pipeline.finish()
        show(*self._measure(goal))
        finished = self.decision is not None and self.is_finished
        reason = (
            self.decision.reason
            if self.decision is not None and finished
            else f'time limit of {limit_s:.0f} s'
        )
        return Ending(finished, reason, self.simulation.robot.collisions)

    @property
    def is_finished(self) -> bool:
        """Whether the strategy has nothing left to do; a lost robot has."""
        lost = self.kidnapping is not None and self.kidnapping.is_lost
        return self.decision is not None and self.decision.finished and not lost

    def _take(self, scan: Scan, T_odom_base: Array) -> None:
        """One scan through localization, map and graph to a decision."""
        if self.kidnapping is not None and self.kidnapping.takes(self, scan, T_odom_base):
            return
        estimate = self.pipeline.step(scan, T_odom_base).estimate
        self.note(scan, estimate)
        if self.kidnapping is None or not self.kidnapping.is_lost:
            self.decide(scan, estimate)

    def note(self, scan: Scan, estimate: Estimate) -> None:
        """Log where the robot is, and where it thinks that it is."""
        self.log.stamps_ns.append(scan.stamp_ns)
        self.log.poses.append(estimate.T_map_base)
        self.log.true_poses.append(self.simulation.robot.T_world_base)
        if self.kidnapping is not None:
            self.kidnapping.hear(self, scan, estimate)

    def decide(self, scan: Scan, estimate: Estimate) -> None:
        """Say where to go, by the map as it is now."""
        self._scan = scan
        self._T_map_odom = estimate.T_map_odom
        self._patch = self.pipeline.grid.patch()
        # The processor's time: what else the machine does is not the strategy's.
        began = time.thread_time()
        self.decision = self.strategy.step(
            self.pipeline.topology.map, self._patch, scan, estimate.T_map_base
        )
        self.log.decision_s.append(time.thread_time() - began)
        self.log.census.take(
            [(n.node_id, n.x, n.y) for n in self.decision.end_nodes], estimate.T_map_base
        )
        target = self.decision.target
        self.log.targets.take(None if target is None else target.goal)
        if target is None:
            self.navigator.cancel()
            self._goal = None
        elif self._goal is None or not np.array_equal(target.goal, self._goal):
            self._goal = target.goal
            self.navigator.set_goal(*(float(number) for number in target.goal))

    def drive_by(self, pipeline: Pipeline, strategy: Strategy, navigator: Navigator) -> None:
        """Have other parts decide where to go from now on."""
        self.navigator.cancel()
        self.pipeline = pipeline
        self.strategy = strategy
        self.navigator = navigator
        self.decision = None
        self._patch = None
        self._goal = None
        self._command = (0.0, 0.0)

    def _control(self, moment: Moment) -> None:
        if self._patch is None:
            return
        T_map_base = se2.compose(self._T_map_odom, moment.T_odom_base)
        command = self.navigator.step(
            T_map_base, self._patch, self._scan, _CONTROL_STEPS * STEP_NS / 1e9
        )
        self._command = (command.v, command.w)
        if command.state == 'failed':
            self.strategy.fail_target(command.reason)
        if command.state in ('failed', 'reached'):
            self._goal = None

    def _measure(self, goal: Coverable) -> tuple[float, float]:
        seconds = self.simulation.stamp_ns / 1e9
        self.log.coverage.append((seconds, goal.share_known(self.pipeline.grid.patch())))
        return self.log.coverage[-1]


def true_pose_source(simulation: Simulation) -> Callable[[Scan, Array], Estimate]:
    """Takes the localizer's place: the simulator's own pose."""

    def locate(scan: Scan, T_odom_base: Array) -> Estimate:
        T_map_base = simulation.robot.T_world_base
        return Estimate(
            T_map_base, np.zeros((3, 3)), se2.compose(T_map_base, se2.invert(T_odom_base))
        )

    return locate


@dataclass(frozen=True)
class Options:
    """What an exploration is run with, beside world and start."""

    strategy: str = 'position_probability'
    seed: int = 0
    speed_m_s: float = 0.2
    localization: str = 'truth'
    robot: str = '2dx'
    laser: Lms200Config = field(default_factory=Lms200Config)
    time_limit_s: float = 20_000.0
    kidnap_at_s: float | None = None


def make_loop(world: World, start: Array, options: Options) -> ClosedLoop:
    """All parts as the options want them."""
    simulation = Simulation(world, start, PRESETS[options.robot], options.laser, options.seed)
    x, y, theta = (float(number) for number in start)
    localizer = ScanLocalizerConfig(start_x_m=x, start_y_m=y, start_yaw_rad=theta)
    source = true_pose_source(simulation) if options.localization == 'truth' else None
    # A beam that met nothing has seen as far as this laser can.
    grid = OccupancyConfig(no_return_range_m=options.laser.range_max_m)
    pipeline = Pipeline(
        PipelineConfig(localizer=localizer, grid=grid, scans_per_graph=SCANS_PER_GRAPH), source
    )
    navigator = Navigator(NavigatorConfig(max_speed_m_s=options.speed_m_s))
    kidnapping = (
        None if options.kidnap_at_s is None else Kidnapping(options.kidnap_at_s, options.seed)
    )
    return ClosedLoop(simulation, pipeline, STRATEGIES[options.strategy](), navigator, kidnapping)


def nothing_to_show(seconds: float, coverage: float) -> None:
    """Take the place of a progress bar."""


def explore(
    world: World,
    start: Array,
    options: Options,
    show: Callable[[float, float], None] = nothing_to_show,
) -> tuple[ClosedLoop, dict[str, Any]]:
    """Explore a world from a start (3,); returns what is left of it and the report."""
    loop = make_loop(world, start, options)
    goal = coverable(world, start, PRESETS[options.robot].radius_m, options.laser.range_max_m)
    began = time.perf_counter()
    cpu_began = time.process_time()
    ending = loop.run(goal, options.time_limit_s, show)
    wall_s = time.perf_counter() - began
    cpu_s = time.process_time() - cpu_began
    log = loop.log
    report = exploration_report(
        ending,
        np.array(log.stamps_ns) / 1e9,
        np.array(log.true_poses),
        np.array(log.poses),
        np.array(log.coverage),
        log.census,
    )
    report['target_changes'] = log.targets.changes
    report['reversals'] = log.targets.reversals
    milliseconds = 1e3 * np.array(log.decision_s)
    report['decision_ms'] = {
        'median': round(float(np.median(milliseconds)), 2),
        'max': round(milliseconds.max(), 2),
    }
    report |= {} if loop.kidnapping is None else loop.kidnapping.report()
    report['world'] = world.name
    report['strategy'] = options.strategy
    report['options'] = asdict(options)
    report['wall_s'] = round(wall_s, 3)
    report['cpu_s'] = round(cpu_s, 3)
    return loop, report


def write_outputs(loop: ClosedLoop, report: dict[str, Any], folder: Path) -> None:
    """Write all files into a folder."""
    log = loop.log
    pipeline = loop.pipeline
    patch = pipeline.grid.patch()
    topology = pipeline.topology.map
    folder.mkdir(parents=True, exist_ok=True)
    trajectory_files.write_tum(folder / 'trajectory.tum', log.stamps_ns, log.poses)
    map_files.write_map(folder / 'map', patch)
    graph_files.write_geojson(folder / 'topology.geojson', topology)
    title = (
        f'{report["world"]}: {report["coverage"]:.1%} in {report["time"]:.0f} s, '
        f'{report["distance"]:.0f} m'
    )
    poses = np.array(log.poses)
    true_poses = np.array(log.true_poses)
    figures.summary_figure(folder / 'summary.png', patch, topology, poses, true_poses, title=title)
    write_text(folder / 'report.json', json.dumps(report, indent=2) + '\n')


def _start(world: World, given: str | None) -> Array:
    if given is None:
        if not np.isfinite(world.start).all():
            raise InputError(
                f'{world.name}: the world names no start: give one with --start=X,Y,THETA'
            )
        return world.start
    try:
        x, y, theta = (float(word) for word in given.split(','))
    except ValueError:
        raise InputError(f'--start={given}: expected three numbers X,Y,THETA (m, m, rad)') from None
    if not all(math.isfinite(number) for number in (x, y, theta)):
        raise InputError(f'--start={given}: expected finite numbers')
    return se2.pose(x, y, theta)


def options_from(arguments: argparse.Namespace, strategy: str) -> Options:
    """Options as given on the command line (see add_options), for one strategy."""
    return Options(
        strategy=strategy,
        seed=arguments.seed,
        speed_m_s=arguments.speed,
        localization=arguments.localization,
        robot=arguments.robot,
        laser=cli.config_from(arguments, Lms200Config),
        time_limit_s=arguments.time_limit,
        kidnap_at_s=arguments.kidnap_at,
    )


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that every run in a simulated world has."""
    parser.add_argument('--seed', type=int, default=0, help='decides all noise (default 0)')
    parser.add_argument('--speed', type=float, default=0.2, help='speed limit, m/s (default 0.2)')
    parser.add_argument('--localization', default='truth', choices=('truth', 'slam'))
    parser.add_argument('--robot', default='2dx', choices=sorted(PRESETS))
    parser.add_argument(
        '--time-limit', type=float, default=20_000.0, help='simulated time to give up at, s'
    )
    parser.add_argument(
        '--kidnap-at', type=float, help='carry the robot off after so many simulated s (with slam)'
    )
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    cli.add_config(parser, Lms200Config, ['beams', 'field_of_view_deg', 'range_max_m'])


def _work(arguments: argparse.Namespace) -> None:
    world = World.from_patch(*read_world(arguments.world))
    options = options_from(arguments, arguments.strategy)
    if options.kidnap_at_s is not None and options.localization == 'truth':
        raise InputError(
            '--kidnap-at: a robot that knows the truth is never lost: expected --localization=slam'
        )
    with tqdm(
        total=100, unit='%', disable=arguments.quiet, bar_format='{l_bar}{bar}| {postfix}'
    ) as bar:

        def show(seconds: float, coverage: float) -> None:
            bar.set_postfix_str(f'{seconds:.0f} s simulated', refresh=False)
            bar.update(100.0 * coverage - bar.n)

        loop, report = explore(world, _start(world, arguments.start), options, show)
    write_outputs(loop, report, arguments.out)
    how = 'finished' if report['finished'] else 'not finished'
    print(
        f'{arguments.out}: {how} ({report["reason"]}), '
        f'coverage {report["coverage"]:.1%}, {report["distance"]:.1f} m, '
        f'{report["time"]:.0f} s simulated in {report["wall_s"]:.1f} s, '
        f'{report["collisions"]} collisions'
    )


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(prog='explore_world', description=__doc__)
    parser.add_argument('world', type=Path, help='world YAML or map_server YAML')
    parser.add_argument('-o', '--out', type=Path, required=True, help='folder for the results')
    parser.add_argument('--strategy', default='position_probability', choices=sorted(STRATEGIES))
    parser.add_argument('--start', help="X,Y,THETA in m, m, rad; without it the world's own")
    add_options(parser)
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
