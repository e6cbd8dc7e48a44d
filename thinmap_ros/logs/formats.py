"""Formats of log files, told by their first bytes."""

from pathlib import Path

from thinmap_ros.core.errors import InputError
from thinmap_ros.files.safe import open_regular_file
from thinmap_ros.logs.mcap import MAGIC as _MCAP

_ROS1 = b'#ROSBAG V'
_SQLITE = b'SQLite format 3\0'


def refuse_foreign(path: Path, expected: str) -> None:
    """Raise InputError, with a command for conversion, for a ROS 1 bag or an SQLite file."""
    kinds = ((is_ros1, 'a ROS 1 bag'), (is_sqlite, 'an SQLite file of a rosbag2 bag'))
    for is_kind, name in kinds:
        if is_kind(path):
            convert = f'rosbags-convert --src {path} --dst {path.stem} --dst-storage mcap'
            raise InputError(
                f'{path}: {name}: expected {expected}: it is converted by '
                f'`{convert} --dst-typestore ros2_jazzy`'
            )


def is_bag(path: Path) -> bool:
    """Whether a path is a folder, or a file of a bag by its name or its first bytes."""
    if path.is_dir() or path.suffix in ('.mcap', '.db3', '.bag', '.zstd'):
        return True
    return is_mcap(path) or is_ros1(path) or is_sqlite(path)


def is_mcap(path: Path) -> bool:
    """Whether a file begins with the magic bytes of MCAP."""
    return _begin(path).startswith(_MCAP)


def is_ros1(path: Path) -> bool:
    """Whether a file begins as a ROS 1 bag."""
    return _begin(path).startswith(_ROS1)


def is_sqlite(path: Path) -> bool:
    """Whether a file begins as an SQLite database."""
    return _begin(path).startswith(_SQLITE)


def _begin(path: Path) -> bytes:
    """First bytes of a file; empty if it cannot be read: opening it reports the error."""
    try:
        with open_regular_file(path) as stream:
            return stream.read(16)
    except OSError:
        return b''
