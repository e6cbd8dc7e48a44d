"""Judges what happens during a fault and after it."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.faults.kinds import Fault, Kind
from benchmarks.faults.track import Drawn, Located
from benchmarks.rows import markdown

ERROR_M = 0.1


@dataclass
class PoseWatch:
    """Watches for a pose error that lasts and is not reported.

    limit_s: how long it may last. since_s: time since which it is so, None while it is not;
    worst_m: largest error of a pose that counts as known.
    """

    limit_s: float = Kind.wrong_s
    since_s: float | None = None
    worst_m: float = 0.0
    longest_s: float = 0.0

    def add(self, scan: Located, is_reported: bool) -> None:
        """Add a located scan; is_reported: the node's diagnostics report a fault."""
        if not scan.is_tracking or is_reported:
            self.since_s = None
            return
        self.worst_m = max(self.worst_m, scan.error_m)
        if scan.error_m <= ERROR_M:
            self.since_s = None
            return
        if self.since_s is None or scan.time_s < self.since_s:
            self.since_s = scan.time_s
        self.longest_s = max(self.longest_s, scan.time_s - self.since_s)

    @property
    def is_violated(self) -> bool:
        """Whether an error has lasted for too long without a report."""
        return self.longest_s > self.limit_s


@dataclass
class Record:
    """What happened from the beginning of a fault to the next one.

    driven_m: while the fault lasted; commands: that were not zero while the robot should stand.
    """

    fault: Fault | None
    time_s: float
    driven_m: float = 0.0
    commands: int = 0
    collisions: int = 0
    recovered_s: float | None = None
    pose: PoseWatch = field(default_factory=PoseWatch)
    drawn: Drawn = field(default_factory=Drawn)
    others: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Name of the kind of fault."""
        return self.fault.kind.name if self.fault else 'none'

    def violations(self) -> list[str]:
        """What must not happen, in words."""
        found = []
        if self.collisions:
            found.append(f'{self.collisions} collisions')
        if self.pose.is_violated:
            found.append(
                f'pose error up to {self.pose.worst_m:.2f} m, above {ERROR_M} m for '
                f'{self.pose.longest_s:.1f} s, not reported'
            )
        if self.fault and self.driven_m > self.fault.kind.stop_m:
            found.append(f'drove {self.driven_m:.2f} m, expected {self.fault.kind.stop_m} m')
        if self.commands:
            found.append(f'{self.commands} commands not zero while it should stand')
        return found + self.drawn.violations() + self.others

    def as_json(self) -> dict[str, Any]:
        """Values for a JSON file."""
        return {
            'fault': self.name,
            'number': self.fault.number if self.fault else -1,
            'time_s': round(self.time_s, 2),
            'duration_s': round(self.fault.duration_s, 2) if self.fault else 0.0,
            'seed': self.fault.seed if self.fault else 0,
            'driven_m': round(self.driven_m, 3),
            'worst_error_m': round(self.pose.worst_m, 3),
            'wrong_cells_before': self.drawn.wrong_before,
            'wrong_cells': self.drawn.wrong,
            'recovered_s': None if self.recovered_s is None else round(self.recovered_s, 2),
            'violations': self.violations(),
        }


@dataclass(frozen=True)
class Counts:
    """Counts of a topic at a node: received, lost in transport, missing between the stamps."""

    received: int
    lost: int
    gaps: int


@dataclass(frozen=True)
class Passed:
    """Messages that were passed on by topic, and scans that were dropped on purpose."""

    by_topic: dict[str, int]
    dropped_scans: int


def uncounted(
    topic: str, before: Counts, now: Counts, passed: Passed, passed_before: Passed
) -> str:
    """Messages that a node neither received nor counted as lost, in words; '' for none."""
    sent = passed.by_topic[topic] - passed_before.by_topic[topic]
    known = now.received - before.received + now.lost - before.lost
    if known < sent:
        return f'{topic}: {sent - known} of {sent} messages lost and not counted'
    dropped = passed.dropped_scans - passed_before.dropped_scans
    gaps = now.gaps - before.gaps
    if topic == 'scan' and gaps < dropped:
        return f'scan: {dropped} were never sent, {gaps} counted as gaps between the stamps'
    return ''


_HEAD = ('fault', 'count', 'violations', 'worst error m', 'most driven m', 'recovery s')


def _row(name: str, records: Sequence[Record]) -> tuple[object, ...]:
    recoveries = [r.recovered_s for r in records if r.recovered_s is not None]
    return (
        name,
        len(records),
        sum(bool(r.violations()) for r in records),
        f'{max(r.pose.worst_m for r in records):.2f}',
        f'{max(r.driven_m for r in records):.2f}',
        f'{max(recoveries):.0f}' if recoveries else '-',
    )


def line(record: Record) -> str:
    """What happened, in one line."""
    found = '; '.join(record.violations()) or 'good'
    return (
        f'{record.time_s:8.1f} s  {record.name}: drove {record.driven_m:.2f} m, '
        f'worst error {record.pose.worst_m:.2f} m: {found}'
    )


def table(records: Sequence[Record]) -> str:
    """A line for each kind of fault, and one for each violation."""
    names = sorted({record.name for record in records})
    rows = [_row(name, [r for r in records if r.name == name]) for name in names]
    found = [
        f'{record.name} at {record.time_s:.1f} s: {text}'
        for record in records
        for text in record.violations()
    ]
    return '\n'.join([markdown(_HEAD, rows), *found])


def write_json(path: Path, records: Sequence[Record], run: dict[str, Any]) -> None:
    """Write all records; run: values of the whole run."""
    found = {**run, 'records': [record.as_json() for record in records]}
    path.write_text(json.dumps(found, indent=1) + '\n', encoding='utf-8')
