"""Directory in which services may read and write, symbolic links resolved.

Any caller of a service can name a path. Paths that the operator gives when starting a node (the
parameters `session` and `map`) are not confined.
"""

from pathlib import Path

from rclpy.node import Node

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.files.limits import FILES
from thinmap_ros.files.sessions import ENDINGS, stem_of
from thinmap_ros.ros import parameters


class SaveDirectory:
    """The directory that contains the paths of a node's services."""

    def __init__(self, node: Node) -> None:
        """Declare the parameter `save_directory`; empty: the working directory of the node."""
        description = (
            'Directory that save and load services are confined to. Empty: the working directory.'
        )
        given = parameters.declare_parameter(node, 'save_directory', '', description)
        self.path = Path(str(given)).resolve()

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
