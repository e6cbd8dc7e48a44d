"""Run the scoreboard: python -m benchmarks.scoreboard -o DIR [--board].

The board (--board) is what is asked of the localizer, met or missed: some logs and buildings,
recorded drives (drive_WORLD.odometry_SEED) and the closed loop (loop_WORLD.LASER_SEED). Without it,
all logs are made worse in all ways, too, and buildings are driven with more noise. DIR/targets.md
has what is asked of the cases that were run, DIR/cases.md each case.

What is finished is kept: started again with the same folder and options, only what is missing is
run. A case that fails is named, and is tried again by the next run.
"""

import argparse
from fnmatch import fnmatch
from pathlib import Path

from benchmarks.scoreboard.board import board_cases, board_table
from benchmarks.scoreboard.cases import (
    BuildingCase,
    Case,
    DriveCase,
    LogCase,
    all_cases,
    repeated,
)
from benchmarks.scoreboard.measure import RecordTask, Task, config_of, measure, record
from benchmarks.scoreboard.page import (
    COLUMN_NOTES,
    against,
    case_tables,
    report_file,
    report_of,
    reports_there,
)
from benchmarks.scoreboard.played import Numbers
from benchmarks.worlds import SHARED
from thinmap_ros.core.config import parameters_of, suggestion
from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.core.slam.localizer import default_config, parameters_elsewhere
from thinmap_ros.core.stage import StartConfig
from thinmap_ros.evaluation.parallel_jobs import (
    add_run_options,
    failure_summary,
    provenance,
    read_report,
    run_pending,
    write_provenance,
)
from thinmap_ros.files.safe import write_text
from thinmap_ros.tools import cli

# A graph costs more than a pose, and the pose needs little of it: of replayed drives there is a new
# one every 2 s. Scans of these logs are up to metres apart: a new one with each.
_SCANS_PER_GRAPH = 10
_SPARSE_LOGS = ('aces', 'csail', 'fhw', 'intel_sparse')


def main() -> None:
    """Run the command line."""
    cli.run(_run, _parser())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='benchmarks.scoreboard', description=__doc__)
    parser.add_argument('-o', '--out', type=Path, required=True, help='folder for all results')
    parser.add_argument('--shared', type=Path, default=SHARED, help='folder of logs and tools')
    parser.add_argument('--board', action='store_true', help='only the cases of the board')
    parser.add_argument(
        '--recordings',
        type=Path,
        metavar='DIR',
        help='folder of the recorded drives, which several runs may share '
        '(default: drives in the folder for all results)',
    )
    parser.add_argument('--only', default='*', help='cases whose names match, such as "intel*"')
    parser.add_argument(
        '--set', action='append', default=[], metavar='NAME=VALUE', help='option of the localizer'
    )
    parser.add_argument(
        '--against', type=Path, metavar='DIR', help='compare with the results of another folder'
    )
    parser.add_argument('--quiet', action='store_true', help='no bar of progress')
    parser.add_argument(
        '--runs',
        type=int,
        default=1,
        metavar='N',
        help='run each log and building N times, all but the first with odometry disturbed by less '
        'than wheels err by: where small causes have large effects, one run does not tell',
    )
    add_run_options(parser)
    return parser


def _run(arguments: argparse.Namespace) -> None:
    if arguments.runs < 1:
        raise ConfigError(f'--runs {arguments.runs}: expected 1 or more')
    options = _options(arguments.set)
    cases = _chosen(arguments)
    out = arguments.out
    files = {case.name: report_file(out, case.name) for case in cases}
    missing = [case for case in cases if not files[case.name].exists()]
    for name in files.keys() - {case.name for case in missing}:
        read_report(files[name], options)  # before hours of work
    data = arguments.shared / 'data'
    recordings = arguments.recordings or out / 'drives'
    worlds = dict.fromkeys(case.world for case in missing if isinstance(case, DriveCase))
    failures = run_pending(
        record,
        [RecordTask(world, data / 'worlds', recordings) for world in worlds],
        lambda task: recordings / f'{task.name}.json',
        arguments,
        arguments.quiet,
    )
    degrade = arguments.shared / 'tools' / 'degrade_log.py'
    made = provenance()
    tasks = [
        Task(case, data, degrade, out / 'logs', options, recordings, _scans_per_graph(case), made)
        for case in cases
    ]
    failures |= run_pending(
        measure, tasks, lambda task: files[task.name], arguments, arguments.quiet
    )
    write_provenance(out)
    _write([report_of(out, name, options, failures) for name in files], arguments)
    if failures:
        raise failure_summary(failures)


def _scans_per_graph(case: Case) -> int:
    return 1 if isinstance(case, LogCase) and case.log in _SPARSE_LOGS else _SCANS_PER_GRAPH


def _write(reports: list[Numbers], arguments: argparse.Namespace) -> None:
    """Write targets.md, met or missed, and cases.md."""
    names = [report['name'] for report in reports]
    others = reports_there(arguments.against, names) if arguments.against else None
    board = [case.name for case in board_cases(arguments.shared / 'data' / 'logs')]
    table = board_table(reports, board, others)
    taken_s = sum(report.get('cpu_s', 0.0) for report in reports)
    head = f'# Targets of SLAM\n\n{provenance(arguments.out)}\n\n'
    text = f'{head}{table}\nCPU time of all cases: {taken_s:.0f} s.\n'
    write_text(arguments.out / 'targets.md', text)
    changes = '' if others is None else '\n' + against(reports, others)
    write_text(arguments.out / 'cases.md', f'{COLUMN_NOTES}\n{case_tables(reports)}{changes}')
    print(f'{table}\n{arguments.out}/targets.md, cases.md')


def _chosen(arguments: argparse.Namespace) -> list[Case]:
    logs = arguments.shared / 'data' / 'logs'
    cases = {case.name: case for case in board_cases(logs)}
    if not arguments.board:
        cases |= {case.name: case for case in all_cases(logs)}
    chosen = [case for name, case in cases.items() if fnmatch(name, arguments.only)]
    if not chosen:
        raise InputError(f'--only {arguments.only}: no case has such a name')
    simple = [case for case in chosen if isinstance(case, LogCase | BuildingCase) and not case.run]
    again = repeated(simple, arguments.runs)
    return list({case.name: case for case in (*chosen, *again)}.values())


def _options(words: list[str]) -> Numbers:
    """Options of the localizer that `slam` among them selects, each of the type of its default."""
    given = [word.partition('=') for word in words]
    slam = {name: value for name, _, value in given}.get('slam', StartConfig.slam)
    defaults = {name: value for name, _, value in parameters_of(default_config(slam))}
    elsewhere = parameters_elsewhere(slam)
    options: Numbers = {}
    for word, (name, _, value) in zip(words, given, strict=True):
        if name not in defaults:
            meant = suggestion(name, defaults, elsewhere)
            expected = ', '.join(sorted(defaults))
            raise ConfigError(f'--set {word}{meant}: expected one of {expected}')
        kind = type(defaults[name])
        try:
            options[name] = {'true': True, 'false': False}[value] if kind is bool else kind(value)
        except (KeyError, ValueError):
            like = str(defaults[name]).lower() if kind is bool else defaults[name]
            raise ConfigError(f'--set {word}: expected a value like {like}') from None
    config_of(options)
    return options


if __name__ == '__main__':
    main()
