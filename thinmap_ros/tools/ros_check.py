"""Whether ROS 2 is there, for programs that need it."""

from importlib.util import find_spec

from thinmap_ros.core.errors import ThinmapError

_NEEDED = ('rclpy', 'thinmap_msgs')


def require_ros() -> None:
    """Do nothing where ROS 2 and thinmap's messages can be imported.

    Raises ThinmapError, naming what is missing, where they cannot.
    """
    missing = [name for name in _NEEDED if find_spec(name) is None]
    if missing:
        raise ThinmapError(
            f'needs ROS 2 Jazzy with thinmap_msgs, and Python finds no {" and no ".join(missing)}: '
            'source the setup file of the workspace in which thinmap_msgs is built'
        )
