"""Logs as events, and the formats that open them."""

import importlib
import pkgutil
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.logs import readers

_MAX_REASONS = 20
_OTHER = 'other reasons'


@dataclass(frozen=True, eq=False)
class OdometryEvent:
    """An odometry sample: T_odom_base (3,) at stamp_ns.

    is_measured: False in a log without odometry, in which the robot never moves in its frame;
    tilt_rad: of the robot, 0 where it is unknown.
    """

    stamp_ns: int
    T_odom_base: Array
    is_measured: bool = True
    tilt_rad: float = 0.0


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


@dataclass(frozen=True)
class LaserOptions(Config):
    """Properties of the laser that FLASER lines do not contain.

    ROBOTLASER1 lines contain them; an offset given here takes precedence.
    """

    start_angle_deg: float = parameter(
        -90.0, 'bearing of the first beam, degrees', low=-360.0, high=360.0
    )
    step_deg: float = parameter(
        0.0,
        'angle between beams, degrees; 0: 1 for 180 beams, else 180 over the intervals',
        low=-10.0,
        high=10.0,
    )
    offset_m: float = parameter(0.0, 'laser ahead of the robot centre, m', low=-5.0, high=5.0)
    range_min_m: float = parameter(0.02, 'nearest valid range, m', low=0.0, high=10.0)
    range_max_m: float = parameter(
        80.0, 'ranges from here on are "no return", m', low=0.1, high=1000.0
    )


@dataclass(frozen=True, eq=False)
class LogOptions:
    """What a user states about a log; empty or None: as in the log. A format ignores the others'.

    carmen: laser of a CARMEN log; T_base_laser (3,): the laser on the robot; laser: parameters of
    the laser. The others are topics, frames and the source of odometry of a bag (see `BagLog`).
    """

    carmen: LaserOptions = field(default_factory=LaserOptions)
    scan_topic: str | tuple[str, ...] = ''
    odometry_topic: str = ''
    T_base_laser: Array | None = None
    base_frame: str = ''
    odometry_source: str = ''
    odom_frame: str = ''
    laser: LaserConfig = field(default_factory=LaserConfig)


@dataclass(frozen=True)
class LogFormat:
    """A format of logs: name as in "expected ..."; whether it opens a path; and its log.

    opens reads the first bytes at most, and is False for what it cannot read.
    """

    name: str
    opens: Callable[[Path], bool]
    log: Callable[[Path, LogOptions], Log]


def log_formats() -> list[LogFormat]:
    """Formats of all modules in `logs.readers`, in the order of the names of the modules."""
    names = sorted(module.name for module in pkgutil.iter_modules(readers.__path__))
    modules = [importlib.import_module(f'{readers.__name__}.{name}') for name in names]
    return [module.FORMAT for module in modules]


def known_formats() -> str:
    """Names of all formats, as the end of "expected ..."."""
    return ', or '.join(known.name for known in log_formats())


def format_of(path: Path) -> LogFormat:
    """Return the first format that opens a path. Raises InputError if there is none."""
    for known in log_formats():
        if known.opens(path):
            return known
    found = 'unknown format of a log' if path.exists() else 'no such file or folder'
    raise InputError(f'{path}: {found}: expected {known_formats()}')
