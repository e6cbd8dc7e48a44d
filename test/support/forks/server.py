"""Runs Python modules as forks of a process that has imported what they need.

A fresh interpreter spends most of its start on imports. The forks belong to the process that
has started the server, which waits for them as for its own: each loses its parent as soon as it is
there, and then falls to the nearest ancestor that asks for orphans (`support.forks.forked`).
"""

from support.forks import quick_end  # before what registers functions for the end

# isort: split
import atexit
import gc
import importlib
import importlib.util
import json
import os
import pkgutil
import runpy
import socket
import sys
from contextlib import suppress
from multiprocessing import forkserver
from pathlib import Path
from typing import NamedTuple

from support.forks.warmed_kernels import WarmedKernels

import thinmap_ros.startup

REQUEST_BYTES = 1 << 20
# What programs import where they first use it, which takes a second each time.
_LATE_IMPORTS = ('matplotlib.backends.backend_agg', 'scipy.ndimage', 'thinmap_ros.view.map_figure')


class Program(NamedTuple):
    """A module, and the process in which it runs. streams: its standard input, output and error."""

    module: str
    arguments: list[str]
    folder: str
    environment: dict[str, str]
    streams: tuple[int, ...] = ()


def main() -> None:
    """Import, then fork for each request until the other end of the socket is closed."""
    control = socket.socket(fileno=int(sys.argv[1]))
    _import_programs()
    kernels = WarmedKernels()
    gc.collect()
    gc.freeze()
    program = _serve(control)
    control.close()
    with quick_end.of_this_process():
        if program is not None:
            kernels.forget(program.module)
            _run(program)


def _import_programs() -> None:
    """Import all programs of the package, and rclpy if it is there.

    A fork has one thread, and the locks of all. Those of LTTng, which rclpy loads, wait for a
    session daemon and hold none.
    """
    packages = ['thinmap_ros.tools']
    if importlib.util.find_spec('rclpy'):
        importlib.import_module('rclpy.impl.implementation_singleton')
        packages.append('thinmap_ros.nodes')
    of_tracing = _threads()
    for package in packages:
        for path in importlib.import_module(package).__path__:
            for module in pkgutil.iter_modules([path], f'{package}.'):
                importlib.import_module(module.name)
    for name in _LATE_IMPORTS:
        importlib.import_module(name)
    assert _threads() == of_tracing


def _threads() -> int:
    return len(list(Path('/proc/self/task').iterdir()))


def _serve(control: socket.socket) -> Program | None:
    """The program that this process is to run, in each fork; None at the end, in the server."""
    while True:
        request, streams, _, _ = socket.recv_fds(control, REQUEST_BYTES, 3)
        if not request:
            return None
        pid = _fork_orphan()
        if not pid:
            return Program(**json.loads(request), streams=tuple(streams))
        for stream in streams:
            os.close(stream)
        control.send(str(pid).encode())


def _fork_orphan() -> int:
    """Id of a new process, once its parent has ended; 0 in the new process."""
    reader, writer = os.pipe()
    parent = os.fork()
    if parent:
        os.close(writer)
        pid = int(os.read(reader, 32))
        os.close(reader)
        os.waitpid(parent, 0)
        return pid
    pid = os.fork()
    if pid:
        os.write(writer, str(pid).encode())
        os._exit(0)
    os.close(reader)
    os.close(writer)
    return 0


@atexit.register
def _end_jobs() -> None:
    """Wait for the processes of the program's jobs: the CPU time of a test is theirs, too."""
    # Its socket may have been removed before.
    with suppress(FileNotFoundError):
        forkserver._forkserver._stop()


def _run(program: Program) -> None:
    """Do what `python -m MODULE` does, in a session of its own."""
    os.setsid()
    for number, stream in enumerate(program.streams):
        os.dup2(stream, number)
        os.close(stream)
    os.chdir(program.folder)
    os.environ.clear()
    os.environ.update(program.environment)
    sys.path[0] = program.folder
    sys.orig_argv = [sys.executable, '-m', program.module, *program.arguments]
    sys.argv = ['-m', *program.arguments]
    # What a program does before its modules are imported.
    importlib.reload(thinmap_ros.startup)
    sys.modules.pop(program.module, None)
    runpy.run_module(program.module, run_name='__main__', alter_sys=True)


if __name__ == '__main__':
    main()
