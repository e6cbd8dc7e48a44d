"""What a node leaves for itself in case it is killed.

One that is started again soon goes on from there.
"""

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.core.private_folder import private_folder, temporary_folder
from thinmap_ros.files.atomic import atomic_write, partial_files
from thinmap_ros.files.npz import open_regular_file, read_arrays

State = dict[str, NDArray[Any]]
_FOLDER = 'THINMAP_STATE_DIR'


class Recovery:
    """The file of one node: of its name, on its ROS domain.

    It lies where nothing survives a restart of the machine, and is removed when the node ends in
    order: what is found there was left by a node that was killed. The folder belongs to this user
    alone and is no link; else nothing is kept, and a warning says so.
    """

    def __init__(self, node: Node, limit_s: float) -> None:
        self._limit_s = limit_s
        self._node = node
        name = node.get_fully_qualified_name().strip('/').replace('/', '.')
        self._path: Path | None = None
        if limit_s <= 0.0:
            return
        try:
            self._path = state_folder() / f'{os.environ.get("ROS_DOMAIN_ID", "0")}.{name}.npz'
        except InputError as error:
            node.get_logger().warning(f'{error}: killed, the node would begin anew')

    def left(self) -> State | None:
        """What a killed node left, if not long ago; None where nothing is, or it is broken."""
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
                return read_arrays(stream)
        except FileNotFoundError:
            return None
        except (OSError, InputError) as error:
            self._warn(f'{one_line_reason(error)}: beginning anew')
            return None

    def keep(self, state: State) -> None:
        """Keep a state; where the disk does not take it, the node works on without."""
        if self._path is None or self._limit_s <= 0.0:
            return
        try:
            with atomic_write(self._path) as aside, aside.open('wb') as stream:
                np.savez(stream, **state)  # type: ignore[arg-type]
        except OSError as error:
            self._warn(f'{error.strerror}: killed now, the node would begin anew')

    def forget(self) -> None:
        """Leave nothing."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def _warn(self, what: str) -> None:
        self._node.get_logger().warning(f'{self._path}: {what}', throttle_duration_sec=60.0)


def state_folder() -> Path:
    """The folder of this user alone in which nodes keep their states; made where it is missing.

    Raises InputError where it is none: a link, of another user, or open to others.
    """
    chosen = os.environ.get(_FOLDER)
    runtime = os.environ.get('XDG_RUNTIME_DIR')
    if chosen:
        return private_folder(Path(chosen))
    if runtime and Path(runtime).is_dir():
        return private_folder(Path(runtime) / temporary_folder().name)
    return private_folder(temporary_folder())
