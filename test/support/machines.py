"""Machines: network namespaces with virtual Ethernets between them, and processes in them.

There is no other connection between their nodes. Needs a kernel on which an ordinary user may
create namespaces (`unshare -rn`) and virtual Ethernets; a test is skipped otherwise.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest
from support.timeouts import PATIENCE_S

_TESTS = Path(__file__).resolve().parents[1]
_WEAK_LINK = _TESTS / 'support' / 'weak_link.py'


class Weakness(NamedTuple):
    """Share of lost frames, one-way delay, s, and seed of a weak link."""

    loss: float
    delay_s: float
    seed: int


class Cable(NamedTuple):
    """A connection of two machines; weakness: None for a perfect one."""

    ends: tuple[int, int]
    weakness: Weakness | None = None


class Machines:
    """Network namespaces, numbered from 0, and the node processes in them."""

    def __init__(self, folder: Path, cables: Sequence[Cable]) -> None:
        if missing := [tool for tool in ('unshare', 'nsenter', 'ip') if not shutil.which(tool)]:
            pytest.skip(f'needs {missing[0]} (packages util-linux, iproute2)')
        self.folder = folder
        self.links: list[subprocess.Popen[str]] = []
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._cables = cables
        self._holders = [self._hold(['unshare', '-r', '-n'])]
        count = 1 + max(machine for cable in cables for machine in cable.ends)
        for _ in range(1, count):
            self._holders.append(self._hold([*self._inside(0), 'unshare', '-n']))
        for machine in range(count):
            self.run(machine, 'ip', 'link', 'set', 'lo', 'up')
        for number in range(len(cables)):
            self._lay(number)

    def _hold(self, prefix: list[str]) -> subprocess.Popen[bytes]:
        holder = subprocess.Popen(
            [*prefix, 'sh', '-c', 'echo $$; exec sleep 3600'], stdout=subprocess.PIPE
        )
        assert holder.stdout is not None
        if not holder.stdout.readline():
            pytest.skip('this machine lets nobody make network namespaces (unshare -rn)')
        return holder

    def _lay(self, number: int) -> None:
        first, second = self._cables[number].ends
        near, far = self._devices(number)
        if self._cables[number].weakness is None:
            self.run(first, 'ip', 'link', 'add', near, 'type', 'veth', 'peer', 'name', far)
            self.run(first, 'ip', 'link', 'set', far, 'netns', str(self._pid(second)))
        else:
            self._lay_weak_link(number)
        for end, (machine, device) in enumerate(((first, near), (second, far)), 1):
            self.run(machine, 'ip', 'addr', 'add', f'10.77.{number}.{end}/24', 'dev', device)
        self.plug(number)

    def _lay_weak_link(self, number: int) -> None:
        if not os.access('/dev/net/tun', os.R_OK | os.W_OK):
            pytest.skip(
                'no frames can be lost or held up here: there is no /dev/net/tun that may be opened'
            )
        first, second = self._cables[number].ends
        weakness = self._cables[number].weakness
        assert weakness is not None
        command = [
            *self._inside(first),
            sys.executable,
            str(_WEAK_LINK),
            str(self._pid(second)),
            *self._devices(number),
            *map(str, weakness),
        ]
        link = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.links.append(link)
        assert link.stdout is not None and link.stderr is not None
        if not link.stdout.readline():
            pytest.skip(f'no TAP devices here: {link.stderr.read().strip().splitlines()[-1]}')

    def frames(self) -> dict[str, int]:
        """End the only weak link; returns the numbers of carried and lost frames."""
        (link,) = self.links
        link.terminate()
        counts: dict[str, int] = json.loads(link.communicate(timeout=PATIENCE_S)[0])
        return counts

    @staticmethod
    def _devices(cable: int) -> tuple[str, str]:
        return f'cable{cable}a', f'cable{cable}b'

    def _pid(self, machine: int) -> int:
        return self._holders[machine].pid

    def _inside(self, machine: int) -> list[str]:
        return ['nsenter', '-t', str(self._pid(machine)), '-U', '-n', '--preserve-credentials']

    def run(self, machine: int, *command: str) -> str:
        done = subprocess.run([*self._inside(machine), *command], capture_output=True, text=True)
        if done.returncode:
            pytest.skip(f'{" ".join(command)}: {done.stderr.strip()}')
        return done.stdout

    def plug(self, cable: int) -> None:
        multicast = ('224.0.0.0/4', 'metric', str(cable + 1))
        for machine, device in zip(self._cables[cable].ends, self._devices(cable), strict=True):
            self.run(machine, 'ip', 'link', 'set', device, 'up')
            self.run(machine, 'ip', 'route', 'replace', *multicast, 'dev', device)

    def unplug(self, cable: int) -> None:
        machine = self._cables[cable].ends[0]
        self.run(machine, 'ip', 'link', 'set', self._devices(cable)[0], 'down')

    def unplugged(self, seconds: float, cable: int = 0) -> None:
        self.unplug(cable)
        time.sleep(seconds)
        self.plug(cable)

    def received_bytes(self, machine: int, cable: int = 0) -> int:
        device = self._devices(cable)[self._cables[cable].ends.index(machine)]
        (link,) = json.loads(self.run(machine, 'ip', '-s', '-j', 'link', 'show', device))
        return int(link['stats64']['rx']['bytes'])

    def start(
        self,
        machine: int,
        name: str,
        words: Sequence[str] = (),
        remap: Sequence[str] = (),
        label: str = '',
        package: str = 'thinmap_ros.nodes',
        **parameters: object,
    ) -> subprocess.Popen[bytes]:
        """Start a node of a package with arguments, remapping rules and parameters."""
        command = [
            *self._inside(machine),
            sys.executable,
            '-m',
            f'{package}.{name}',
            *words,
            '--ros-args',
        ]
        for rule in remap:
            command += ['-r', rule]
        for key, value in parameters.items():
            text = f"'{value}'" if isinstance(value, str) else str(value).lower()
            command += ['-p', f'{key}:={text}']
        # Shared memory would bypass the links: all namespaces are on one machine.
        search = [str(_TESTS), os.environ.get('PYTHONPATH', '')]
        environment = {
            **os.environ,
            'PYTHONPATH': os.pathsep.join(search),
            'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4',
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
        }
        label = label or name
        with (self.folder / f'{label}.log').open('wb') as log:
            process = subprocess.Popen(
                command,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )
        self.processes[label] = process
        return process

    def wait(self, condition: Callable[[], object], what: str, seconds: float = PATIENCE_S) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, f'never came: {what}\n{self.logs()}'
            time.sleep(0.5)

    def logs(self) -> str:
        return '\n'.join(
            f'{name}: {(self.folder / f"{name}.log").read_text()[-1500:]}'
            for name in self.processes
        )

    def close(self) -> None:
        for process in [*self.processes.values(), *self.links, *reversed(self._holders)]:
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)
            process.wait()
