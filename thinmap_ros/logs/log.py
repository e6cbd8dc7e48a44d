"""Events of a log or bag, in the order of writing."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

_MAX_REASONS = 20
_OTHER = 'other reasons'


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
