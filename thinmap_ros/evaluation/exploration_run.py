"""Exploration of a simulated world, with a report."""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.closed_loop import (
    ClosedLoop,
    ExplorationOutcome,
    Options,
    make_loop,
    no_progress,
)
from thinmap_ros.core import se2
from thinmap_ros.core.config import config_or_default
from thinmap_ros.core.errors import InputError, pose_of, require_type, with_known_keywords
from thinmap_ros.core.exploration.strategy import Decision
from thinmap_ros.core.places.active_search import ActiveSearch
from thinmap_ros.core.places.global_localizer import GlobalLocalization
from thinmap_ros.core.planning.navigator import Command
from thinmap_ros.core.scan import Scan, with_newest
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stage import Estimate
from thinmap_ros.evaluation.exploration_metrics import (
    EndNodeCensus,
    TargetLog,
    exploration_report,
    missing_area_report,
)
from thinmap_ros.files.package_data import world_path
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.coverage import ObservableCells, robot_observable_cells
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World
from thinmap_ros.team.loop import TeamLoop


@dataclass(frozen=True)
class _Criteria:
    """Where a robot is put, and which pose is right.

    far_m: distance from its place, or more. margin_m: between robot and walls. right_m, right_rad:
    largest errors of a right pose.
    """

    far_m: float
    margin_m: float
    right_m: float
    right_rad: float


_CRITERIA = _Criteria(far_m=3.0, margin_m=0.1, right_m=0.5, right_rad=math.radians(10.0))


class Kidnapping:
    """Teleports the robot of a closed loop once to a random place of its map.

    When its localizer is lost, global localization starts, and drives the robot, as the node
    global_localizer does, to where the places in question differ.
    """

    def __init__(self, at_s: float, seed: int) -> None:
        self._at_s = at_s
        self._seed = seed
        self._carried_s: float | None = None
        self._detected_s: float | None = None
        self._found_s: float | None = None
        self._off: Array | None = None
        self._travelled_m = 0.0
        self._finder: GlobalLocalization | None = None
        self._search: ActiveSearch | None = None
        self._scans: tuple[Scan, ...] = ()  # the newest of each laser

    def report(self) -> dict[str, Any]:
        """Results for the report: times in s, None for events that did not happen."""

        def after(since: float | None, until: float | None) -> float | None:
            return None if since is None or until is None else round(until - since, 3)

        off = self._off
        right: bool | None = None
        if off is not None:
            is_near = math.hypot(off[0], off[1]) <= _CRITERIA.right_m
            right = bool(is_near and abs(off[2]) <= _CRITERIA.right_rad)
        return {
            'kidnapped_at_s': self._carried_s,
            'detected_after_s': after(self._carried_s, self._detected_s),
            'found_after_s': after(self._detected_s, self._found_s),
            'found_after_m': None if self._found_s is None else round(self._travelled_m, 3),
            'found_error_m': None if off is None else round(math.hypot(off[0], off[1]), 3),
            'found_right': right,
        }

    @property
    def is_lost(self) -> bool:
        """Whether global localization is running."""
        return self._finder is not None

    def intercepts(self, loop: ClosedLoop, scan: Scan, T_odom_base: Array) -> bool:
        """Whether the loop must ignore a scan: before the robot is placed, or while it is lost."""
        if self._carried_s is None and scan.stamp_ns >= 1e9 * self._at_s:
            self._kidnap(loop, scan.stamp_ns / 1e9)
            return True
        if self._finder is None:
            return False
        self._look(loop, self._finder, scan, T_odom_base)
        return True

    def command(self, T_odom_base: Array, period_s: float) -> Command:
        """Command of the lost robot at a pose (3,) of its odometry."""
        assert self._search is not None
        if not self._scans:
            return Command(0.0, 0.0, 'idle')
        return self._search.step(T_odom_base, self._scans, period_s)

    def add_estimate(self, loop: ClosedLoop, scan: Scan, estimate: Estimate) -> None:
        """Start global localization when the robot is lost."""
        if (
            estimate.is_lost
            and self._finder is None
            and self._carried_s is not None
            and self._found_s is None
        ):
            self._detected_s = scan.stamp_ns / 1e9
            self._finder = GlobalLocalization(
                loop.pipeline.grid.known_area(), loop.pipeline.topology.map, seed=self._seed
            )
            driving = loop.navigator.config
            self._search = ActiveSearch(self._finder.places, self._finder.config, driving)
            loop.decide_anew()

    def _kidnap(self, loop: ClosedLoop, seconds: float) -> None:
        """Teleport the robot to a random mapped place far from its position."""
        world = loop.simulation.world
        robot = loop.simulation.robot
        patch = loop.pipeline.grid.known_area()
        at = patch.frame.centres_of(np.argwhere(patch.free))
        at = at[np.hypot(*(at - robot.T_world_base[:2]).T) >= _CRITERIA.far_m]
        clearance_m = robot.config.radius_m + _CRITERIA.margin_m
        fits = [world.is_clear(x, y, clearance_m) for x, y in at.tolist()]
        if not any(fits) or not loop.pipeline.topology.map.nodes:
            raise InputError(
                f'--kidnap-at-s={self._at_s:g}: no mapped place with a graph is '
                f'{_CRITERIA.far_m:g} m away: '
                'expected a later time'
            )
        rng = np.random.default_rng(self._seed)
        x, y = rng.choice(at[fits])
        loop.simulation.teleport(
            se2.pose(float(x), float(y), float(rng.uniform(-math.pi, math.pi)))
        )
        self._carried_s = seconds

    def _look(
        self, loop: ClosedLoop, finder: GlobalLocalization, scan: Scan, T_odom_base: Array
    ) -> None:
        """Process a scan of a lost robot, with both of its localizers."""
        assert self._search is not None
        localizer = loop.pipeline.localizer
        T_world_base = loop.simulation.robot.T_world_base
        estimate = loop.pipeline.step(scan, T_odom_base).estimate
        self._travelled_m += float(np.hypot(*(T_world_base - loop.log.true_poses[-1])[:2]))
        loop.log_poses(scan, estimate)
        result = finder.step(scan, T_odom_base)
        self._search.take(result, T_odom_base)
        self._scans = with_newest(self._scans, scan)
        found = result.pose
        if found is not None:
            localizer.set_pose(found.T_map_base, found.covariance)
        if found is not None or not estimate.is_lost:
            self._found_s = scan.stamp_ns / 1e9
            self._off = se2.between(T_world_base, localizer.pose)
            self._finder = None
            loop.decide_anew()


