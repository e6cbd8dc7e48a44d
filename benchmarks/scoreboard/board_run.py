"""Run the board: recordings first, then its cases, then its page."""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from benchmarks.scoreboard.board import board_cases
from benchmarks.scoreboard.board_rows import board_table
from benchmarks.scoreboard.cases import BuildingCase, Case, DriveCase, LogCase, flat
from benchmarks.scoreboard.closed_loop import measure_drive, measure_loop, record_drive
from benchmarks.scoreboard.compare import against
from benchmarks.scoreboard.measure import Task, measure_building, measure_log
from benchmarks.scoreboard.page import COLUMN_NOTES, case_tables
from benchmarks.scoreboard.played import Numbers
from benchmarks.scoreboard.reports import report_file, report_of, reports_there
from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.parallel_jobs import (
    Failure,
    failure_summary,
    provenance,
    read_report,
    run_pending,
    write_provenance,
)
from thinmap_ros.files.safe import write_text

FOLDER = 'board'  # of the results; a case of the complete scoreboard may have the same name
# A graph costs more than a pose, and the pose needs little of it: of replayed drives there is a new
# one every 2 s. Scans of these logs are up to metres apart: a new one with each.
_SCANS_PER_GRAPH = 10
_SPARSE_LOGS = ('aces', 'csail', 'fhw', 'intel_sparse')
_HEAD = """\
# Targets of SLAM

{provenance}

"""


@dataclass(frozen=True)
class BoardTask:
    """A case of the board, and what it is measured with.

    of_log: the same for the complete scoreboard; worlds: folder of worlds.json; recordings: folder
    of recorded drives.
    """

    of_log: Task
    worlds: Path
    recordings: Path

    @property
    def name(self) -> str:
        """That of the case."""
        return self.of_log.name


@dataclass(frozen=True)
class RecordTask:
    """A drive to record."""

    world: str
    worlds: Path
    recordings: Path

    @property
    def name(self) -> str:
        """That of the recording."""
        return flat(self.world)


def run_board(arguments: argparse.Namespace, options: Numbers) -> None:
    """Run the cases without a result; write targets.md, met or missed, and cases.md.

    Raises InputError where a case fails, after all others.
    """
    cases = _chosen(arguments)
    files = [report_file(arguments.out, case.name, FOLDER) for case in cases]
    for file in files:
        if file.exists():
            read_report(file, options)  # before minutes of work
    missing = [case for case, file in zip(cases, files, strict=True) if not file.exists()]
    recordings = arguments.recordings or arguments.out / 'drives'
    failures = _record(missing, recordings, arguments)
    failures |= _run_cases(cases, recordings, options, arguments)
    reports = [report_of(arguments.out, case.name, options, failures, FOLDER) for case in cases]
    others = reports_there(arguments.against, cases, FOLDER) if arguments.against else None
    table = board_table(reports, _names(arguments), others)
    taken = sum(report.get('cpu_s', 0.0) for report in reports)
    write_provenance(arguments.out)
    head = _HEAD.format(provenance=provenance(arguments.out))
    board = f'{head}{table}\nCPU time of all cases: {taken:.0f} s.\n'
    write_text(arguments.out / 'targets.md', board)
    tables = f'{COLUMN_NOTES}\n{case_tables(reports)}'
    if others is not None:
        tables += '\n' + against(cases, reports, others)
    write_text(arguments.out / 'cases.md', tables)
    print(f'{table}\n{arguments.out}/targets.md, cases.md')
    if failures:
        raise failure_summary(failures)


def measure_on_board(task: BoardTask) -> Numbers:
    """Name, options and numbers of a case, and what it took of the processor."""
    began = time.process_time()
    case = task.of_log.case
    options = task.of_log.options
    if isinstance(case, LogCase):
        scans_per_graph = 1 if case.log in _SPARSE_LOGS else _SCANS_PER_GRAPH
        numbers = measure_log(case, task.of_log, scans_per_graph)
    elif isinstance(case, BuildingCase):
        numbers = measure_building(case, options, _SCANS_PER_GRAPH)
    elif isinstance(case, DriveCase):
        numbers = measure_drive(case, task.recordings, options, _SCANS_PER_GRAPH)
    else:
        numbers = measure_loop(case, task.worlds, options)
    taken = {'cpu_s': time.process_time() - began, 'made': provenance()}
    return {'name': task.name, 'options': options, **taken, **numbers}


def record(task: RecordTask) -> Numbers:
    """Record a drive; returns what it took and how it ended."""
    began = time.process_time()
    path = task.recordings / f'{task.name}.npz'
    numbers = record_drive(task.world, task.worlds, path)
    return {'name': task.name, 'cpu_s': time.process_time() - began, **numbers}


def _names(arguments: argparse.Namespace) -> list[str]:
    return [case.name for case in board_cases(arguments.shared / 'data' / 'logs')]


def _chosen(arguments: argparse.Namespace) -> list[Case]:
    cases = board_cases(arguments.shared / 'data' / 'logs')
    chosen = [case for case in cases if fnmatch(case.name, arguments.only)]
    if not chosen:
        raise InputError(f'--only {arguments.only}: no case of the board has such a name')
    return chosen


def _record(
    cases: Sequence[Case], recordings: Path, arguments: argparse.Namespace
) -> dict[str, Failure]:
    worlds = dict.fromkeys(case.world for case in cases if isinstance(case, DriveCase))
    folder = arguments.shared / 'data' / 'worlds'
    tasks = [RecordTask(world, folder, recordings) for world in worlds]
    return run_pending(
        record, tasks, lambda task: recordings / f'{task.name}.json', arguments, arguments.quiet
    )


def _run_cases(
    cases: Sequence[Case], recordings: Path, options: Numbers, arguments: argparse.Namespace
) -> dict[str, Failure]:
    data = arguments.shared / 'data'
    degrade = arguments.shared / 'tools' / 'degrade_log.py'
    tasks = [
        BoardTask(
            Task(case, data / 'logs', degrade, arguments.out / 'logs', options),
            data / 'worlds',
            recordings,
        )
        for case in cases
    ]
    return run_pending(
        measure_on_board,
        tasks,
        lambda task: report_file(arguments.out, task.name, FOLDER),
        arguments,
        arguments.quiet,
    )
