"""What a node leaves for itself in case it is killed: one that is started again soon goes on from there."""

import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from thinmap_ros.adapters.files import written_aside

State = dict[str, NDArray[Any]]
_FOLDER = 'THINMAP_STATE_DIR'


class Recovery:
    """The file of one node: of its name, on its ROS domain.

    It lies where nothing survives a restart of the machine, and is removed when the node ends in order: what is found
    there was left by a node that was killed.
    """

    def __init__(self, node: Node, limit_s: float) -> None:
        self._limit_s = limit_s
        self._node = node
        name = node.get_fully_qualified_name().strip('/').replace('/', '.')
        folder = _folder()
        self._path = None if folder is None else folder / f'{os.environ.get("ROS_DOMAIN_ID", "0")}.{name}.npz'

    def left(self) -> State | None:
        """What a node that was killed left, if that is not long ago; None where nothing is there or it is broken."""
        try:
            if self._path is None or time.time() - self._path.stat().st_mtime > self._limit_s:
                return None
            with np.load(self._path, allow_pickle=False) as archive:
                return {key: archive[key] for key in archive.files}
        except FileNotFoundError:
            return None
        except Exception as error:  # zipfile and NumPy raise whatever a broken file makes them stumble over
            self._node.get_logger().warning(f'{self._path}: {error}: beginning anew')
            return None

    def keep(self, state: State) -> None:
        """Keep a state; where the disk does not take it, the node works on without."""
        if self._path is None or self._limit_s <= 0.0:
            return
        try:
            with written_aside(self._path) as aside, aside.open('wb') as stream:
                np.savez(stream, **state)  # type: ignore[arg-type]
        except OSError as error:
            self._node.get_logger().warning(
                f'{self._path}: {error.strerror}: killed now, the node would begin anew', throttle_duration_sec=60.0
            )

    def forget(self) -> None:
        """Leave nothing."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)


def _folder() -> Path | None:
    """A folder of this user alone, or None where somebody else has made it."""
    chosen = os.environ.get(_FOLDER)
    runtime = os.environ.get('XDG_RUNTIME_DIR')
    base = Path(runtime) if runtime and Path(runtime).is_dir() else Path(tempfile.gettempdir())
    folder = Path(chosen) if chosen else base / f'thinmap-{os.getuid()}'
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return folder if folder.stat().st_uid == os.getuid() else None
    except OSError:
        return None
