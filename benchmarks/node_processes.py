"""Nodes as processes of a live graph, which may be killed, stopped and started again."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import psutil

from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation.parallel_jobs import end_with_parent
from thinmap_ros.evaluation.ros_domains import use_free_domain

NODES = ('localizer', 'grid_mapper', 'topology_builder', 'navigator', 'explorer')
_STOP_S = 10.0
_LAST_LINES = 300


def use_own_domain() -> None:
    """Let nobody else be on the graph."""
    use_free_domain()
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


def placed_at(pose: Array) -> dict[str, object]:
    """Parameters of a localizer that starts at a pose (3,)."""
    names = ('initial_x_m', 'initial_y_m', 'initial_yaw_rad')
    return {name: f'{value:.9f}' for name, value in zip(names, pose.tolist(), strict=True)}


class Processes:
    """Processes by name.

    Logs are in a folder, and until `close` so is the state that killed nodes leave. speed_m_s: of
    the robot; None: that of the navigator. running: those that are expected to run.
    """

    def __init__(self, folder: Path, speed_m_s: float | None = None) -> None:
        self.running: dict[str, psutil.Popen] = {}
        self._folder = folder
        self._speed_m_s = speed_m_s
        self._initial: dict[str, object] = {}

    def start_nodes(self, T_map_base: Array) -> None:
        """Start all nodes with an empty map and the robot at a pose (3,)."""
        self._remove_state()
        self._initial = placed_at(T_map_base)
        for name in NODES:
            self.start_node(name)

    def start_node(self, name: str) -> None:
        """Start a node, again after it was killed."""
        parameters: dict[str, object] = {'use_sim_time': 'true'}
        if name == 'localizer':
            parameters |= self._initial
        if name == 'navigator' and self._speed_m_s is not None:
            parameters['controller.max_speed_m_s'] = self._speed_m_s
        self.start(name, parameters)

    def start(
        self,
        name: str,
        parameters: Mapping[str, object],
        renamed: Mapping[str, str] | None = None,
        module: str = '',
        arguments: Sequence[str] = (),
    ) -> None:
        """Start a program; module: '' for the node of that name; arguments: before those of ROS."""
        words = [word for old, new in (renamed or {}).items() for word in ('-r', f'{old}:={new}')]
        words += [word for key, value in parameters.items() for word in ('-p', f'{key}:={value}')]
        program = [sys.executable, '-m', module or f'thinmap_ros.nodes.{name}']
        with (self._folder / f'{name}.log').open('ab') as log:
            self.running[name] = psutil.Popen(
                [*program, *arguments, '--ros-args', *words],
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, 'THINMAP_STATE_DIR': str(self._folder / 'state')},
                preexec_fn=end_with_parent,
            )

    def pid(self, name: str) -> int:
        """Number of a process, 0 if it is not running."""
        return int(self.running[name].pid) if name in self.running else 0

    def send(self, name: str, number: int) -> None:
        """Send a signal to a process, which is still expected to run."""
        with suppress(psutil.NoSuchProcess):
            self.running[name].send_signal(number)

    def kill(self, name: str) -> None:
        """Kill a process."""
        process = self.running.pop(name, None)
        if process is not None:
            with suppress(psutil.NoSuchProcess):
                process.kill()
            process.wait()

    def forget(self, name: str) -> None:
        """Remove the checkpoints of a node that was killed, whatever the parts of its state."""
        for path in (self._folder / 'state').glob(f'*.{name}.*'):
            path.unlink()

    def ended(self) -> dict[str, str]:
        """Processes that ended by themselves, with exit code and last line; they are forgotten."""
        found = {}
        for name, process in list(self.running.items()):
            code = process.poll()
            if code is not None:
                del self.running[name]
                found[name] = f'{name} ended with {code}: {self._last_line(name)}'
        return found

    def close(self) -> None:
        """End all processes."""
        running = list(self.running.values())
        for process in running:
            with suppress(psutil.NoSuchProcess):
                process.send_signal(signal.SIGTERM)
                process.send_signal(signal.SIGCONT)
        for process in psutil.wait_procs(running, timeout=_STOP_S)[1]:
            with suppress(psutil.NoSuchProcess):
                process.kill()
                process.wait()
        self.running = {}
        self._remove_state()

    def _remove_state(self) -> None:
        shutil.rmtree(self._folder / 'state', ignore_errors=True)

    def _last_line(self, name: str) -> str:
        lines = (self._folder / f'{name}.log').read_text(errors='replace').splitlines()
        return lines[-1][-_LAST_LINES:] if lines else ''


def processor_s(processes: Iterable[psutil.Process]) -> float:
    """CPU time of processes, s."""
    times = [process.cpu_times() for process in processes]
    return float(sum(each.user + each.system for each in times))
