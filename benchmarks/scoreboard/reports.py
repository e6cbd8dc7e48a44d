"""Reports of finished cases in a folder."""

import json
from collections.abc import Sequence
from pathlib import Path

from benchmarks.scoreboard.cases import Case
from benchmarks.scoreboard.played import Numbers
from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.parallel_jobs import Failure, read_report
from thinmap_ros.files.safe import read_text

RESULTS = 'results'
FOLDER = 'board'  # a case of the complete scoreboard may have the same name


def report_file(out: Path, name: str, folder: str = RESULTS) -> Path:
    """File of the report of a case."""
    return out / folder / f'{name}.json'


def report_of(
    out: Path, name: str, options: Numbers, failures: dict[str, Failure], folder: str = RESULTS
) -> Numbers:
    """Report of a case, or why it failed."""
    if name in failures:
        return {'name': name, 'error': failures[name].reason}
    return read_report(report_file(out, name, folder), options)


def reports_there(out: Path, cases: Sequence[Case], folder: str = RESULTS) -> list[Numbers | None]:
    """Reports of another folder, whatever its options; None for a case that is not there.

    Raises InputError where none is.
    """
    files = [report_file(out, case.name, folder) for case in cases]
    if not any(file.exists() for file in files):
        raise InputError(f'--against {out}: none of these cases has a result there')
    return [json.loads(read_text(file)) if file.exists() else None for file in files]
