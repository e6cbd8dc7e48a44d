"""One program over many files: a folder for each, a table of all; resumable.

Each file is a job of `parallel_jobs`: what is done is not done again, and what fails is named in
the table, while the others run.
"""

import argparse
import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.parallel_jobs import (
    Report,
    failure_summary,
    read_report,
    run_pending,
)
from thinmap_ros.files.safe import write_text
from thinmap_ros.view import report_page

SUMMARY = 'summary.csv'
REASON = 'reason'  # last column: why a file failed, or what is to be said of its result
_DONE = 'job.json'


@dataclass(frozen=True)
class FileJob:
    """A file with the folder of its results.

    options: what else decides about these, for JSON; arguments: of the program, by name.
    """

    path: Path
    folder: Path
    options: dict[str, Any]
    arguments: dict[str, Any]

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.name


@dataclass(frozen=True)
class Batch:
    """What is done with many files.

    work: does one job and returns its row by column; a function of a module, for other processes.
    columns: of the table, between the file and the reason. title: of the page.
    """

    work: Callable[[FileJob], Report]
    columns: tuple[str, ...]
    title: str


def jobs_of(
    paths: Sequence[Path], out: Path, options: dict[str, Any], arguments: dict[str, Any]
) -> list[FileJob]:
    """A job for each file, whose folder has the name of the file, or of its folder and the file.

    Raises InputError where two files would have the same folder.
    """
    names = _names(paths)
    for path, name in zip(paths, names, strict=True):
        if names.count(name) > 1:
            raise InputError(f'{path}: {name}: expected files of different names, or given once')
    absolute = {path: path.absolute() for path in paths}
    return [
        FileJob(
            absolute[path],
            (out / name).absolute(),
            {'file': str(absolute[path]), **options},
            arguments,
        )
        for path, name in zip(paths, names, strict=True)
    ]


def run_batch(batch: Batch, jobs: Sequence[FileJob], arguments: argparse.Namespace) -> None:
    """Do all jobs that are not done, and write summary.csv and report.html over all of them.

    arguments: those of `add_run_options`, with out, quiet and the command. Raises InputError where
    a job was done with other options, and, after all are done, for those that failed.
    """
    done = [job for job in jobs if _report_file(job).exists()]
    for job in done:
        read_report(_report_file(job), job.options)
    failures = run_pending(batch.work, jobs, _report_file, arguments, arguments.quiet)
    rows = []
    for job in jobs:
        failure = failures.get(job.name)
        row: Report = {REASON: failure.reason} if failure else _row(job)
        cells = [row.get(column, '') for column in (*batch.columns, REASON)]
        rows.append([str(job.path), *cells])
    columns = ['file', *batch.columns, REASON]
    write_text(arguments.out / SUMMARY, _csv(columns, rows))
    pages = [report_page.Entry(job.folder, row) for job, row in zip(jobs, rows, strict=True)]
    report_page.write_batch(arguments.out, batch.title, columns, pages, arguments.command)
    resumed = f', {len(done)} of them before' if done else ''
    print(f'{arguments.out}: {len(jobs) - len(failures)} of {len(jobs)} done{resumed}')
    if failures:
        raise failure_summary(failures)


def _row(job: FileJob) -> Report:
    report = read_report(_report_file(job), job.options)
    row: Report = report['row']
    return row


def reported(job: FileJob, row: Report) -> Report:
    """What a job returns: its options, by which it is resumed, and its row."""
    return {'options': job.options, 'row': row}


def _report_file(job: FileJob) -> Path:
    return job.folder / _DONE


def _names(paths: Sequence[Path]) -> list[str]:
    """Names of files without their endings; of those that are alike, with their folder."""
    short = [_stem(path) for path in paths]
    return [
        f'{path.absolute().parent.name}-{name}' if short.count(name) > 1 else name
        for path, name in zip(paths, short, strict=True)
    ]


def _stem(path: Path) -> str:
    """Name of a file without all of its endings; a dot at the beginning is none."""
    return path.name[:1] + path.name[1:].partition('.')[0]


def _csv(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()
