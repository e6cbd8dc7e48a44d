"""Explores a simulated world without ROS, faster than real time."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.closed_loop.loop import ClosedLoop, TeamOptions
from thinmap_ros.closed_loop.radio import Trouble
from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation.exploration_metrics import exploration_title, hidden_places
from thinmap_ros.evaluation.exploration_run import explore_together
from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.other_robots import MAX_ROBOTS, starts_side_by_side
from thinmap_ros.sim.robot import LASERS, PRESETS
from thinmap_ros.sim.world import World
from thinmap_ros.strategies import DEFAULT, NAMES, check_strategy
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser, add_out, out_folder
from thinmap_ros.view.progress_bar import ProgressBar
from thinmap_ros.view.run_folder import RunResult, write_report, write_run

MAX_DELAY_S = 1000.0
WORLD_HELP = "world YAML, map_server YAML, or the name of one of the package's worlds"


def write_outputs(loop: ClosedLoop, report: dict[str, Any], folder: Path) -> None:
    """Write all files into a folder; of several robots trajectories for each."""
    title = exploration_title(report)
    logs = {f'trajectory_{robot.name}': robot.log for robot in loop.robots}
    shown: dict[str, Any] = {
        'robots': {robot.name: np.array(robot.log.true_poses) for robot in loop.robots}
    }
    estimated = np.empty((0, 3))
    if len(loop.robots) == 1:
        (robot,) = loop.robots
        logs = {'trajectory': robot.log}
        estimated = np.array(robot.log.poses)
        shown = {
            'true': np.array(robot.log.true_poses),
            'hidden': hidden_places(report),
            'apart': robot.pipeline.localizer.apart_points(),
        }
    trajectories = {name: (log.stamps_ns, log.poses) for name, log in logs.items()}
    for name, log in logs.items():
        trajectories[f'true_{name}'] = (log.stamps_ns, log.true_poses)
    topology, _ = loop.maps.view(0)
    run = RunResult(loop.maps.known_area(), topology, title, trajectories, estimated, shown)
    write_run(folder, run)
    write_report(folder, title, report, cli.command_line())


def _start(world: World, given: str | None) -> Array:
    if given is None:
        if not np.isfinite(world.start).all():
            raise InputError(
                f'{world.name}: the world has no start: give one with --start X,Y,THETA'
            )
        return world.start
    try:
        x, y, *theta = (float(word) for word in given.split(','))
        start = se2.pose(x, y, *theta or (0.0,))
    except (TypeError, ValueError):
        raise InputError(f'--start={given}: expected X,Y or X,Y,THETA (m, m, rad)') from None
    if not np.isfinite(start).all():
        raise InputError(f'--start={given}: expected finite numbers')
    return start


def options_from(arguments: argparse.Namespace, strategy: str) -> Options:
    """Options as given on the command line (see add_options), for one strategy."""
    options = cli.config_from(arguments, Options)
    laser = cli.config_from(arguments, LaserScannerConfig, LASERS.get(options.robot))
    return replace(options, strategy=strategy, laser=laser)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the common options of runs in a simulated world."""
    cli.add_config(parser, Options, ['seed', 'speed_m_s', 'localization', 'robot', 'time_limit_s'])
    parser.add_argument(
        '--kidnap-at-s', type=float, help='kidnap the robot at this simulated time, s (with slam)'
    )
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    cli.add_config(
        parser, LaserScannerConfig, ['beams', 'field_of_view_deg', 'range_max_m', 'lasers']
    )


def _check_team(arguments: argparse.Namespace) -> None:
    """Raise InputError where options do not go with several robots."""
    robots = arguments.robots
    if not 1 <= robots <= MAX_ROBOTS:
        raise InputError(f'--robots={robots}: expected 1 to {MAX_ROBOTS}')
    if robots == 1:
        if arguments.claim_delay_s:
            raise InputError('--claim-delay-s: expected --robots of 2 or more')
        if arguments.own_maps:
            raise InputError('--own-maps: expected --robots of 2 or more')
        return
    if arguments.strategy != DEFAULT:
        raise InputError(
            f'--robots={robots}: expected --strategy={DEFAULT}, the only one that shares candidates'
        )
    if arguments.kidnap_at_s is not None:
        raise InputError(f'--robots={robots}: expected no --kidnap-at-s')
    if not 0.0 <= arguments.claim_delay_s <= MAX_DELAY_S:
        raise InputError(
            f'--claim-delay-s={arguments.claim_delay_s:g}: expected 0 to {MAX_DELAY_S:g} s'
        )


def _work(arguments: argparse.Namespace) -> None:
    _check_team(arguments)
    check_strategy(arguments.strategy)
    out = out_folder(arguments.out, Path(arguments.world).stem)
    world = World.from_patch(*read_world(package_data.world_path(arguments.world)))
    options = options_from(arguments, arguments.strategy)
    if options.kidnap_at_s is not None and options.localization == 'truth':
        raise InputError(
            '--kidnap-at-s: expected --localization=slam, because true poses are never lost'
        )
    start = _start(world, arguments.start)
    with ProgressBar('explore_world', arguments.quiet) as bar:

        def show(seconds: float, coverage: float) -> None:
            share = max(coverage, seconds / options.time_limit_s)
            bar.show(share, f'{100.0 * coverage:.0f} % seen, {seconds:.0f} s simulated')

        radius_m = PRESETS[options.robot].radius_m
        starts = starts_side_by_side(world, start, arguments.robots, radius_m)
        trouble = Trouble(claim_delay_s=arguments.claim_delay_s)
        team = TeamOptions(trouble=trouble, has_own_maps=arguments.own_maps)
        loop, report = explore_together(world, starts, options, team, show)
    write_outputs(loop, report, out)
    how = 'finished' if report['finished'] else 'not finished'
    print(
        f'{out}: {how} ({report["reason"]}), '
        f'coverage {report["coverage"]:.1%}, {report["distance"]:.1f} m, '
        f'{report["time"]:.0f} s simulated in {report["wall_s"]:.1f} s, '
        f'{report["collisions"]} collisions'
    )


def main() -> None:
    """Run the program."""
    parser = Parser('explore_world', __doc__)
    parser.add_argument('world', help=WORLD_HELP)
    add_out(parser, 'out/WORLD')
    parser.add_argument(
        '--strategy',
        default=DEFAULT,
        metavar='NAME',
        help=f'{", ".join(NAMES)}, or your own as package.module:factory (default {DEFAULT})',
    )
    parser.add_argument(
        '--start', help="X,Y or X,Y,THETA in m, m, rad (default: the world's own start)"
    )
    parser.add_argument(
        '--robots',
        type=int,
        default=1,
        help='number of robots that explore together, side by side at the start (default 1)',
    )
    parser.add_argument(
        '--claim-delay-s',
        type=float,
        default=0.0,
        help='time that a claim takes from robot to robot, s (default 0)',
    )
    parser.add_argument(
        '--own-maps',
        action='store_true',
        help='each robot has its own map, and sends the others the tiles that have changed; always '
        'so with --localization=slam',
    )
    add_options(parser)
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
