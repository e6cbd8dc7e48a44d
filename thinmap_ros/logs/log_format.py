"""Formats of logs: what a module of `logs.readers` defines, and which one opens a file."""

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import LaserConfig
from thinmap_ros.core.se2 import Array
from thinmap_ros.logs import readers
from thinmap_ros.logs.laser_options import LaserOptions
from thinmap_ros.logs.log import Log


@dataclass(frozen=True, eq=False)
class LogOptions:
    """What a user states about a log; empty or None: as in the log. A format ignores the others'.

    carmen: laser of a CARMEN log; T_base_laser (3,): the laser on the robot; laser: parameters of
    the laser. The others are topics, frames and the source of odometry of a bag (see `BagLog`).
    """

    carmen: LaserOptions = field(default_factory=LaserOptions)
    scan_topic: str = ''
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
