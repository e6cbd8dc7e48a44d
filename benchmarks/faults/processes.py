"""Processes of a live graph, which are killed, stopped and started again."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import psutil

from benchmarks.faults.kinds import NODES
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation.parallel_jobs import end_with_parent

_STOP_S = 10.0
_LAST_LINES = 300


class Processes:
    """Processes by name.

    Logs are in a folder, and until `close` so is the state that killed nodes leave. speed_m_s: of
    the robot.
    """

    def __init__(self, folder: Path, speed_m_s: float) -> None:
        self._folder = folder
        self._speed_m_s = speed_m_s
        self._running: dict[str, psutil.Popen] = {}
        self._initial: dict[str, float] = {}

    def start_simulator(self, world: Path, start: Array, rate: float, seed: int) -> None:
        """Start simulator and relay; time stands still until the relay lets it pass."""
        self._start('relay', 'benchmarks.faults.relay', {})
        parameters: dict[str, object] = {
            'world': world,
            'start': ','.join(map(str, start.tolist())),
            'real_time_factor': rate,
            'seed': seed,
            'lockstep': 'local_topology',
            'lockstep_timeout_s': 3600.0,
            'wait_for_subscribers': 1,
        }
        renamed = {'local_topology': 'paced', '/clock': '/raw_clock', '/tf': '/raw_tf'}
        renamed |= {'scan': 'raw_scan', 'odom': 'raw_odom', 'cmd_vel': 'wheels'}
        self._start('sim', 'thinmap_ros.nodes.sim', parameters, renamed)

    def start_nodes(self, T_map_base: Array) -> None:
        """Start all nodes with an empty map and the robot at a pose (3,)."""
        self._remove_state()
        x, y, yaw = T_map_base.tolist()
        self._initial = {'initial_x_m': x, 'initial_y_m': y, 'initial_yaw_rad': yaw}
        for name in NODES:
            self.start_node(name)

    def start_node(self, name: str) -> None:
        """Start a node, again after it was killed."""
        parameters: dict[str, object] = {'use_sim_time': 'true'}
        if name == 'localizer':
            parameters |= self._initial
        if name == 'navigator':
            parameters['controller.max_speed_m_s'] = self._speed_m_s
        self._start(name, f'thinmap_ros.nodes.{name}', parameters)

    def pid(self, name: str) -> int:
        """Number of a process, 0 if it is not running."""
        return int(self._running[name].pid) if name in self._running else 0

    def send(self, name: str, number: int) -> None:
        """Send a signal to a process, which is still expected to run."""
        with suppress(psutil.NoSuchProcess):
            self._running[name].send_signal(number)

    def kill(self, name: str) -> None:
        """Kill a process."""
        process = self._running.pop(name, None)
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
        for name, process in list(self._running.items()):
            code = process.poll()
            if code is not None:
                del self._running[name]
                found[name] = f'{name} ended with {code}: {self._last_line(name)}'
        return found

    def close(self) -> None:
        """End all processes."""
        running = list(self._running.values())
        for process in running:
            with suppress(psutil.NoSuchProcess):
                process.send_signal(signal.SIGTERM)
                process.send_signal(signal.SIGCONT)
        for process in psutil.wait_procs(running, timeout=_STOP_S)[1]:
            with suppress(psutil.NoSuchProcess):
                process.kill()
                process.wait()
        self._running = {}
        self._remove_state()

    def _remove_state(self) -> None:
        shutil.rmtree(self._folder / 'state', ignore_errors=True)

    def _start(
        self,
        name: str,
        module: str,
        parameters: Mapping[str, object],
        renamed: Mapping[str, str] | None = None,
    ) -> None:
        words = [word for old, new in (renamed or {}).items() for word in ('-r', f'{old}:={new}')]
        words += [word for key, value in parameters.items() for word in ('-p', f'{key}:={value}')]
        with (self._folder / f'{name}.log').open('ab') as log:
            self._running[name] = psutil.Popen(
                [sys.executable, '-m', module, '--ros-args', *words],
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, 'THINMAP_STATE_DIR': str(self._folder / 'state')},
                preexec_fn=end_with_parent,
            )

    def _last_line(self, name: str) -> str:
        lines = (self._folder / f'{name}.log').read_text(errors='replace').splitlines()
        return lines[-1][-_LAST_LINES:] if lines else ''
