"""What a log or bag holds for us, in the order in which it was written."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array


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
class Skipped:
    """What could not be used: how often, and the first case."""

    count: int = 0
    first: str = ''

    def add(self, where: str) -> None:
        """Count one more."""
        self.count += 1
        self.first = self.first or where

    def add_foremost(self, where: str) -> None:
        """Count one more, which is named before what came first."""
        self.count += 1
        self.first = where


class Log(Protocol):
    """A log file or bag."""

    skipped: Skipped

    def events(self) -> Iterator[Event]:
        """Odometry and scans in the order of the file."""
        ...
