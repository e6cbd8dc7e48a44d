"""Results: tables and figures of an experiment, rows and targets of a benchmark."""

import csv
import io
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from thinmap_ros.view.plots import Plot

Rows = list[list[Any]]


@dataclass(frozen=True, eq=False)
class Table:
    """Rows under columns (with units in their names).

    timed: contains times, which differ from run to run.
    """

    name: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    timed: bool = False

    def csv(self) -> str:
        """Text of a CSV file; numbers are rounded to 1e-6."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator='\n')
        writer.writerow(self.columns)
        writer.writerows([_cell(value) for value in row] for row in self.rows)
        return text.getvalue()


@dataclass(frozen=True)
class Comparison:
    """A result of a paper and ours.

    met: whether ours is as good; None: there is no number.
    """

    what: str
    paper: str
    ours: str
    met: bool | None = None
    timed: bool = False
    remark: str = ''


@dataclass(frozen=True, eq=False)
class Outcome:
    """Results of one experiment. source: paper and figures; how: procedure."""

    title: str
    source: str
    how: str
    tables: list[Table] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)
    comparisons: list[Comparison] = field(default_factory=list)


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


COLUMNS = ('what', 'value', 'target', 'verdict')
VERDICTS = {True: 'ok', False: 'MISSED', None: ''}


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


def _cell(value: Any) -> str:
    if value is None:
        return ''
    if isinstance(value, bool | str | int):
        return str(value)
    # Minus zero is zero.
    return f'{round(float(value), 6) + 0.0:.6f}'.rstrip('0').rstrip('.')
