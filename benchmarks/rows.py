"""Rows of benchmarks: a value with its target, printed and written as CSV."""

import csv
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

COLUMNS = ('what', 'value', 'target', 'verdict')
VERDICTS = {True: 'ok', False: 'MISSED', None: ''}


@dataclass(frozen=True)
class Row:
    """One measurement; good: whether the target is met, None without a target."""

    what: str
    value: str
    target: str = ''
    good: bool | None = None


def at_most(what: str, value: float, limit: float, unit: str = '') -> Row:
    """Row of a value with an upper limit."""
    return Row(
        what, f'{value:.3g} {unit}'.strip(), f'at most {limit:g} {unit}'.strip(), value <= limit
    )


def at_least(what: str, value: float, limit: float, unit: str = '') -> Row:
    """Row of a value with a lower limit."""
    return Row(
        what, f'{value:.4g} {unit}'.strip(), f'at least {limit:g} {unit}'.strip(), value >= limit
    )


def show(rows: Iterable[Row], path: Path | None = None) -> None:
    """Print each row as soon as it is available, and optionally write them to a CSV file."""
    with ExitStack() as stack:
        writer = None
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = stack.enter_context(path.open('w', encoding='utf-8', newline='', buffering=1))
            writer = csv.writer(file, lineterminator='\n')
            writer.writerow(COLUMNS)
        for row in rows:
            shown = (row.what, row.value, row.target, VERDICTS[row.good])
            print(
                f'{row.what:<58} {row.value:>16}  {row.target:<18} {VERDICTS[row.good]}', flush=True
            )
            if writer is not None:
                writer.writerow(shown)
