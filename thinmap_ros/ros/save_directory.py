"""The directory in which the services of a node may read and write."""

import shutil
import time
from collections import deque
from pathlib import Path
from typing import Any

from rclpy.node import Node

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.files.safe import FILES
from thinmap_ros.files.sessions import ENDINGS, SessionPart, require_own_files, stem_of
from thinmap_ros.ros import parameters

# A peer that saves again and again neither fills the disk nor keeps the node from its work.
_MAX_SAVES = 20
_PERIOD_S = 60.0
_MIN_FREE_BYTES = 100 << 20


class SaveDirectory:
    """The directory in which the services of a node may read and write, symbolic links resolved.

    Any caller of a service can name a path. Paths that the operator gives when starting a node,
    as parameters, are not confined.
    """

    def __init__(self, node: Node) -> None:
        """Declare the parameter `save_directory`; empty: the working directory of the node."""
        description = (
            'Directory that save and load services are confined to. Empty: the working directory.'
        )
        given = parameters.declare_parameter(node, 'save_directory', '', description)
        self.path = Path(str(given)).resolve()
        self._saves_s: deque[float] = deque(maxlen=_MAX_SAVES)

    def resolve_for_saving(self, given: str, part: SessionPart[Any, Any]) -> str:
        """Absolute path of a session to which a service is to save a part.

        Raises InputError as `resolve`, where a file exists that thinmap has not written, after too
        many saves in a minute, and where the disk is almost full.
        """
        path = self.resolve(given)
        require_own_files(path, part)
        now_s = time.monotonic()
        if len(self._saves_s) == _MAX_SAVES and now_s - self._saves_s[0] < _PERIOD_S:
            raise InputError(
                f'path {quoted(given)}: {_MAX_SAVES} saves within {_PERIOD_S:.0f} s: '
                'expected fewer; save again in a minute'
            )
        free = shutil.disk_usage(self.path).free
        if free < _MIN_FREE_BYTES:
            raise InputError(
                f'path {quoted(given)}: {free} bytes free on the disk: '
                f'expected {_MIN_FREE_BYTES} at least'
            )
        self._saves_s.append(now_s)
        return path

    def resolve(self, given: str) -> str:
        """Absolute path of a session that a service names, links resolved.

        Raises InputError where it, or a file of the session, is outside of this directory.
        """
        expected = f'expected a file below {self.path}'
        if not given.isprintable() or len(given) > FILES.path_length:
            raise InputError(f'path {quoted(given)}: {expected}')
        stem_of(given)  # raises for a path that names no session
        try:
            resolved = (self.path / given).resolve()
            stem = stem_of(str(resolved))
            files = [stem.with_name(stem.name + ending).resolve() for ending in ENDINGS]
        except (OSError, RuntimeError) as error:  # RuntimeError: links that lead in a circle
            raise InputError(f'path {quoted(given)}: {error}: {expected}') from error
        for file in (resolved, *files):
            if not file.is_relative_to(self.path) or file == self.path:
                raise InputError(f'path {quoted(given)}: {expected}')
        return str(resolved)
