"""Sinks of a rerun recording: a file, a viewer that is started for it, or both.

rerun is the extra `viewer`.
"""

import contextlib
import importlib.util
import os
import socket
import subprocess
import sys
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.core.errors import InputError

# Its package is rerun-sdk: that of the name rerun is another one.
ADVICE = "rerun is not installed: pip install 'rerun-sdk>=0.41,<0.42'"
APPLICATION = 'thinmap'
TIMELINE = 'time'
# Memory limit of a viewer; beyond it, the oldest data are dropped.
_MEMORY_LIMIT = '1GB'
_SERVER_MEMORY_LIMIT = '256MB'
_LOCALHOST = '127.0.0.1'
_FLUSH_S = 0.8


def is_installed() -> bool:
    """Whether the extra `viewer` is installed."""
    return importlib.util.find_spec('rerun') is not None


def library() -> Any:
    """The rerun library. Raises InputError with installation advice if it is missing."""
    try:
        import rerun
        import rerun.blueprint
    except ImportError as error:
        raise InputError(ADVICE) from error
    return rerun


class RecordingSinks:
    """Logs data to all open sinks, at the time that was set last. Must be closed."""

    def __init__(self) -> None:
        self._rr = library()
        self.viewer: subprocess.Popen[bytes] | None = None
        # A separate stream for each sink: a viewer that hangs must not block the file.
        self._files: list[tuple[Path, Any]] = []
        self._shown: list[Any] = []
        self._first_ns: int | None = None

    def open_file(self, path: Path) -> None:
        """Write to a file. Raises InputError if it cannot be written."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._files.append((path, self._new_stream(self._rr.FileSink(str(path)))))
        except (OSError, RuntimeError) as error:
            raise InputError(f'{path}: rerun: {" ".join(str(error).split())}') from error

    def open_viewer(self) -> None:
        """Start a viewer that accepts local connections only and ends with this process.

        Raises InputError if there is no display, or no viewer.
        """
        if sys.platform == 'linux' and not (
            os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')
        ):
            raise InputError('no screen for the viewer: neither DISPLAY nor WAYLAND_DISPLAY is set')
        port = _free_port()
        command = [
            viewer_program(),
            '--bind',
            _LOCALHOST,
            '--port',
            str(port),
            '--memory-limit',
            _MEMORY_LIMIT,
        ]
        command += [
            '--server-memory-limit',
            _SERVER_MEMORY_LIMIT,
            '--hide-welcome-screen',
            '--expect-data-soon',
        ]
        try:
            self.viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        except OSError as error:
            raise InputError(
                f'{command[0]}: {error.strerror or error}: expected the viewer of rerun'
            ) from error
        self._shown.append(
            self._new_stream(self._rr.GrpcSink(f'rerun+http://{_LOCALHOST}:{port}/proxy'))
        )

    def at(self, ns: int) -> None:
        """Set the time of subsequent logs, relative to the first one."""
        if self._first_ns is None:
            self._first_ns = ns
        for stream in self._all():
            stream.set_time(TIMELINE, duration=np.timedelta64(ns - self._first_ns, 'ns'))

    def log(self, entity: str, value: Any, static: bool = False) -> None:
        """Log a value."""
        for stream in self._all():
            stream.log(entity, value, static=static)

    def send_blueprint(self, blueprint: Any) -> None:
        """Send the layout."""
        for stream in self._all():
            stream.send_blueprint(blueprint)

    def close(self) -> None:
        """Finish the file and end the viewer.

        Raises InputError if the file could not be completed.
        """
        try:
            for path, stream in self._files:
                _finish(path, stream)
        finally:
            # After the file: the stream of a closed viewer blocks.
            for shown in self._shown:
                with contextlib.suppress(InputError):
                    _finish(Path(), shown)
            if self.viewer is not None:
                self.viewer.terminate()
                self.viewer.wait()

    def _all(self) -> list[Any]:
        return [*(stream for _, stream in self._files), *self._shown]

    def _new_stream(self, sink: Any) -> Any:
        stream = self._rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4())
        # A recording has the time of the data, not of logging.
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.set_sinks(sink)
        return stream


def viewer_program() -> str:
    """Viewer program of the library, which need not be on the PATH."""
    spec = importlib.util.find_spec('rerun_cli')
    program = Path(spec.origin).with_name('rerun') if spec is not None and spec.origin else None
    return str(program) if program is not None and program.exists() else 'rerun'


def _free_port() -> int:
    """A free port for each viewer, so that simultaneous runs do not share one."""
    with socket.socket() as probe:
        probe.bind((_LOCALHOST, 0))
        return int(probe.getsockname()[1])


def _finish(path: Path, stream: Any) -> None:
    try:
        stream.flush(timeout_sec=_FLUSH_S)
    except RuntimeError as error:
        raise InputError(f'{path}: rerun: {" ".join(str(error).split())}') from error
    finally:
        stream.disconnect()
