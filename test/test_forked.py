"""Forks of the fork server: like a start for the program, like any child for the test."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from support.forks import forked
from support.timeouts import PATIENCE_S

pytestmark = pytest.mark.programs
PROGRAM = """
import atexit, json, os, signal, sys, threading, thinmap_ros

last_words = []
threading.Timer(0.3, last_words.append, ['of a thread']).start()
atexit.register(lambda: print('an error', last_words, file=sys.stderr, end=''))
print(json.dumps({
    'name': __name__,
    'spec': __spec__.name,
    'is main': sys.modules['__main__'].__dict__ is globals(),
    'arguments': sys.argv,
    'orig_argv': sys.orig_argv,
    'path': sys.path,
    'folder': os.getcwd(),
    'environment': dict(os.environ),
    'input': sys.stdin.read(),
    'files': sorted(os.listdir('/proc/self/fd')),
    'leads': os.getpid() == os.getsid(0),
    'ignored': [n for n in signal.valid_signals() if signal.getsignal(n) is signal.SIG_IGN],
    'SIGINT': repr(signal.getsignal(signal.SIGINT).__name__),
    'threads': threading.active_count(),
}))
match sys.argv[1]:
    case 'exit':
        sys.exit(int(sys.argv[2]))
    case 'raise':
        raise ValueError('planted')
    case 'interrupt':
        signal.raise_signal(signal.SIGINT)
    case 'kill':
        sys.stdout.flush()
        os.kill(os.getpid(), signal.SIGKILL)
"""
WAITS = """
import signal, sys

signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(7))
print('ready', flush=True)
signal.pause()
"""
ORPHAN = """
import os, signal
from pathlib import Path
from support.forks import forked

forked.run('this', '-h')
print(*Path(f'/proc/self/task/{os.getpid()}/children').read_text().split(), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize(
    ('words', 'code'),
    [
        (['nothing'], 0),
        (['exit', '3'], 3),
        (['raise'], 1),
        (['interrupt'], -signal.SIGINT),
        (['kill'], -signal.SIGKILL),
    ],
    ids=lambda words: words[0] if isinstance(words, list) else '',
)
def test_a_fork_is_to_a_program_what_a_start_is(
    tmp_path: Path, words: list[str], code: int
) -> None:
    (tmp_path / 'told.py').write_text(PROGRAM)
    told = []
    errors = []
    for fresh in (False, True):
        out = tmp_path / 'out'
        err = tmp_path / 'err'
        with out.open('w') as output, err.open('w') as error:
            process = forked.start('told', words, tmp_path, (output, error), fresh=fresh)
        assert isinstance(process, forked.Process) != fresh
        assert process.wait(PATIENCE_S) == code
        told.append(json.loads(out.read_text()))
        errors.append(err.read_text().splitlines()[-1:])
    assert told[0] == told[1]
    assert errors[0] == errors[1]


def test_a_fork_is_a_child_that_waits_for_signals(tmp_path: Path) -> None:
    (tmp_path / 'waits.py').write_text(WAITS)
    log = tmp_path / 'log'
    with log.open('w') as output:
        process = forked.start('waits', [], tmp_path, (output, output))
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.01)
    end_s = time.monotonic() + PATIENCE_S
    while log.read_text() != 'ready\n' and time.monotonic() < end_s:
        time.sleep(0.01)
    assert process.poll() is None
    assert process.pid in {child.pid for child in psutil.Process().children()}
    process.send_signal(signal.SIGTERM)
    assert process.wait(PATIENCE_S) == process.poll() == 7
    assert not psutil.pid_exists(process.pid)


def test_other_libraries_make_a_start_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'waits.py').write_text('')
    monkeypatch.setenv('PYTHONPATH', str(tmp_path), prepend=':')
    with Path(os.devnull).open('w') as output:
        process = forked.start('waits', [], tmp_path, (output, output))
    assert isinstance(process, subprocess.Popen)
    assert process.wait(PATIENCE_S) == 0


def test_variables_that_a_library_sets_do_not_stay() -> None:
    with forked.kept_environment():
        os.environ['PYTHONHASHSEED'] = '6640'
        assert not forked.server().can_start(os.environ)
    assert forked.server().can_start(os.environ)


def test_the_server_ends_with_a_test_process_that_is_killed(tmp_path: Path) -> None:
    variables = {**os.environ, 'PYTHONPATH': f'{forked.TESTS}:{os.environ.get("PYTHONPATH", "")}'}
    done = subprocess.run(
        [sys.executable, '-c', ORPHAN], env=variables, stdout=subprocess.PIPE, text=True
    )
    assert done.returncode == -signal.SIGKILL
    (server,) = map(int, done.stdout.split())
    end_s = time.monotonic() + PATIENCE_S
    while is_running(server) and time.monotonic() < end_s:
        time.sleep(0.05)
    assert not is_running(server)


def is_running(pid: int) -> bool:
    """Whether a process runs; one that has ended may wait for its parent."""
    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
