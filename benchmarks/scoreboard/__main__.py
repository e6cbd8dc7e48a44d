"""Run the scoreboard: python -m benchmarks.scoreboard -o DIR [--short | --board].

The board (--board) is one table of what is asked of the localizer, met or missed: some logs and
buildings, recorded drives (drive_WORLD.odometry_SEED) and the closed loop (loop_WORLD.LASER_SEED).

What is finished is kept: started again with the same folder and options, only what is missing is
run. A case that fails is named on the page, and is tried again by the next run.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

from benchmarks.scoreboard.board import board_cases, board_table
from benchmarks.scoreboard.cases import (
    BY_HAND,
    Case,
    DriveCase,
    LogCase,
    all_cases,
    compared_with,
    repeated,
)
from benchmarks.scoreboard.measure import RecordTask, Task, config_of, measure, record
from benchmarks.scoreboard.page import (
    COLUMN_NOTES,
    FOLDER,
    RESULTS,
    against,
    case_tables,
    page,
    report_file,
    report_of,
    reports_there,
    shortened,
    worst_tenth,
)
from benchmarks.scoreboard.played import Numbers
from thinmap_ros.core.config import parameters_of, suggestion
from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.core.slam.localizer import default_config, parameters_elsewhere
from thinmap_ros.core.stage import StartConfig
from thinmap_ros.evaluation.parallel_jobs import (
    Failure,
    add_run_options,
    failure_summary,
    provenance,
    read_report,
    run_pending,
    write_provenance,
)
from thinmap_ros.files.safe import read_text, write_text
from thinmap_ros.tools import cli

_SHARED = Path(__file__).resolve().parents[3] / 'shared'
# A graph costs more than a pose, and the pose needs little of it: of replayed drives there is a new
# one every 2 s. Scans of these logs are up to metres apart: a new one with each.
_SCANS_PER_GRAPH = 10
_SPARSE_LOGS = ('aces', 'csail', 'fhw', 'intel_sparse')
_SHORT = Path(__file__).parent / 'short.txt'


def main() -> None:
    """Run the command line."""
    cli.run(_run, _parser())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='benchmarks.scoreboard', description=__doc__)
    parser.add_argument('-o', '--out', type=Path, required=True, help='folder for all results')
    parser.add_argument('--shared', type=Path, default=_SHARED, help='folder of logs and tools')
    parser.add_argument(
        '--short',
        action='store_true',
        help='only the cases of short.txt, the worst tenth of a complete run: some 2 minutes on 2 '
        'cores. Where it is missing or names none: some that were chosen by hand',
    )
    parser.add_argument(
        '--board',
        action='store_true',
        help='targets of the localizer, a row each: some logs and buildings, recorded '
        'drives, the closed loop, other lasers. DIR/targets.md, DIR/cases.md',
    )
    parser.add_argument(
        '--recordings',
        type=Path,
        metavar='DIR',
        help='folder of the recorded drives of the board, which several runs may share '
        '(default: drives in the folder for all results)',
    )
    parser.add_argument('--only', default='*', help='cases whose names match, such as "intel*"')
    parser.add_argument(
        '--set', action='append', default=[], metavar='NAME=VALUE', help='option of the localizer'
    )
    parser.add_argument(
        '--against', type=Path, metavar='DIR', help='compare with the results of another folder'
    )
    parser.add_argument(
        '--write-short',
        action='store_true',
        help='rewrite short.txt from the complete run in DIR (missing cases are run first)',
    )
    parser.add_argument('--quiet', action='store_true', help='no bar of progress')
    parser.add_argument(
        '--runs',
        type=int,
        default=1,
        metavar='N',
        help='run each case N times, all but the first with odometry disturbed by less than wheels '
        'err by: a case in which small causes have large effects is not told by one run',
    )
    add_run_options(parser)
    return parser


def _run(arguments: argparse.Namespace) -> None:
    if arguments.runs < 1:
        raise ConfigError(f'--runs {arguments.runs}: expected 1 or more')
    if arguments.board and (arguments.short or arguments.runs > 1 or arguments.write_short):
        raise ConfigError('--board: expected no --short, --runs or --write-short')
    partial = arguments.short or arguments.only != '*' or arguments.runs > 1
    if arguments.write_short and partial:
        raise ConfigError('--write-short: expected a complete run: no --short, --only or --runs')
    options = _options(arguments.set)
    cases = _board(arguments) if arguments.board else repeated(_chosen(arguments), arguments.runs)
    folder = FOLDER if arguments.board else RESULTS
    files = {case.name: report_file(arguments.out, case.name, folder) for case in cases}
    for file in files.values():
        if file.exists():
            read_report(file, options)  # before hours of work
    task = Task(
        cases[0],
        arguments.shared / 'data',
        arguments.shared / 'tools' / 'degrade_log.py',
        arguments.out / 'logs',
        options,
        _recordings(arguments),
        made=provenance(),
    )
    failures = _record([case for case in cases if not files[case.name].exists()], arguments)
    failures |= run_pending(
        measure,
        [
            replace(task, case=case, scans_per_graph=_scans_per_graph(case, arguments))
            for case in cases
        ],
        lambda task: files[task.name],
        arguments,
        arguments.quiet,
    )
    reports = [report_of(arguments.out, case.name, options, failures, folder) for case in cases]
    write_provenance(arguments.out)
    others = reports_there(arguments.against, cases, folder) if arguments.against else None
    write = _write_board if arguments.board else _write_page
    write(cases, reports, others, arguments)
    if failures:
        raise failure_summary(failures)
    if arguments.write_short:
        write_text(_SHORT, shortened(cases, reports))


def _record(cases: list[Case], arguments: argparse.Namespace) -> dict[str, Failure]:
    """Record the drives that cases replay, where they are not there yet."""
    worlds = dict.fromkeys(case.world for case in cases if isinstance(case, DriveCase))
    recordings = _recordings(arguments)
    folder = arguments.shared / 'data' / 'worlds'
    return run_pending(
        record,
        [RecordTask(world, folder, recordings) for world in worlds],
        lambda task: recordings / f'{task.name}.json',
        arguments,
        arguments.quiet,
    )


def _recordings(arguments: argparse.Namespace) -> Path:
    return Path(arguments.recordings or arguments.out / 'drives')


def _scans_per_graph(case: Case, arguments: argparse.Namespace) -> int:
    is_sparse = isinstance(case, LogCase) and case.log in _SPARSE_LOGS
    return _SCANS_PER_GRAPH if arguments.board and not is_sparse else 1


def _write_page(
    cases: list[Case],
    reports: list[Numbers],
    others: Sequence[Numbers | None] | None,
    arguments: argparse.Namespace,
) -> None:
    text = page(cases, reports, provenance(arguments.out))
    if others is not None:
        text += '\n' + against(cases, reports, others)
    write_text(arguments.out / 'scoreboard.md', text)
    print(f'worst tenth, live: {worst_tenth(cases, reports):.3f} m; {arguments.out}/scoreboard.md')


def _write_board(
    cases: list[Case],
    reports: list[Numbers],
    others: Sequence[Numbers | None] | None,
    arguments: argparse.Namespace,
) -> None:
    """Write targets.md, met or missed, and cases.md."""
    names = [case.name for case in board_cases(arguments.shared / 'data' / 'logs')]
    table = board_table(reports, names, others)
    taken = sum(report.get('cpu_s', 0.0) for report in reports)
    head = f'# Targets of SLAM\n\n{provenance(arguments.out)}\n\n'
    board = f'{head}{table}\nCPU time of all cases: {taken:.0f} s.\n'
    write_text(arguments.out / 'targets.md', board)
    tables = f'{COLUMN_NOTES}\n{case_tables(reports)}'
    if others is not None:
        tables += '\n' + against(cases, reports, others)
    write_text(arguments.out / 'cases.md', tables)
    print(f'{table}\n{arguments.out}/targets.md, cases.md')


def _board(arguments: argparse.Namespace) -> list[Case]:
    cases = board_cases(arguments.shared / 'data' / 'logs')
    chosen = [case for case in cases if fnmatch(case.name, arguments.only)]
    if not chosen:
        raise InputError(f'--only {arguments.only}: no case of the board has such a name')
    return chosen


def _chosen(arguments: argparse.Namespace) -> list[Case]:
    logs = arguments.shared / 'data' / 'logs'
    cases = all_cases(logs)
    chosen = {case.name for case in cases if fnmatch(case.name, arguments.only)}
    if arguments.short:
        chosen &= set(_short_names())
    if not chosen:
        raise InputError(f'--only {arguments.only}: no case has such a name')
    chosen |= {compared_with(case, logs) for case in cases if case.name in chosen}
    return [case for case in cases if case.name in chosen]


def _short_names() -> list[str]:
    lines = read_text(_SHORT).splitlines() if _SHORT.exists() else []
    names = [line.strip() for line in lines if line.strip() and not line.startswith('#')]
    return names or list(BY_HAND)


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
