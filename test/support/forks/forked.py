"""Starts Python modules as processes that need not import: forks of `support.forks.server`."""

import atexit
import ctypes
import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

TESTS = Path(__file__).resolve().parents[2]
# What the interpreter, its libraries and modules read once, at their start.
_READ_ONCE = ('PYTHON', 'LD_', 'NUMBA_', 'OPENBLAS_', 'AMENT_', 'XDG_CACHE_', 'TMPDIR', 'HOME')
_SET_CHILD_SUBREAPER = 36


class Process:
    """A forked process: what tests use of `subprocess.Popen`."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Exit code; None while it runs."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if pid else None
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Exit code, once it has ended. Raises TimeoutExpired."""
        if self.poll() is None:
            process = os.pidfd_open(self.pid)
            select.select([process], [], [], timeout)
            os.close(process)
        if self.poll() is None:
            raise subprocess.TimeoutExpired(f'process {self.pid}', timeout or 0.0)
        assert self.returncode is not None
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)


Started = Process | subprocess.Popen[bytes]


class Server:
    """Forks processes that become children of this one; it starts with the first of them."""

    def __init__(self) -> None:
        self._environment = dict(os.environ)
        self._control: socket.socket | None = None

    def can_start(self, environment: Mapping[str, str]) -> bool:
        """Whether a fork differs in nothing from a process that starts with these variables."""
        return _read_once(environment) == _read_once(self._environment)

    def start(self, streams: list[int], **program: Any) -> Process:
        """Start a program (`server.Program`) with its standard input, output and error."""
        self._control = self._control or self._connected()
        with _adopting():
            socket.send_fds(self._control, [json.dumps(program).encode()], streams)
            pid = self._control.recv(32)
        if not pid:
            raise RuntimeError('the fork server has ended')
        return Process(int(pid))

    def _connected(self) -> socket.socket:
        """Socket of the server, which ends when this process closes it, or ends in any way."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            number = theirs.fileno()
            process = subprocess.Popen(
                [sys.executable, '-m', 'support.forks.server', str(number)],
                stdin=subprocess.DEVNULL,
                pass_fds=[number],
                start_new_session=True,
                env=_with_tests(self._environment),
            )
        atexit.register(process.wait)
        atexit.register(ours.close)
        return ours


@cache
def server() -> Server:
    """The server of this test process.

    The fixtures of the session call it first: the variables of all tests are those of the server.
    """
    return Server()


def start(
    module: str,
    arguments: list[str],
    folder: Path,
    output: tuple[IO[Any], IO[Any]],
    environment: Mapping[str, str] = os.environ,
    fresh: bool = False,
) -> Started:
    """Start a module in a session of its own, with files for its standard output and error.

    Not as a fork if fresh, if its variables ask for other libraries, or if it loads rerun.
    """
    fresh = fresh or _loads_rerun(module, arguments)
    variables = _with_tests(environment)
    with Path(os.devnull).open('rb') as nothing:
        streams = (nothing, *output)
        if server().can_start(environment) and not fresh:
            return server().start(
                [stream.fileno() for stream in streams],
                module=module,
                arguments=arguments,
                folder=str(folder),
                environment=variables,
            )
        return subprocess.Popen(
            [sys.executable, '-m', module, *arguments],
            stdin=nothing,
            stdout=output[0],
            stderr=output[1],
            start_new_session=True,
            cwd=folder,
            env=variables,
        )


def run(
    module: str, *arguments: object, folder: Path | None = None, timeout: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a module to its end, with its output as text."""
    words = [str(argument) for argument in arguments]
    with TemporaryFile('w+') as output, TemporaryFile('w+') as errors:
        process = start(module, words, folder or Path.cwd(), (output, errors))
        try:
            code = process.wait(timeout)
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise
        output.seek(0)
        errors.seek(0)
        return subprocess.CompletedProcess([module, *words], code, output.read(), errors.read())


@contextmanager
def kept_environment() -> Iterator[None]:
    """Undo what a library sets for good, as Dask does: later programs could not be forks."""
    before = dict(os.environ)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _loads_rerun(module: str, arguments: list[str]) -> bool:
    """Whether a program loads rerun, whose threads panic at the end of some forks."""
    options = ('--view', '--recording')
    return module.endswith('.rerun_viewer') or any(word.startswith(options) for word in arguments)


def _with_tests(environment: Mapping[str, str]) -> dict[str, str]:
    """Variables with which a program can import what is below test/, too."""
    return {**environment, 'PYTHONPATH': f'{TESTS}:{environment.get("PYTHONPATH", "")}'}


def _read_once(environment: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in environment.items() if name.startswith(_READ_ONCE)}


@contextmanager
def _adopting() -> Iterator[None]:
    """Become the parent of descendants that lose theirs; not for longer, as tests have others."""
    libc = ctypes.CDLL(None)
    libc.prctl(_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    try:
        yield
    finally:
        libc.prctl(_SET_CHILD_SUBREAPER, 0, 0, 0, 0)
