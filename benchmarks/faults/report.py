"""Table and JSON file of a run."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.faults.judge import Record

_HEAD = ('fault', 'count', 'violations', 'worst error m', 'most driven m', 'recovery s')


def _row(name: str, records: Sequence[Record]) -> tuple[str, ...]:
    recoveries = [r.recovered_s for r in records if r.recovered_s is not None]
    return (
        name,
        str(len(records)),
        str(sum(bool(r.violations()) for r in records)),
        f'{max(r.pose.worst_m for r in records):.2f}',
        f'{max(r.driven_m for r in records):.2f}',
        f'{max(recoveries):.0f}' if recoveries else '-',
    )


def _padded(text: str, width: int) -> str:
    """Texts to the left, numbers to the right."""
    return text.rjust(width) if text[0].isdigit() else text.ljust(width)


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
    rows = [_HEAD, *(_row(name, [r for r in records if r.name == name]) for name in names)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEAD))]
    lines = ['  '.join(map(_padded, row, widths)) for row in rows]
    for record in records:
        lines += [f'{record.name} at {record.time_s:.1f} s: {text}' for text in record.violations()]
    return '\n'.join(lines)


def write_json(path: Path, records: Sequence[Record], run: dict[str, Any]) -> None:
    """Write all records; run: values of the whole run."""
    found = {**run, 'records': [record.as_json() for record in records]}
    path.write_text(json.dumps(found, indent=1) + '\n', encoding='utf-8')
