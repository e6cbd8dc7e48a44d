"""Checkpoints: a node that was killed and is restarted soon continues from its last one."""

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from rclpy.node import Node

from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.core.snapshot import State
from thinmap_ros.files.safe import (
    atomic_write,
    open_regular_file,
    partial_files,
    read_snapshot,
    write_snapshot,
)
from thinmap_ros.jit.cache import private_folder, temporary_folder

_FOLDER = 'THINMAP_STATE_DIR'
_KIND = 'checkpoint'
# Least time between two checkpoints, in durations of the last one: however large the state, saving
# it takes a small share of the time.
_INTERVAL = 50.0
_URGENT_INTERVAL = 10.0


class Checkpoint:
    """The checkpoint file of one node: of its name, on its ROS domain.

    It is in a directory that does not survive a restart of the machine, and is deleted when the
    node ends in order: a file found there was written by a node that was killed. The directory
    belongs to this user alone and is no link; otherwise no checkpoint is saved, with a warning.

    is_outdated: whether the state may be another than that which was saved.
    """

    def __init__(
        self,
        node: Node,
        limit_s: float,
        state: Callable[[], State | None] = lambda: None,
        ending: str = '.npz',
        owner: str | None = None,
        interval: float = _INTERVAL,
    ) -> None:
        """limit_s: age up to which a checkpoint is loaded, s; 0: no checkpoints.

        state: returns what to save when it is due; None: nothing. owner: full name of what it is
        the state of, where that is not the node. interval: between two checkpoints, in durations of
        the last one.
        """
        self._limit_s = limit_s
        self._node = node
        self._state = state
        self._interval = interval
        self._saved_at_s = time.monotonic()
        self._duration_s = 0.0
        self.is_outdated = True
        self._path: Path | None = None
        if limit_s <= 0.0:
            return
        try:
            self._path = checkpoint_directory() / own_file_name(node, ending, owner)
        except OSError as error:
            node.get_logger().warning(f'{error}: no checkpoint is saved')

    def load(self) -> State | None:
        """State of a killed node; None where there is none, or it is too old or broken."""
        if self._path is None:
            return None
        for part in partial_files(self._path):
            part.unlink(missing_ok=True)
        try:
            with open_regular_file(self._path, os.O_NOFOLLOW) as stream:
                status = os.fstat(stream.fileno())
                if status.st_uid != os.getuid():
                    raise InputError('expected a file of this user')
                if time.time() - status.st_mtime > self._limit_s:
                    return None
                return read_snapshot(stream, _KIND)
        except FileNotFoundError:
            return None
        except (OSError, InputError) as error:
            self._warn(f'{one_line_reason(error)}: starting without a checkpoint')
            return None

    def save(self, state: State) -> None:
        """Save a state; a disk that does not accept it leads to a warning."""
        if self._path is None:
            return
        try:
            with atomic_write(self._path) as aside, aside.open('wb') as stream:
                write_snapshot(stream, _KIND, state, compress=False)
        except OSError as error:
            self._warn(f'{error.strerror}: checkpoint not saved')

    def save_if_due(self, is_urgent: bool = False) -> bool:
        """Save the state, unless the last checkpoint is too recent; returns whether it was due."""
        now_s = time.monotonic()
        interval = _URGENT_INTERVAL if is_urgent else self._interval
        if now_s - self._saved_at_s < interval * self._duration_s:
            return False
        state = self._state()
        self.is_outdated = state is None
        if state is not None:
            self.save(state)
        self._saved_at_s = time.monotonic()
        self._duration_s = self._saved_at_s - now_s
        return True

    def renew(self) -> None:
        """Tell the file that the node lives, if the state is as it was saved."""
        if self._path is not None and not self.is_outdated:
            with suppress(OSError):
                os.utime(self._path, follow_symlinks=False)

    def delete(self) -> None:
        """Delete the file."""
        self.is_outdated = True
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def _warn(self, what: str) -> None:
        self._node.get_logger().warning(f'{self._path}: {what}', throttle_duration_sec=60.0)


class StateStamp:
    """Stamp of the newest scan in the state of a node, and of the checkpoint that it started from.

    latest_ns: None before the first scan.
    """

    def __init__(self) -> None:
        self.latest_ns: int | None = None
        self._checkpoint_ns = 0
        self._is_first_scan = False

    def restore(self, stamp_ns: int) -> None:
        """The state is that of a checkpoint."""
        self.latest_ns = stamp_ns
        self._checkpoint_ns = stamp_ns
        self._is_first_scan = True

    def is_restarted_by(self, stamp_ns: int) -> bool:
        """Whether a scan, the first after the checkpoint, is older: the robot was restarted too."""
        is_first = self._is_first_scan
        self._is_first_scan = False
        return is_first and stamp_ns < self._checkpoint_ns

    def is_corrected_by(self, corrected_ns: int) -> bool:
        """Whether a trajectory is newer than the checkpoint; the state follows older ones."""
        return self.latest_ns is not None and corrected_ns > self._checkpoint_ns


def own_file_name(node: Node, ending: str, owner: str | None = None) -> str:
    """Name of a file of one node, or of another owner with a full name, on its ROS domain."""
    name = (owner or node.get_fully_qualified_name()).strip('/').replace('/', '.')
    return f'{os.environ.get("ROS_DOMAIN_ID", "0")}.{name}{ending}'


def checkpoint_directory() -> Path:
    """The directory of this user alone in which nodes save checkpoints; created where missing.

    Raises OSError where it is a link, of another user, or open to others.
    """
    chosen = os.environ.get(_FOLDER)
    runtime = os.environ.get('XDG_RUNTIME_DIR')
    if chosen:
        return private_folder(Path(chosen))
    if runtime and Path(runtime).is_dir():
        return private_folder(Path(runtime) / temporary_folder().name)
    return private_folder(temporary_folder())