def observable_cells(world: World, start: Array, options: Options) -> ObservableCells:
    """What a robot that starts at a pose (3,) can see of a world."""
    return robot_observable_cells(world, start, PRESETS[options.robot], options.laser.range_max_m)


def run_timed(
    loop: ClosedLoop | TeamLoop,
    goal: ObservableCells,
    options: Options,
    show: Callable[[float, float], None],
) -> tuple[ExplorationOutcome, dict[str, Any]]:
    """Run a loop; returns how it ended, and for its report the options and the time that it took.

    goal: the cells to see; show: as of the loop.
    """
    began = time.perf_counter()
    cpu_began = time.process_time()
    outcome = loop.run(goal, options.time_limit_s, show)
    return outcome, {
        'strategy': options.strategy,
        'options': asdict(options),
        'wall_s': round(time.perf_counter() - began, 3),
        'cpu_s': round(time.process_time() - cpu_began, 3),
    }


@with_known_keywords
def explore(
    world: World | Path | str,
    start: Array | None = None,
    options: Options | None = None,
    show: Callable[[float, float], None] = no_progress,
) -> tuple[ClosedLoop, dict[str, Any]]:
    """Explore a world from a start (3,); returns the finished loop and the report.

    world: or its file, or the name of a world of the package. start: that of the world, if none is
    given. Raises InputError where it is no world or the start no pose, ConfigError for other
    options.
    """
    if isinstance(world, str | Path):
        world = World.from_patch(*read_world(world_path(world)))
    require_type('world', world, World)
    start = pose_of('start', world.start if start is None else start)
    options = config_or_default(options, Options)
    census = EndNodeCensus()
    targets = TargetLog()

    def watch(decision: Decision, T_map_base: Array) -> None:
        census.add([(n.node_id, n.x, n.y) for n in decision.end_nodes], T_map_base)
        targets.add(None if decision.target is None else decision.target.goal)

    kidnapping = (
        None if options.kidnap_at_s is None else Kidnapping(options.kidnap_at_s, options.seed)
    )
    loop = make_loop(world, start, options, kidnapping, watch)
    goal = observable_cells(world, start, options)
    ending, about = run_timed(loop, goal, options, show)
    log = loop.log
    report = exploration_report(
        ending,
        np.array(log.stamps_ns) / 1e9,
        np.array(log.true_poses),
        np.array(log.poses),
        np.array(log.coverage),
        census,
    )
    report['target_changes'] = targets.changes
    report['reversals'] = targets.reversals
    milliseconds = 1e3 * np.array(log.decision_s)
    report['decision_ms'] = {
        'median': round(float(np.median(milliseconds)), 2),
        'max': round(milliseconds.max(), 2),
    }
    report['missing_area'] = _missing_area(loop.decision)
    report |= {} if kidnapping is None else kidnapping.report()
    return loop, {**report, 'world': world.name, **about}


def _missing_area(decision: Decision | None) -> dict[str, Any] | None:
    if decision is None:
        return None
    hidden = [(node.x, node.y, node.expected_area_m2) for node in decision.end_nodes]
    return missing_area_report(decision.missing, hidden)
