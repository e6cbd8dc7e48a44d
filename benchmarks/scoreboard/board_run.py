"""Run the board: recordings first, then its cases, then its pages."""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from benchmarks.scoreboard.against import against
from benchmarks.scoreboard.board import board_cases, board_rows, cases_of
from benchmarks.scoreboard.cases import BuildingCase, Case, DriveCase, LogCase, flat
from benchmarks.scoreboard.closed_loop import measure_drive, measure_loop, record_drive
from benchmarks.scoreboard.measure import Task, measure_building, measure_log
from benchmarks.scoreboard.page import case_tables
from benchmarks.scoreboard.played import Numbers
from benchmarks.scoreboard.reports import report_file, report_of, reports_there
from thinmap_ros.adapters.files import write_text
from thinmap_ros.core.errors import InputError
from thinmap_ros.tools.explore_world import SCANS_PER_GRAPH
from thinmap_ros.tools.runs import Failure, complaint, read_report, run_missing

FOLDER = 'board'  # of the results; a case of the complete scoreboard may have the same name
_HEAD = """\
# Board

Made by `python -m benchmarks.scoreboard -o DIR --board`; each case is in [cases.md](cases.md).
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
    """Run what is missing of the board, and write its pages.

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
    table = _table(reports)
    write_text(arguments.out / 'board.md', _HEAD + '\n' + table)
    tables = case_tables(cases, reports)
    if arguments.against:
        tables += '\n' + against(cases, reports, reports_there(arguments.against, cases, FOLDER))
    write_text(arguments.out / 'cases.md', '# Cases of the board\n\n' + tables)
    print(f'{table}\n{arguments.out}/board.md')
    if failures:
        raise complaint(failures)


def measure_on_board(task: BoardTask) -> Numbers:
    """Name, options and numbers of a case, and what it took of the processor."""
    began = time.process_time()
    case = task.of_log.case
    options = task.of_log.options
    if isinstance(case, LogCase):
        numbers = measure_log(case, task.of_log, SCANS_PER_GRAPH)
    elif isinstance(case, BuildingCase):
        numbers = measure_building(case, options, SCANS_PER_GRAPH)
    elif isinstance(case, DriveCase):
        numbers = measure_drive(case, task.recordings, options)
    else:
        numbers = measure_loop(case, task.worlds, options)
    taken = {'cpu_s': time.process_time() - began}
    return {'name': task.name, 'options': options, **taken, **numbers}


def record(task: RecordTask) -> Numbers:
    """Record a drive; returns what it took and how it ended."""
    began = time.process_time()
    path = task.recordings / f'{task.name}.npz'
    numbers = record_drive(task.world, task.worlds, path)
    return {'name': task.name, 'cpu_s': time.process_time() - began, **numbers}


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
    return run_missing(
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
    return run_missing(
        measure_on_board,
        tasks,
        lambda task: report_file(arguments.out, task.name, FOLDER),
        arguments,
        arguments.quiet,
    )


def _table(reports: Sequence[Numbers]) -> str:
    """What is asked, what was measured, met or missed, of all rows with a case among these."""
    names = [report['name'] for report in reports]
    lines = ['| row | asked | measured | |', '|---|---|---|---|']
    for row in board_rows():
        own = [reports[k] for k in cases_of(row, names)]
        if not own:
            continue
        found = [report for report in own if 'error' not in report]
        measured, is_met = row.judge(found) if found else ('', False)
        failed = len(own) - len(found)
        if failed:
            measured += f' ({failed} of {len(own)} failed)'
        verdict = 'met' if is_met and not failed else 'MISSED'
        lines.append(f'| {row.title} | {row.asked} | {measured} | {verdict} |')
    return '\n'.join(lines) + '\n'
