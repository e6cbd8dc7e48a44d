"""Demo: a simulated robot, or several, explore a room with the live ROS 2 graph.

A process per node; of several robots a process per robot.
"""

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, ThinmapError
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation import recorded_run
from thinmap_ros.evaluation.parallel_jobs import end_with_parent
from thinmap_ros.evaluation.ros_domains import use_free_domain
from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_starts, read_world
from thinmap_ros.sim.other_robots import MAX_ROBOTS, starts_in
from thinmap_ros.sim.robot import LASERS, PRESETS
from thinmap_ros.sim.world import World
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser, add_out, out_folder, require_ros
from thinmap_ros.view import report_page, rerun_sinks

# On a busy machine nodes need time to exit; a killed recorder leaves a truncated bag.
_PATIENCE_S = 20.0
_NODES = ('localizer', 'grid_mapper', 'topology_builder', 'explorer', 'navigator')
_SIM_TIME = ['-p', 'use_sim_time:=true']
# Subscribers of the scans of a robot: simulated time waits for all of them.
_SCAN_LISTENERS = 4
_SLEEP_S = 0.05
_WORLD = 'room_10x10'
_TEAM_WORLD = 'lab'  # large enough that robots which do not know each other's starts gain time
_PORT = 8480
_MAX_PORT = 65535


@dataclass(eq=False)
class Processes:
    """Processes that end together, each in its own process group, with its output in a file."""

    folder: Path
    running: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def start(self, name: str, arguments: list[str], quiet: bool = True, label: str = '') -> None:
        """Start a node; its output goes to LABEL.log, or, unless quiet, to our output.

        label: its name here; '': that of the node.
        """
        label = label or name
        command = [sys.executable, '-m', f'thinmap_ros.nodes.{name}', '--ros-args', *arguments]
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / f'{label}.log').open('wb') as log:
            self.running[label] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log if quiet else None,
                stderr=log if quiet else None,
                start_new_session=True,
                preexec_fn=end_with_parent,
            )

    def ended(self) -> str | None:
        """Name of a process that has ended."""
        return next(
            (name for name, process in self.running.items() if process.poll() is not None), None
        )

    def stop(self, *names: str) -> None:
        """End some processes, or all: by SIGTERM, and those that run a little later by SIGKILL."""
        ended = names or tuple(self.running)
        ending = [self.running[name] for name in ended]
        # Unlike SIGINT it ends importing processes without a traceback.
        self._signal(ending, signal.SIGTERM)
        until = time.monotonic() + _PATIENCE_S
        while time.monotonic() < until and any(process.poll() is None for process in ending):
            time.sleep(_SLEEP_S)
        self._signal(ending, signal.SIGKILL)
        for name, process in zip(ended, ending, strict=True):
            process.wait()
            del self.running[name]

    def _signal(self, processes: Sequence[subprocess.Popen[bytes]], number: int) -> None:
        for process in processes:
            if process.poll() is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, number)


def explore(
    processes: Processes, arguments: argparse.Namespace, world: Path, starts: Sequence[Array]
) -> None:
    """Run the graph until the explorations have ended. Raises ThinmapError if a node exits early.

    starts: pose (3,) of each robot.
    """
    out: Path = arguments.out
    common = _parameters(world=world, robot=arguments.robot)
    listeners = _SCAN_LISTENERS + arguments.view + arguments.web
    lockstep = _parameters(lockstep='local_topology', wait_for_subscribers=listeners)
    clock = _parameters(real_time_factor=arguments.rate, seed=arguments.seed)
    limit = _parameters(time_limit_s=arguments.time_limit_s, result=out / 'result.json')
    is_team = len(starts) > 1
    where = _parameters(start=_text(starts))
    maps = []
    if is_team:
        where = _parameters(robots=len(starts), starts=_text(starts))
        maps = _parameters(map_poses=_text(map_poses(starts)))
    if is_team:
        _start_robots(processes, starts, arguments.speed_m_s)
    else:
        _start_nodes(processes, starts[0], arguments.speed_m_s)
    processes.start('recorder', [*_SIM_TIME, *_parameters(bag=out / 'bag')])
    if arguments.view:
        processes.start('rerun_viewer', _SIM_TIME)
    if arguments.web:
        _start_pages(processes, len(starts), arguments.web_port)
    processes.start('demo_monitor', [*_SIM_TIME, *common, *limit, *maps], quiet=False)
    # The last one: what comes after the first scan is seen sooner.
    processes.start('sim', [*common, *lockstep, *clock, *where])
    _wait(processes)


