"""Events of a log or bag, in the order of writing, and detection of file formats."""

import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer
from thinmap_ros.files.regular_files import open_regular_file
from thinmap_ros.logs.mcap_records import MAGIC as _MCAP

if TYPE_CHECKING:
    from thinmap_ros.logs.carmen import LaserOptions

_MAX_REASONS = 20
_OTHER = 'other reasons'
# Scans of a log that may wait for odometry: those of a fast laser between two samples.
WAITING_SCANS = 200
_ROS1 = b'#ROSBAG V'
_SQLITE = b'SQLite format 3\0'


@dataclass(frozen=True, eq=False)
class OdometryEvent:
    """An odometry sample: T_odom_base (3,) at stamp_ns.

    is_measured: False in a log without odometry, in which the robot never moves in its frame.
    """

    stamp_ns: int
    T_odom_base: Array
    is_measured: bool = True


@dataclass(frozen=True, eq=False)
class ScanEvent:
    """A scan."""

    scan: Scan


Event = OdometryEvent | ScanEvent


@dataclass
class SkippedRecords:
    """Number of unusable records, the first one, and how many have each of the first reasons.

    notes: what was assumed while the log was read, a line each.
    """

    count: int = 0
    first: str = ''
    reasons: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    def add(self, where: str) -> None:
        """Count a record."""
        self.count += 1
        self.first = self.first or where
        is_new = where not in self.reasons
        self.reasons[_OTHER if is_new and len(self.reasons) >= _MAX_REASONS else where] += 1

    def add_first(self, where: str) -> None:
        """Count a record and report it as the first one."""
        self.add(where)
        self.first = where

    def note(self, text: str) -> None:
        """Add a note, once."""
        if text not in self.notes:
            self.notes.append(text)


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

    @property
    def is_sorted(self) -> bool:
        """Whether the order of the file is right, even where stamps step back."""
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
    base_frame: str = '',
    *,
    odometry_source: str = '',
    odom_frame: str = '',
    laser_config: LaserConfig | None = None,
) -> Log:
    """Return the log of a path: a rosbag2 folder or file, a ROS 1 bag, or else a CARMEN log.

    laser describes the laser of a CARMEN log; T_base_laser (3,): the laser on the robot, None for
    that of the log; laser_config: parameters of the laser. For a bag: scan_topic and
    odometry_topic, empty for the only topic of their type; base_frame and odom_frame, empty for
    those of the bag; odometry_source: topic, tf or none, empty for topic, or tf without one. The
    log is read when its events are. Raises InputError for a source that a CARMEN log does not have.
    """
    # Imported here: both modules import this one.
    from thinmap_ros.logs.bag import BagLog
    from thinmap_ros.logs.carmen import CarmenLog, LaserOptions

    path = Path(path)
    if is_bag(path):
        return BagLog(
            path,
            scan_topic,
            odometry_topic,
            T_base_laser,
            base_frame,
            odometry_source,
            odom_frame,
            laser_config or LaserConfig(),
        )
    if odometry_source not in ('', 'topic'):
        raise InputError(
            f'{path}: odometry source {odometry_source}: a CARMEN log has its own odometry'
        )
    return CarmenLog(path, laser or LaserOptions(), T_base_laser, laser_config or LaserConfig())


def recording_events(log: Log) -> Iterator[Event]:
    """Odometry and scans of one recording; late messages of a bag are put in the order of stamps.

    Raises ClockJumpError, an InputError, after the last event before another recording begins: the
    clock jumped back, and the odometry does not continue.
    """
    # Imported here: both modules import this one.
    from thinmap_ros.logs.order.clock_jumps import ClockJumps
    from thinmap_ros.logs.order.stamp_order import by_stamp

    events = ClockJumps(lambda text: log.skipped.note(text)).events(log.events())
    return events if log.is_sorted else by_stamp(events)


def paired_scans(log: Log) -> Iterator[tuple[Scan, Array]]:
    """Scans of a log in their order, each with the odometry pose T_odom_base (3,) at its stamp.

    A scan without odometry around its stamp is left out. Another recording in the same log is left
    out with a warning (see `recording_events`). Raises InputError where the log cannot be read.
    """
    from thinmap_ros.logs.order.clock_jumps import ClockJumpError

    pairing = ScanOdometrySynchronizer(WAITING_SCANS)
    try:
        for event in recording_events(log):
            if isinstance(event, OdometryEvent):
                yield from pairing.add_odometry(event.stamp_ns, event.T_odom_base)
            else:
                yield from pairing.add_scan(event.scan)
        yield from pairing.finish()
    except ClockJumpError as error:
        warnings.warn(str(error), stacklevel=2)


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
