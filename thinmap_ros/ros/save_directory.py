"""Where services may read and write: below one folder that the operator chose, wherever links lead.

Whoever can call a service can name a path in it. What the operator names when starting a node (the
parameters `session` and `map`) is not confined.
"""

from pathlib import Path

from rclpy.node import Node

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.files.sessions import ENDINGS, stem_of
from thinmap_ros.ros import parameters

_LONGEST_PATH = 1000


class SaveDirectory:
    """The folder below which the paths of a node's services lie."""

    def __init__(self, node: Node) -> None:
        """Declare the parameter `save_folder`; empty: the working directory of the node."""
        description = 'folder below which services save and load; empty: the working directory'
        given = parameters.declare_parameter(node, 'save_folder', '', description)
        self.path = Path(str(given)).resolve()

    def resolve(self, given: str) -> str:
        """Return the absolute path of what a service names below this folder, links resolved.

        Raises InputError where it, or a file of the session that it names, is elsewhere.
        """
        expected = f'expected a file below {self.path}'
        if not given.isprintable() or len(given) > _LONGEST_PATH:
            raise InputError(f'path {quoted(given)}: {expected}')
        stem_of(given)  # a path that names no session is refused as such
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
