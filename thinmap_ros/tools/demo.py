"""Demo: a simulated robot explores a room with the live ROS 2 graph, a process per node."""

import argparse
import contextlib
import importlib.util
import json
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from thinmap_ros.core.errors import InputError, ThinmapError
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation import recorded_run
from thinmap_ros.evaluation.exploration_metrics import exploration_title
from thinmap_ros.evaluation.processes import end_with_parent
from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.tools import cli
from thinmap_ros.tools.ros_check import require_ros
from thinmap_ros.view import report_page

# On a busy machine nodes need time to exit; a killed recorder leaves a truncated bag.
_PATIENCE_S = 20.0
_NODES = ('localizer', 'grid_mapper', 'topology_builder', 'explorer', 'navigator', 'recorder')
# Subscribers of /scan: simulated time waits for all of them.
_SCAN_LISTENERS = 4
_SLEEP_S = 0.05


@dataclass(eq=False)
class Processes:
    """Processes that end together, each in its own process group, with its output in a file."""

    folder: Path
    running: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def start(self, name: str, arguments: list[str], quiet: bool = True) -> None:
        """Start a node; its output goes to NAME.log, or, unless quiet, to our output."""
        command = [sys.executable, '-m', f'thinmap_ros.nodes.{name}', '--ros-args', *arguments]
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / f'{name}.log').open('wb') as log:
            self.running[name] = subprocess.Popen(
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

    def stop(self) -> None:
        """Send SIGTERM to every group, and SIGKILL to those that still run a little later."""
        # Unlike SIGINT it ends importing processes without a traceback.
        self._signal(signal.SIGTERM)
        until = time.monotonic() + _PATIENCE_S
        while time.monotonic() < until and any(p.poll() is None for p in self.running.values()):
            time.sleep(_SLEEP_S)
        self._signal(signal.SIGKILL)
        for process in self.running.values():
            process.wait()

    def _signal(self, number: int) -> None:
        for process in self.running.values():
            if process.poll() is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, number)


def _raise_interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def explore(arguments: argparse.Namespace, world: Path, start: Array) -> None:
    """Run the graph until the exploration has ended. Raises ThinmapError if a node exits early."""
    out: Path = arguments.out
    processes = Processes(out / 'log')
    sim_time = ['-p', 'use_sim_time:=true']
    pose = [f'-p initial_x_m:={start[0]} -p initial_y_m:={start[1]} -p initial_yaw_rad:={start[2]}']
    extra = {
        'localizer': ' '.join(pose).split(),
        'navigator': ['-p', f'controller.max_speed_m_s:={arguments.speed}'],
        'recorder': ['-p', f'bag:={out / "bag"}'],
    }
    common = ['-p', f'world:={world}', '-p', f'robot:={arguments.robot}']
    try:
        for name in _NODES:
            processes.start(name, sim_time + extra.get(name, []))
        lockstep = [
            '-p',
            'lockstep:=local_topology',
            '-p',
            f'wait_for_subscribers:={_SCAN_LISTENERS}',
        ]
        clock = ['-p', f'real_time_factor:={arguments.rate}', '-p', f'seed:={arguments.seed}']
        where = ['-p', f'start:={start[0]},{start[1]},{start[2]}']
        processes.start('sim', common + lockstep + clock + where)
        limit = [
            '-p',
            f'time_limit_s:={arguments.time_limit}',
            '-p',
            f'result:={out / "result.json"}',
        ]
        if arguments.view:
            processes.start('rerun_viewer', sim_time)
        processes.start('demo_monitor', sim_time + common + limit, quiet=False)
        _wait(processes)
    finally:
        processes.stop()


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
    for name in ('result.json', *recorded_run.FILES):
        (out / name).unlink(missing_ok=True)


def _choose_domain() -> None:
    """Choose a separate ROS domain, unless the user has set one, to isolate simultaneous demos."""
    if 'ROS_DOMAIN_ID' not in os.environ:
        os.environ['ROS_DOMAIN_ID'] = str(random.SystemRandom().randrange(1, 102))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    print(f'ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}', file=sys.stderr)


def _work(arguments: argparse.Namespace) -> None:
    require_ros()
    if arguments.view and importlib.util.find_spec('rerun') is None:
        raise InputError('--view: rerun is not installed: pip install "thinmap_ros[viewer]"')
    world = package_data.world_path(arguments.world)
    _, _, start = read_world(world)
    signal.signal(signal.SIGTERM, _raise_interrupt)
    _prepare(arguments.out)
    _choose_domain()
    explore(arguments, world, start)
    result = json.loads((arguments.out / 'result.json').read_text())
    report = recorded_run.write(arguments.out, world, arguments.robot, result)
    report_page.write(arguments.out, exploration_title(report), report, cli.command_line())
    print(
        f'{result["reason"]}: {100.0 * report["coverage"]:.1f} % seen, {report["distance"]:.1f} m, '
        f'{report["time"]:.1f} s, {report["collisions"]} collisions; results in {arguments.out}'
    )
    print(_next_steps(arguments.out))


def _next_steps(out: Path) -> str:
    """Where the results are shown, and commands to try next."""
    folder = out.parent
    after = ' (after `source scripts/env`)' if cli.is_module() else ''
    commands = (
        cli.command_of('explore_world', 'office', '-o', str(folder / 'office')),
        cli.command_of('replay', str(out / 'bag'), '-o', str(folder / 'replay')),
        cli.command_of('demo', '--world', 'office', '-o', str(folder / 'demo_office')),
    )
    return '\n'.join(
        [
            f'pictures and figures: {out / report_page.NAME}',
            f'try next{after}:',
            *(f'  {command}' for command in commands),
        ]
    )


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(prog='demo', description=__doc__)
    parser.add_argument(
        '--world', default='room_10x10', help='world or map YAML file, or a world of the package'
    )
    parser.add_argument(
        '--robot', default='2dx', choices=tuple(PRESETS), help='which Pioneer (default 2dx)'
    )
    parser.add_argument('--speed', type=float, default=0.2, help='top speed, m/s (default 0.2)')
    parser.add_argument('--seed', type=int, default=0, help='decides all noise (default 0)')
    parser.add_argument(
        '--rate', type=float, default=5.0, help='simulated seconds a second, at most (default 5)'
    )
    parser.add_argument(
        '--time-limit', type=float, default=0.0, help='simulated seconds, 0: none (default)'
    )
    parser.add_argument(
        '-o', '--out', type=Path, default=Path('out/demo'), help='folder for the results (out/demo)'
    )
    parser.add_argument('--view', action='store_true', help='show it in rerun')
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
