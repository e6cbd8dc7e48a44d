"""Rows of results: a value with its target, records of runs, as CSV and as tables in Markdown."""

import csv
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_origin, get_type_hints

from thinmap_ros.evaluation.outcome import Table
from thinmap_ros.evaluation.parallel_jobs import write_provenance
from thinmap_ros.files.safe import write_text

COLUMNS = ('what', 'value', 'target', 'verdict')
VERDICTS = {True: 'ok', False: 'MISSED', None: ''}
Written = dict[str, str]  # a record as it is in a file
AnyCase = TypeVar('AnyCase')


@dataclass(frozen=True)
class Row:
    """One measurement; good: whether the target is met, None without a target."""

    what: str
    value: str
    target: str = ''
    good: bool | None = None


@dataclass(frozen=True, eq=False)
class Case:
    """A run: a name that no other case of its file has, and what returns its record."""

    name: str
    run: Callable[[], dict[str, Any]]


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
    if path is not None:
        path.unlink(missing_ok=True)
    for row in rows:
        verdict = VERDICTS[row.good]
        print(f'{row.what:<58} {row.value:>16}  {row.target:<18} {verdict}', flush=True)
        if path is not None:
            cells = (row.what, row.value, row.target, verdict)
            add_record(path, dict(zip(COLUMNS, cells, strict=True)))


def markdown(columns: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    """A table in Markdown, without an end of its last line."""
    lines = [list(columns), *rows]
    texts = [f'| {" | ".join(map(str, line))} |' for line in lines]
    return '\n'.join([texts[0], '|' + '---|' * len(columns), *texts[1:]])


def read_rows(path: Path) -> list[list[str]]:
    """Rows of a CSV file below its head; none where there is no file."""
    return [list(record.values()) for record in read_records(path)]


def read_records(path: Path) -> list[Written]:
    """Records of a CSV file, by column; none where there is no file."""
    if not path.exists():
        return []
    with path.open(encoding='utf-8', newline='') as file:
        return list(csv.DictReader(file))


def read_cases(path: Path, kind: type[AnyCase]) -> list[AnyCase]:
    """Records of a CSV file as dataclasses; an empty cell is the default of its field.

    Cells of bool are yes, those of tuples are words.
    """
    kinds = get_type_hints(kind)
    return [
        kind(**{name: _cell(text, kinds[name]) for name, text in record.items() if text})
        for record in read_records(path)
    ]


def _cell(text: str, kind: Any) -> Any:
    if get_origin(kind) is tuple:
        return tuple(text.split())
    return text == 'yes' if kind is bool else kind(text)


def add_record(path: Path, record: dict[str, Any]) -> None:
    """Add a line to a CSV file, which is made where it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open('a', encoding='utf-8', newline='') as file:
        writer = csv.DictWriter(file, list(record), lineterminator='\n')
        if file.tell() == 0:
            writer.writeheader()
        writer.writerow(record)


def shown(table: Table) -> str:
    """A table as Markdown."""
    return markdown(table.columns, [map(_text, row) for row in table.rows])


def _text(value: Any) -> str:
    if value is None:
        return '-'
    if isinstance(value, float):
        return f'{value:.3f}' if 0.0 < abs(value) < 1.0 else f'{value:.1f}'
    return str(value)


def show_tables(tables: Iterable[Table], folder: Path | None = None) -> None:
    """Print each table as soon as it is available; folder: for CSV files and provenance."""
    for table in tables:
        print(f'\n## {table.name}\n\n{shown(table)}', flush=True)
        if folder is not None:
            write_text(folder / f'{table.name}.csv', table.csv())
    if folder is not None:
        write_provenance(folder)


def run_pending(cases: Iterable[Case], path: Path) -> None:
    """Run the cases that a file does not have yet, and add a line for each."""
    done = {record['case'] for record in read_records(path)}
    for case in cases:
        if case.name not in done:
            add_record(path, {'case': case.name, **case.run()})