def _start_nodes(processes: Processes, start: Array, speed: float) -> None:
    """Start a process for each node of a single robot."""
    extra = {
        'localizer': _initial_pose(start),
        'navigator': _parameters({'controller.max_speed_m_s': speed}),
    }
    for name in _NODES:
        processes.start(name, _SIM_TIME + extra.get(name, []))


def _start_robots(processes: Processes, starts: Sequence[Array], speed: float) -> None:
    """Start a process for each robot, with all of its nodes, and one that joins the maps."""
    for number, (start, T_world_map) in enumerate(zip(starts, map_poses(starts), strict=True), 1):
        limit = _parameters({'controller.max_speed_m_s': speed})
        pose = _initial_pose(se2.between(T_world_map, start))
        processes.start('thinmap', [*_in_team(number), *limit, *pose], label=f'robot{number}')
    processes.start('map_joiner', _SIM_TIME)


def _in_team(number: int) -> list[str]:
    """Arguments of a node of one of several robots."""
    remap = ['-r', f'__ns:=/robot{number}', '-r', '/tf:=tf', '-r', '/tf_static:=tf_static']
    return [*remap, *_SIM_TIME, *_parameters(team='true')]


def _start_pages(processes: Processes, count: int, first_port: int) -> None:
    """Start a page for each robot, each at the next port."""
    if count == 1:
        processes.start('web', [*_SIM_TIME, *_parameters(port=first_port)])
        print(f'page at http://127.0.0.1:{first_port}/', file=sys.stderr)
        return
    for number in range(1, count + 1):
        port = first_port + number - 1
        arguments = [*_in_team(number), *_parameters(port=port)]
        processes.start('web', arguments, label=f'web{number}')
        print(f'page of robot {number} at http://127.0.0.1:{port}/', file=sys.stderr)


def map_poses(starts: Sequence[Array]) -> list[Array]:
    """Pose (3,) in the world of the frame of the map of each robot, by their starts.

    That of the first robot is the world, as with a single robot. The map of any other begins at its
    start: the robots do not know the starts of each other.
    """
    return [np.zeros(3), *starts[1:]]


def _parameters(named: Mapping[str, object] | None = None, **values: object) -> list[str]:
    """Arguments that set parameters of a node."""
    given = {**(named or {}), **values}
    return [word for name, value in given.items() for word in ('-p', f'{name}:={value}')]


def _initial_pose(pose: Array) -> list[str]:
    x, y, yaw = (f'{number:.9f}' for number in pose.tolist())
    return _parameters(initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw)


def _text(poses: Sequence[Array]) -> str:
    """Poses (3,) as sim takes them."""
    return ';'.join(','.join(str(number) for number in pose.tolist()) for pose in poses)


def _wait(processes: Processes) -> None:
    while (name := processes.ended()) is None:
        time.sleep(_SLEEP_S)
    code = processes.running[name].returncode
    if name != 'demo_monitor' or code != 0:
        log = processes.folder / f'{name}.log'
        last = (log.read_text(errors='replace').strip().splitlines() or ['no output'])[-1]
        raise ThinmapError(f'{name} ended early with code {code}: {last} (see {log})')


def _prepare(out: Path) -> None:
    """Prepare the folder for the results: delete those of an earlier run, and nothing else."""
    out.mkdir(parents=True, exist_ok=True)
    if (out / 'bag').exists():
        for file in (out / 'bag').iterdir():
            file.unlink()
        (out / 'bag').rmdir()
    robots = [path.name for path in out.glob('trajectory_robot?.tum')]
    for name in ('result.json', *recorded_run.FILES, *robots):
        (out / name).unlink(missing_ok=True)


def _choose_domain() -> None:
    """Choose a separate ROS domain, unless the user has set one, to isolate simultaneous demos."""
    if 'ROS_DOMAIN_ID' not in os.environ:
        use_free_domain()
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    print(f'ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}', file=sys.stderr)


def _starts(arguments: argparse.Namespace, file: Path) -> list[Array]:
    """Start (3,) of each robot. Raises InputError where there are too many, or is no room."""
    count = arguments.robots
    if not 1 <= count <= MAX_ROBOTS:
        raise InputError(f'--robots={count}: expected 1 to {MAX_ROBOTS}')
    last_port = _MAX_PORT + 1 - count
    if not 1 <= arguments.web_port <= last_port:
        raise InputError(f'--web-port={arguments.web_port}: expected 1 to {last_port}')
    if count > 1 and arguments.view:
        raise InputError('--view: expected --robots=1')
    world = World.from_patch(*read_world(file))
    radius_m = PRESETS[arguments.robot].radius_m
    return starts_in(world, world.start, read_starts(file), count, radius_m)


