"""Results of an experiment: tables, figures, and comparisons with the papers."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
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


def _cell(value: Any) -> str:
    if value is None:
        return ''
    if isinstance(value, bool | str | int):
        return str(value)
    # Minus zero is zero.
    return f'{round(float(value), 6) + 0.0:.6f}'.rstrip('0').rstrip('.')
