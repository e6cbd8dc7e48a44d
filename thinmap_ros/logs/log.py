"""Events of a log or bag, in the order of writing, and detection of file formats."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.odometry import ScanOdometrySynchronizer
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.files.regular_files import open_regular_file
from thinmap_ros.logs.mcap_records import MAGIC as _MCAP

if TYPE_CHECKING:
    from thinmap_ros.logs.carmen import LaserOptions

_ROS1 = b'#ROSBAG V'
_SQLITE = b'SQLite format 3\0'


@dataclass(frozen=True, eq=False)
class OdometryEvent:
    """An odometry sample: T_odom_base (3,) at stamp_ns."""

    stamp_ns: int
    T_odom_base: Array


@dataclass(frozen=True, eq=False)
class ScanEvent:
    """A scan."""

    scan: Scan


Event = OdometryEvent | ScanEvent


@dataclass
class SkippedRecords:
    """Number of unusable records, and the first one."""

    count: int = 0
    first: str = ''

    def add(self, where: str) -> None:
        """Count a record."""
        self.count += 1
        self.first = self.first or where

    def add_first(self, where: str) -> None:
        """Count a record and report it as the first one."""
        self.count += 1
        self.first = where


class Log(Protocol):
    """A log file or bag."""

    @property
    def skipped(self) -> SkippedRecords:
        """Unusable records so far."""
        ...

    @property
    def expected_scans(self) -> int | None:
        """Number of scans, roughly, for a progress bar; None if unknown."""
        ...

    def events(self) -> Iterator[Event]:
        """Odometry and scans in the order of the file."""
        ...


def open_log(
    path: Path | str,
    laser: 'LaserOptions | None' = None,
    scan_topic: str = '',
    odometry_topic: str = '',
    T_base_laser: Array | None = None,
    base_frame: str = 'base_link',
) -> Log:
    """Return the log of a path: a rosbag2 folder, an MCAP file, or else a CARMEN log.

    laser describes the laser of a CARMEN log. For a bag: scan_topic and odometry_topic, empty for
    the only topic of their type; T_base_laser (3,), the laser on the robot, None for the one of
    /tf_static; base_frame, the robot's frame. The log is read when its events are.
    """
    # Imported here: both modules import this one.
    from thinmap_ros.logs.bag import BagLog
    from thinmap_ros.logs.carmen import CarmenLog, LaserOptions

    path = Path(path)
    if path.is_dir() or path.suffix == '.mcap' or is_mcap(path):
        return BagLog(path, scan_topic, odometry_topic, T_base_laser, base_frame)
    return CarmenLog(path, laser or LaserOptions())


def paired_scans(log: Log) -> Iterator[tuple[Scan, Array]]:
    """Scans of a log in their order, each with the odometry pose T_odom_base (3,) at its stamp.

    A scan without odometry around its stamp is left out. Raises InputError where the log cannot be
    read.
    """
    pairing = ScanOdometrySynchronizer()
    for event in log.events():
        if isinstance(event, OdometryEvent):
            yield from pairing.add_odometry(event.stamp_ns, event.T_odom_base)
        else:
            yield from pairing.add_scan(event.scan)


def refuse_foreign(path: Path) -> None:
    """Raise InputError, with a command for conversion, for a ROS 1 bag or a bare SQLite file."""
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
    """Whether a file begins with the magic bytes of MCAP."""
    return _begin(path).startswith(_MCAP)


def _begin(path: Path) -> bytes:
    """First bytes of a file; empty if it cannot be read: opening it reports the error."""
    try:
        with open_regular_file(path) as stream:
            return stream.read(16)
    except OSError:
        return b''