def _work(arguments: argparse.Namespace) -> None:
    require_ros()
    if arguments.view and not rerun_sinks.is_installed():
        raise InputError(f'--view: {rerun_sinks.ADVICE}')
    if arguments.web and find_spec('tornado') is None:
        raise InputError('--web: tornado is not installed: pip install tornado')
    arguments.world = arguments.world or (_WORLD if arguments.robots == 1 else _TEAM_WORLD)
    world = package_data.world_path(arguments.world)
    arguments.out = out_folder(arguments.out, 'demo')
    starts = _starts(arguments, world)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    _prepare(arguments.out)
    _choose_domain()
    processes = Processes(arguments.out / 'log')
    try:
        explore(processes, arguments, world, starts)
        # Robots with a page stay: the results are written beside them.
        processes.stop(*(('recorder', 'demo_monitor') if arguments.web else ()))
        _write_results(arguments, world, starts)
        if arguments.web:
            _stay(processes)
    finally:
        processes.stop()


def _stay(processes: Processes) -> None:
    """Leave the pages open until Ctrl-C. Raises ThinmapError if a node exits early."""
    print('the page stays open: Ctrl-C ends it', file=sys.stderr)
    with contextlib.suppress(KeyboardInterrupt):
        _wait(processes)


def _write_results(arguments: argparse.Namespace, world: Path, starts: Sequence[Array]) -> None:
    result = json.loads((arguments.out / 'result.json').read_text())
    run = (arguments.out, world, arguments.robot, result, map_poses(starts))
    report = recorded_run.write(*run, cli.command_line())
    print(
        f'{report["reason"]}: {100.0 * report["coverage"]:.1f} % seen, '
        f'{report["distance"]:.1f} m, {report["time"]:.1f} s, {report["collisions"]} collisions; '
        f'results in {arguments.out}'
    )
    for line in report.get('joins', []):
        print(f'  joined: {line}')
    if len(starts) > 1:
        print(f'  {_together(report)}')
    print(_next_steps(arguments.out, len(starts)))


def _together(report: dict[str, Any]) -> str:
    """For how long the robots shared what was left: before their maps are joined, they cannot."""
    joined = [robot['joined_at'] for robot in report['robots']]
    if None in joined:
        return 'not all maps were joined: these robots explored alone'
    shared_s = max(report['time'] - max(joined), 0.0)
    return f'explored together for the last {shared_s:.0f} of {report["time"]:.0f} s, alone before'


def _next_steps(out: Path, count: int) -> str:
    """Where the results are shown, and commands to try next, of a number of robots."""
    folder = out.parent
    after = ' (after `source scripts/env`)' if cli.is_module() else ''
    office = ['explore_world', 'office', '-o', str(folder / 'office')]
    world = 'office' if count == 1 else _TEAM_WORLD
    demo = ['demo', '--world', world, '-o', str(folder / f'demo_{world}')]
    robots = [] if count == 1 else ['--robots', str(count)]
    commands = [cli.command_of(*office, *robots), cli.command_of(*demo, *robots)]
    if count == 1:
        replay = cli.command_of('replay', str(out / 'bag'), '-o', str(folder / 'replay'))
        commands.insert(1, replay)
    return '\n'.join(
        [
            f'pictures and figures: {out / report_page.NAME}',
            f'try next{after}:',
            *(f'  {command}' for command in commands),
        ]
    )


def main() -> None:
    """Run the program."""
    parser = Parser('demo', __doc__)
    parser.add_argument(
        '--world',
        help='world or map YAML file, or a world of the package (default '
        f'{_WORLD}, of several robots {_TEAM_WORLD})',
    )
    pioneers = [name for name in PRESETS if name not in LASERS]
    parser.add_argument(
        '--robot', default='2dx', choices=pioneers, help='which Pioneer (default 2dx)'
    )
    parser.add_argument(
        '--robots',
        type=int,
        default=1,
        help='number of robots, each with its own map, in one world (default 1); several gain time '
        'in lab, not in office',
    )
    parser.add_argument('--speed-m-s', type=float, default=0.2, help='top speed, m/s (default 0.2)')
    parser.add_argument('--seed', type=int, default=0, help='decides all noise (default 0)')
    parser.add_argument(
        '--rate', type=float, default=5.0, help='simulated seconds a second, at most (default 5)'
    )
    parser.add_argument(
        '--time-limit-s', type=float, default=0.0, help='simulated seconds, 0: none (default)'
    )
    add_out(parser, 'out/demo')
    parser.add_argument('--view', action='store_true', help='show it in rerun')
    web_help = f'show it in a browser, at http://127.0.0.1:{_PORT}/, until Ctrl-C'
    parser.add_argument('--web', action='store_true', help=web_help)
    port_help = f'of the page; each further robot has the next one (default {_PORT})'
    parser.add_argument('--web-port', type=int, default=_PORT, help=port_help)
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
