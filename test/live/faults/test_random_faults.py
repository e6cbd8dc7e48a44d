"""scripts/endurance --faults on a live graph: a few faults, and its end by a signal."""

import math
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from support.timeouts import PATIENCE_S

from benchmarks.faults.judge import Record
from benchmarks.faults.kinds import KINDS, Fault
from benchmarks.faults.run import Setting, drive
from benchmarks.node_processes import NODES
from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.world import World

pytestmark = pytest.mark.live
ROOT = Path(__file__).resolve().parents[3]
# On the domain of the test: the program would take one of its own.
PROGRAM = """
from benchmarks import endurance
endurance.cli.run(endurance.work, endurance.parser())
"""


@pytest.fixture(autouse=True)
def without_shared_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    # As scripts/endurance: nodes are killed.
    monkeypatch.setenv('FASTDDS_BUILTIN_TRANSPORTS', 'UDPv4')


def is_running(process: psutil.Process) -> bool:
    """Whether a process runs; one that has ended may wait for its parent."""
    with suppress(psutil.NoSuchProcess):
        return bool(process.status() != psutil.STATUS_ZOMBIE)
    return False


@pytest.mark.slow
def test_faults_strike_a_live_graph_and_are_judged(ros_domain: int, tmp_path: Path) -> None:
    path = package_data.world_path('room_10x10')
    faults = [
        Fault(0, KINDS['laser_nan'], gap_s=3.0, duration_s=3.0, seed=1),
        Fault(1, KINDS['kill_navigator'], gap_s=1.0, duration_s=0.5, seed=1),
    ]
    setting = Setting(
        path=path,
        world=World.from_patch(*read_world(path)),
        seconds=math.inf,
        rate=4.0,
        seed=1,
        out=tmp_path,
        faults=faults,
    )
    records: list[Record] = []
    drive(setting, records.append)
    assert [record.name for record in records] == ['none', 'laser_nan', 'none', 'kill_navigator']
    assert records[0].driven_m > 0.1
    assert all(0.0 < record.pose.worst_m < 0.1 for record in records)
    assert all(record.recovered_s for record in records if record.fault)
    assert not psutil.Process().children(recursive=True)


@pytest.mark.parametrize(
    'number', [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_a_signal_ends_all_processes_and_leaves_no_state(
    ros_domain: int, tmp_path: Path, number: signal.Signals
) -> None:
    words = ['--faults', '--only', 'laser_nan', '-o', str(tmp_path / 'out')]
    program = subprocess.Popen(
        [sys.executable, '-c', PROGRAM, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    children: list[psutil.Process] = []
    end_s = time.monotonic() + PATIENCE_S
    while len(children) < len(NODES) + 2 and time.monotonic() < end_s:
        time.sleep(0.1)
        children = psutil.Process(program.pid).children(recursive=True)
    program.send_signal(number)
    said = program.communicate(timeout=PATIENCE_S)[0]
    assert program.returncode == 130
    # DDS may log lines of its own, in colour.
    lines = [line for line in said.splitlines() if not line.startswith('\x1b')]
    assert lines[0].startswith('| fault | count |')
    assert len(children) == len(NODES) + 2
    # One that was just started ends by itself.
    while any(map(is_running, children)) and time.monotonic() < end_s:
        time.sleep(0.1)
    assert not [child for child in children if is_running(child)]
    assert not (tmp_path / 'out' / 'state').exists()
