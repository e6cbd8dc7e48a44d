"""Fixtures and options of all tests."""

import os
import signal
import subprocess
import sys
from collections.abc import Generator, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import thinmap_ros.startup  # noqa: F401  before NumPy, for which it sets the number of threads

# isort: split
import pytest
from hypothesis import settings
from support.forks import forked
from support.hidden_library import hide_ros
from support.timeouts import limited_cpu_time as limited_cpu_time

from thinmap_ros.evaluation.ros_domains import free_domain

pytest_plugins = ['support.cpu_time']
ROOT = Path(__file__).resolve().parent.parent
SHARED = next(
    (up / 'shared' for up in ROOT.parents if (up / 'shared' / 'data').exists()),
    ROOT.parent / 'shared',
)

_SHOWN_LINES = 15  # of a log

# No deadline: the time of an example depends on the machine. The same examples in every run.
settings.register_profile('thinmap', deadline=None, derandomize=True)
settings.load_profile('thinmap')

# A background job of a shell ignores SIGINT, and so would the programs that tests start and
# interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels before any test: `colcon test` in a workspace that was just built.

    Otherwise the first tests would include the compilation. scripts/env compiles them, too.
    """
    is_worker = hasattr(session.config, 'workerinput')
    if not is_worker and not session.config.option.collectonly and 'THINMAP_ENV' not in os.environ:
        subprocess.run([sys.executable, '-m', 'thinmap_ros.tools.warm_up'], cwd=ROOT, check=True)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Show what the nodes and programs of a test that failed said last."""
    report = yield
    folder = getattr(item, 'funcargs', {}).get('tmp_path')
    if report.when == 'call' and report.failed and folder is not None:
        for log in sorted(folder.rglob('*.log')):
            lines = log.read_text(errors='replace').splitlines()[-_SHOWN_LINES:]
            if lines:
                report.sections.append((str(log.relative_to(folder)), '\n'.join(lines)))
    return report


@pytest.fixture(scope='session', autouse=True)
def without_ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """In the stage without ROS: ROS is hidden from all programs that the tests start."""
    with pytest.MonkeyPatch.context() as patch:
        if 'THINMAP_WITHOUT_ROS' in os.environ:
            hide_ros(tmp_path_factory.mktemp('without_ros'), patch)
        forked.server()
        yield


@pytest.fixture(autouse=True)
def own_environment() -> Iterator[None]:
    """The variables that a test sets end with it."""
    with forked.kept_environment():
        yield


@pytest.fixture(autouse=True)
def started_programs(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests that start a process are marked: unit tests start none."""
    if any(request.node.get_closest_marker(name) for name in ('programs', 'live', 'browser')):
        return

    start = subprocess.Popen.__init__

    def refuse(process: Any, command: Any = None, *rest: Any, **options: Any) -> None:
        # Matplotlib looks for the fonts of a machine once.
        if isinstance(command, list) and command[:1] == ['fc-list']:
            start(process, command, *rest, **options)
            return
        pytest.fail('starts a process: mark it with programs or live')

    monkeypatch.setattr(subprocess.Popen, '__init__', refuse)
    monkeypatch.setattr(BaseProcess, 'start', refuse)
    monkeypatch.setattr(forked, 'start', refuse)


@pytest.fixture(scope='session')
def shared_data() -> Path:
    """The folder of real logs and worlds beside the project."""
    if not SHARED.exists():
        pytest.skip('needs the real logs and worlds of ../shared/data, which is not there')
    return SHARED / 'data'


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[int]:
    """A ROS domain that no other test process on this machine uses."""
    # Checkpoints of killed nodes must not affect other tests.
    monkeypatch.setenv('THINMAP_STATE_DIR', str(tmp_path / 'state'))
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with free_domain() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
        yield domain
