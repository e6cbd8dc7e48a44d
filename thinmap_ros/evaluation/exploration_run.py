"""Exploration of a simulated world by one robot or several, with a report."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.closed_loop.kidnapping import KidnappedRobot
from thinmap_ros.closed_loop.loop import (
    DEFAULT_TEAM,
    ClosedLoop,
    ExplorationOutcome,
    TeamOptions,
    make_loop,
    no_progress,
)
from thinmap_ros.closed_loop.maps import OwnMaps
from thinmap_ros.closed_loop.robot import Options, SimulatedRobot
from thinmap_ros.core.config import config_or_default
from thinmap_ros.core.errors import pose_of, require_type, with_known_keywords
from thinmap_ros.core.exploration.strategy import Decision
from thinmap_ros.core.se2 import Array, path_length_m
from thinmap_ros.evaluation.exploration_metrics import (
    MILESTONES,
    EndNodeCensus,
    TargetLog,
    exploration_report,
    first_time,
    missing_area_report,
)
from thinmap_ros.files.package_data import world_path
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.coverage import ObservableCells, robot_observable_cells
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World


def observable_cells(world: World, start: Array, options: Options) -> ObservableCells:
    """What a robot that starts at a pose (3,) can see of a world."""
    return robot_observable_cells(world, start, PRESETS[options.robot], options.laser.range_max_m)


@with_known_keywords
def explore(
    world: World | Path | str,
    start: Array | None = None,
    options: Options | None = None,
    show: Callable[[float, float], None] = no_progress,
) -> tuple[SimulatedRobot, dict[str, Any]]:
    """Explore a world from a start (3,); returns the robot afterwards and the report.

    world: or its file, or the name of a world of the package. start: that of the world, if none is
    given. Raises InputError where it is no world or the start no pose, ConfigError for other
    options.
    """
    if isinstance(world, str | Path):
        world = World.from_patch(*read_world(world_path(world)))
    require_type('world', world, World)
    start = pose_of('start', world.start if start is None else start)
    options = config_or_default(options, Options)
    loop, report = explore_together(world, [start], options, show=show)
    return loop.robots[0], report


def explore_together(
    world: World,
    starts: Sequence[Array],
    options: Options,
    team: TeamOptions = DEFAULT_TEAM,
    show: Callable[[float, float], None] = no_progress,
) -> tuple[ClosedLoop, dict[str, Any]]:
    """Explore a world from several starts (3,); returns the finished loop and the report.

    From one start it is that of a robot alone.
    """
    loop = make_loop(world, starts, options, team)
    goal = observable_cells(world, starts[0], options)
    census = EndNodeCensus()
    targets = TargetLog()

    def watch(decision: Decision, T_map_base: Array) -> None:
        census.add([(n.node_id, n.x, n.y) for n in decision.end_nodes], T_map_base)
        targets.add(None if decision.target is None else decision.target.goal)

    loop.robots[0].watch = watch
    began = time.perf_counter()
    cpu_began = time.process_time()
    outcome = loop.run(goal, options.time_limit_s, show)
    about = {
        'world': world.name,
        'strategy': options.strategy,
        'options': asdict(options),
        'wall_s': round(time.perf_counter() - began, 3),
        'cpu_s': round(time.process_time() - cpu_began, 3),
    }
    if len(starts) == 1:
        return loop, _report(loop, outcome, census, targets) | about
    decision_s = [round(sum(robot.log.decision_s), 3) for robot in loop.robots]
    report = _team_report(loop, outcome, starts, goal)
    return loop, {**report, **about, 'team': asdict(team), 'decision_s': decision_s}


def _report(
    loop: ClosedLoop, outcome: ExplorationOutcome, census: EndNodeCensus, targets: TargetLog
) -> dict[str, Any]:
    (robot,) = loop.robots
    log = robot.log
    milliseconds = 1e3 * np.array(log.decision_s)
    report = exploration_report(
        outcome,
        np.array(log.stamps_ns) / 1e9,
        np.array(log.true_poses),
        np.array(log.poses),
        np.array(loop.coverage),
        census,
    )
    report['target_changes'] = targets.changes
    report['reversals'] = targets.reversals
    report['decision_ms'] = {
        'median': round(float(np.median(milliseconds)), 2),
        'max': round(milliseconds.max(), 2),
    }
    report['missing_area'] = _missing_area(robot.mission.decision)
    if isinstance(robot, KidnappedRobot):
        report |= robot.report()
    return report


def _missing_area(decision: Decision | None) -> dict[str, Any] | None:
    if decision is None:
        return None
    hidden = [(node.x, node.y, node.expected_area_m2) for node in decision.end_nodes]
    return missing_area_report(decision.missing, hidden)


def _team_report(
    loop: ClosedLoop, outcome: ExplorationOutcome, starts: Sequence[Array], goal: ObservableCells
) -> dict[str, Any]:
    distances = [path_length_m(np.array(robot.log.true_poses)) for robot in loop.robots]
    coverage = np.array(loop.coverage)
    return {
        'finished': outcome.finished,
        'reason': outcome.reason,
        'coverage': round(float(coverage[-1, 1]), 5),
        'distance': round(sum(distances), 3),
        'time': round(loop.now_s, 3),
        'time_at': {f'{share:.2f}': first_time(coverage, share) for share in MILESTONES},
        'collisions': outcome.collisions,
        'robots': [
            {
                'name': robot.name,
                'start': [round(float(number), 3) for number in start],
                'coverage': round(goal.coverage(loop.maps.view(number)[1]), 5),
                'distance': round(distance, 3),
                'collisions': robot.simulation.robot.collisions,
                'yielded_s': round(robot.yielded_s, 1),
            }
            for number, (robot, start, distance) in enumerate(
                zip(loop.robots, starts, distances, strict=True)
            )
        ],
        'bytes_per_m': {
            kind: round(sent / max(sum(distances), 1.0), 1)
            for kind, sent in _sent_bytes(loop).items()
        },
        'curve': [[round(float(at), 2), round(float(share), 4)] for at, share in coverage],
    }


def _sent_bytes(loop: ClosedLoop) -> dict[str, int]:
    """Bytes that all robots have sent, each message once, by kind."""
    sent = {'claims': loop.claims.sent_bytes}
    if isinstance(loop.maps, OwnMaps):
        sent['tiles'] = loop.maps.tiles.sent_bytes
    return sent
