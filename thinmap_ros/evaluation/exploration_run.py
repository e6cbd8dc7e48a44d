"""Exploration of a simulated world, with a report."""

import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np

from thinmap_ros.closed_loop import ClosedLoop, Options, make_loop, no_progress
from thinmap_ros.core.config import config_or_default
from thinmap_ros.core.errors import pose_of, require_type
from thinmap_ros.core.exploration.strategy import Decision
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation.exploration_metrics import (
    EndNodeCensus,
    TargetLog,
    exploration_report,
    missing_area_report,
)
from thinmap_ros.evaluation.kidnapping import Kidnapping
from thinmap_ros.sim.coverage import robot_observable_cells
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World


def explore(
    world: World,
    start: Array,
    options: Options | None = None,
    show: Callable[[float, float], None] = no_progress,
) -> tuple[ClosedLoop, dict[str, Any]]:
    """Explore a world from a start (3,); returns the finished loop and the report.

    Raises InputError where it is no world or the start no pose, ConfigError for other options.
    """
    require_type('world', world, World)
    start = pose_of('start', start)
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
    goal = robot_observable_cells(world, start, PRESETS[options.robot], options.laser.range_max_m)
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
    report['world'] = world.name
    report['strategy'] = options.strategy
    report['options'] = asdict(options)
    report['wall_s'] = round(wall_s, 3)
    report['cpu_s'] = round(cpu_s, 3)
    return loop, report


def _missing_area(decision: Decision | None) -> dict[str, Any] | None:
    if decision is None:
        return None
    hidden = [(node.x, node.y, node.expected_area_m2) for node in decision.end_nodes]
    return missing_area_report(decision.missing, hidden)
