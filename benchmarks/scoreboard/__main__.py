"""Run the scoreboard: python -m benchmarks.scoreboard -o DIR [--short | --board].

The board (--board) is one table of what is asked of the localizer, met or missed: some logs and
buildings, recorded drives (drive_WORLD.odometry_SEED) and the closed loop (loop_WORLD.LASER_SEED).

What is finished is kept: started again with the same folder and options, only what is missing is
run. A case that fails is named on the page, and is tried again by the next run.
"""

import argparse
from fnmatch import fnmatch
from pathlib import Path

from benchmarks.scoreboard.board_run import run_board
from benchmarks.scoreboard.cases import BY_HAND, Case, all_cases, compared_with, repeated
from benchmarks.scoreboard.compare import against
from benchmarks.scoreboard.measure import Task, config_of, measure
from benchmarks.scoreboard.page import page, shortened, worst_tenth
from benchmarks.scoreboard.played import Numbers
from benchmarks.scoreboard.reports import report_file, report_of, reports_there
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
    if arguments.board:
        if arguments.short or arguments.runs > 1 or arguments.write_short:
            raise ConfigError('--board: expected no --short, --runs or --write-short')
        run_board(arguments, _options(arguments.set))
        return
    partial = arguments.short or arguments.only != '*' or arguments.runs > 1
    if arguments.write_short and partial:
        raise ConfigError('--write-short: expected a complete run: no --short, --only or --runs')
    options = _options(arguments.set)
    cases = repeated(_chosen(arguments), arguments.runs)
    for case in cases:
        if report_file(arguments.out, case.name).exists():
            read_report(report_file(arguments.out, case.name), options)  # before hours of work
    failures = _run_cases(cases, options, arguments)
    reports = [report_of(arguments.out, case.name, options, failures) for case in cases]
    write_provenance(arguments.out)
    text = page(cases, reports, provenance(arguments.out))
    if arguments.against:
        text += '\n' + against(cases, reports, reports_there(arguments.against, cases))
    write_text(arguments.out / 'scoreboard.md', text)
    print(f'worst tenth, live: {worst_tenth(cases, reports):.3f} m; {arguments.out}/scoreboard.md')
    if failures:
        raise failure_summary(failures)
    if arguments.write_short:
        write_text(_SHORT, shortened(cases, reports))


def _run_cases(
    cases: list[Case], options: Numbers, arguments: argparse.Namespace
) -> dict[str, Failure]:
    logs = arguments.shared / 'data' / 'logs'
    degrade = arguments.shared / 'tools' / 'degrade_log.py'
    tasks = [Task(case, logs, degrade, arguments.out / 'logs', options) for case in cases]
    return run_pending(
        measure,
        tasks,
        lambda task: report_file(arguments.out, task.name),
        arguments,
        arguments.quiet,
    )


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
