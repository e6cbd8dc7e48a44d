"""Results as rows: what was measured, the value, and what it should be."""

import csv
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Row:
    """One measurement; good: whether the value is as it should be, None without a target."""

    what: str
    value: str
    target: str = ''
    good: bool | None = None


def at_most(what: str, value: float, limit: float, unit: str = '') -> Row:
    """Row of a value that should not be above a limit."""
    return Row(
        what, f'{value:.3g} {unit}'.strip(), f'at most {limit:g} {unit}'.strip(), value <= limit
    )


def at_least(what: str, value: float, limit: float, unit: str = '') -> Row:
    """Row of a value that should not be below a limit."""
    return Row(
        what, f'{value:.4g} {unit}'.strip(), f'at least {limit:g} {unit}'.strip(), value >= limit
    )


COLUMNS = ('what', 'value', 'target', 'verdict')
VERDICTS = {True: 'ok', False: 'MISSED', None: ''}


def show(rows: Iterable[Row], path: Path | None = None) -> None:
    """Print rows, each as soon as it is there, and write them to a CSV file where one is wished."""
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
