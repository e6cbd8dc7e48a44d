"""Two machines: two network namespaces with a virtual Ethernet between them.

There is no other connection between their nodes.

Needs a kernel on which an ordinary user may create namespaces (`unshare -rn`) and virtual
Ethernets; skipped otherwise.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.halls import AT_START, START
from support.timeouts import PATIENCE_S

from thinmap_ros.core.errors import InputError
from thinmap_ros.logs.bag import Bag

pytestmark = pytest.mark.live
ADDRESSES = ('10.77.0.1', '10.77.0.2')
CABLE = ('cable0', 'cable1')
WEAK = (0.05, 0.05, 7)  # share of lost frames, one-way delay in s, seed


class Machines:
    """Two network namespaces, 0 and 1, and the node processes in them."""

    def __init__(self, folder: Path, weak: bool) -> None:
        self.folder = folder
        self.link: subprocess.Popen[str] | None = None
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._holders = [self._hold(['unshare', '-r', '-n'])]
        self._holders.append(self._hold([*self._inside(0), 'unshare', '-n']))
        if weak:
            self._lay_weak_link()
        else:
            self.run(0, 'ip', 'link', 'add', CABLE[0], 'type', 'veth', 'peer', 'name', CABLE[1])
            self.run(0, 'ip', 'link', 'set', CABLE[1], 'netns', str(self._pid(1)))
        for machine in (0, 1):
            self.run(
                machine, 'ip', 'addr', 'add', f'{ADDRESSES[machine]}/24', 'dev', CABLE[machine]
            )
            self.run(machine, 'ip', 'link', 'set', 'lo', 'up')
            self.plug(machine)

    def _hold(self, prefix: list[str]) -> subprocess.Popen[bytes]:
        holder = subprocess.Popen(
            [*prefix, 'sh', '-c', 'echo $$; exec sleep 3600'], stdout=subprocess.PIPE
        )
        assert holder.stdout is not None
        if not holder.stdout.readline():
            pytest.skip('this machine lets nobody make network namespaces (unshare -rn)')
        return holder

    def _lay_weak_link(self) -> None:
        if not os.access('/dev/net/tun', os.R_OK | os.W_OK):
            pytest.skip(
                'no frames can be lost or held up here: there is no /dev/net/tun that may be opened'
            )
        program = Path(__file__).resolve().parents[2] / 'support' / 'weak_link.py'
        command = [
            *self._inside(0),
            sys.executable,
            str(program),
            str(self._pid(1)),
            *CABLE,
            *map(str, WEAK),
        ]
        self.link = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self.link.stdout is not None and self.link.stderr is not None
        if not self.link.stdout.readline():
            pytest.skip(f'no TAP devices here: {self.link.stderr.read().strip().splitlines()[-1]}')

    def frames(self) -> dict[str, int]:
        """End the weak link; returns the numbers of carried and lost frames."""
        assert self.link is not None
        self.link.terminate()
        counts: dict[str, int] = json.loads(self.link.communicate(timeout=PATIENCE_S)[0])
        return counts

    def _pid(self, machine: int) -> int:
        return self._holders[machine].pid

    def _inside(self, machine: int) -> list[str]:
        return ['nsenter', '-t', str(self._pid(machine)), '-U', '-n', '--preserve-credentials']

    def run(self, machine: int, *command: str) -> str:
        done = subprocess.run([*self._inside(machine), *command], capture_output=True, text=True)
        if done.returncode:
            pytest.skip(f'{" ".join(command)}: {done.stderr.strip()}')
        return done.stdout

    def plug(self, machine: int) -> None:
        self.run(machine, 'ip', 'link', 'set', CABLE[machine], 'up')
        self.run(machine, 'ip', 'route', 'replace', '224.0.0.0/4', 'dev', CABLE[machine])

    def unplugged(self, seconds: float) -> None:
        self.run(0, 'ip', 'link', 'set', CABLE[0], 'down')
        time.sleep(seconds)
        for machine in (0, 1):
            self.plug(machine)

    def received_bytes(self, machine: int) -> int:
        (link,) = json.loads(self.run(machine, 'ip', '-s', '-j', 'link', 'show', CABLE[machine]))
        return int(link['stats64']['rx']['bytes'])

    def start(self, machine: int, name: str, **parameters: object) -> subprocess.Popen[bytes]:
        command = [
            *self._inside(machine),
            sys.executable,
            '-m',
            f'thinmap_ros.nodes.{name}',
            '--ros-args',
        ]
        for key, value in parameters.items():
            text = f"'{value}'" if isinstance(value, str) else str(value).lower()
            command += ['-p', f'{key}:={text}']
        # Shared memory would bypass the link: both namespaces are on one machine.
        environment = {
            **os.environ,
            'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4',
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
        }
        with (self.folder / f'{name}.log').open('wb') as log:
            process = subprocess.Popen(
                command,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )
        self.processes[name] = process
        return process

    def logs(self) -> str:
        return '\n'.join(
            f'{name}: {(self.folder / f"{name}.log").read_text()[-1500:]}'
            for name in self.processes
        )

    def close(self) -> None:
        links = [] if self.link is None else [self.link]
        for process in [*self.processes.values(), *links, *reversed(self._holders)]:
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)
            process.wait()


@pytest.fixture(params=['cable'])
def machines(request, ros_domain, tmp_path):
    if missing := [tool for tool in ('unshare', 'nsenter', 'ip') if shutil.which(tool) is None]:
        pytest.skip(f'needs {missing[0]} (packages util-linux, iproute2)')
    both = Machines(tmp_path, weak=request.param == 'weak link')
    yield both
    both.close()


def recorded(bag: Path, topic: str) -> int:
    try:
        return sum(1 for _ in Bag(bag).messages({topic}))
    except InputError:
        return 0


def wait(machines, condition, what, seconds=PATIENCE_S):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f'never came: {what}\n{machines.logs()}'
        time.sleep(0.5)


def start_mapping(machines, machine):
    for name in ('localizer', 'grid_mapper', 'topology_builder'):
        machines.start(
            machine, name, use_sim_time=True, **(AT_START if name == 'localizer' else {})
        )


def test_a_robot_here_and_its_map_there_outlive_a_cable_that_is_pulled(machines, tmp_path):
    bag = tmp_path / 'bag'
    machines.start(0, 'recorder', bag=str(bag), use_sim_time=True)
    start_mapping(machines, 1)
    machines.start(
        0,
        'sim',
        start=START,
        real_time_factor=4.0,
        lockstep='local_topology',
        wait_for_subscribers=2,
    )
    wait(machines, lambda: recorded(bag, '/local_topology') > 10, 'the graph comes over')
    machines.unplugged(3.0)
    before = recorded(bag, '/local_topology')
    wait(machines, lambda: recorded(bag, '/local_topology') > before + 15, 'it continues')
    # Scans went in one direction, maps and graphs in the other.
    assert machines.received_bytes(1) > 50_000 and machines.received_bytes(0) > 50_000
    assert all(process.poll() is None for process in machines.processes.values()), machines.logs()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_an_exploration_over_the_cable_finishes_though_it_is_pulled_for_five_seconds(
    machines, tmp_path
):
    result = tmp_path / 'result.json'
    start_mapping(machines, 1)
    for name in ('navigator', 'explorer'):
        machines.start(0, name, use_sim_time=True)
    machines.start(
        0,
        'sim',
        start=START,
        real_time_factor=5.0,
        lockstep='local_topology',
        wait_for_subscribers=3,
    )
    monitor = machines.start(0, 'demo_monitor', use_sim_time=True, result=str(result))
    time.sleep(30.0)
    machines.unplugged(5.0)
    wait(machines, lambda: monitor.poll() is not None, 'the exploration ends', 800.0)
    assert json.loads(result.read_text())['finished'], machines.logs()


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize('machines', ['weak link'], indirect=True)
def test_an_exploration_in_real_time_over_a_weak_link_finishes_though_it_breaks_as_well(
    machines, tmp_path
):
    result = tmp_path / 'result.json'
    start_mapping(machines, 1)
    for name in ('navigator', 'explorer'):
        machines.start(0, name, use_sim_time=True)
    # Without lockstep: late messages stay late.
    machines.start(0, 'sim', start=START, wait_for_subscribers=3)
    monitor = machines.start(0, 'demo_monitor', use_sim_time=True, result=str(result))
    time.sleep(30.0)
    machines.unplugged(5.0)
    wait(machines, lambda: monitor.poll() is not None, 'the exploration ends', 800.0)
    assert json.loads(result.read_text())['finished'], machines.logs()
    frames = machines.frames()
    assert 0.04 < frames['lost'] / (frames['carried'] + frames['lost']) < 0.06, frames
