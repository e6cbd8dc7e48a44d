"""Formats of recorded logs, by how their files begin: what a program does not read, it names."""

from pathlib import Path

from thinmap_ros.core.errors import InputError
from thinmap_ros.logs.mcap_records import MAGIC as _MCAP

_ROS1 = b'#ROSBAG V'
_SQLITE = b'SQLite format 3\0'


def refuse_foreign(path: Path) -> None:
    """Raise InputError, with the command that converts it, at a ROS 1 bag or a bare SQLite file."""
    begin = _begin(path)
    convert = f'rosbags-convert --src {path} --dst {path.stem} --dst-storage mcap'
    if begin.startswith(_ROS1):
        raise InputError(
            f'{path}: a ROS 1 bag: expected a ROS 2 bag or a CARMEN log: convert it with '
            f'`{convert} --dst-typestore ros2_jazzy`'
        )
    if begin.startswith(_SQLITE):
        raise InputError(
            f'{path}: an SQLite file of a rosbag2 bag: expected the folder that holds it and '
            'metadata.yaml; a missing one is written by `ros2 bag reindex -s sqlite3 FOLDER`, '
            f'or a new bag by `{convert}`'
        )


def is_mcap(path: Path) -> bool:
    """Whether a file begins as MCAP files do, whatever its name is."""
    return _begin(path).startswith(_MCAP)


def _begin(path: Path) -> bytes:
    """First bytes; none of what is no file or cannot be read: whoever opens it says so."""
    try:
        with path.open('rb') as stream:
            return stream.read(16)
    except OSError:
        return b''
