"""Run the scoreboard: python -m benchmarks.scoreboard -o DIR [--short].

What is finished is kept: started again with the same folder and options, only what is missing is
run.
"""

import argparse
import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from fnmatch import fnmatch
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.scoreboard.cases import Case, all_cases
from benchmarks.scoreboard.measure import Numbers, measure
from benchmarks.scoreboard.page import page, worst_tenth
from thinmap_ros.adapters.files import read_text, write_text
from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.core.slam.localizer import LocalizerConfig
from thinmap_ros.tools import cli

_SHARED = Path(__file__).resolve().parents[3] / 'shared'
_SHORT = Path(__file__).parent / 'short.txt'
Work = tuple[Case, Path, Path, Path, Numbers]


def main() -> None:
    """Run the command line."""
    cli.run(_run, _parser())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='benchmarks.scoreboard', description=__doc__)
    parser.add_argument('-o', '--out', type=Path, required=True, help='folder for all results')
    parser.add_argument('--shared', type=Path, default=_SHARED, help='folder of logs and tools')
    parser.add_argument('--short', action='store_true', help='only the hard cases of short.txt')
    parser.add_argument('--only', default='*', help='cases whose names match, such as "intel*"')
    parser.add_argument(
        '--set', action='append', default=[], metavar='NAME=VALUE', help='option of the localizer'
    )
    parser.add_argument('--processes', type=int, default=os.cpu_count(), help='at the same time')
    parser.add_argument(
        '--scheduler', default='', help='address of a Dask scheduler, such as tcp://host:8786'
    )
    return parser


def _run(arguments: argparse.Namespace) -> None:
    options = _options(arguments.set)
    cases = _chosen(arguments)
    results = arguments.out / 'results'
    missing = [case for case in cases if not (results / f'{case.name}.json').exists()]
    for case in set(cases) - set(missing):
        _checked(results / f'{case.name}.json', options)
    logs = arguments.shared / 'data' / 'logs'
    degrade = arguments.shared / 'tools' / 'degrade_log.py'
    work = [(case, logs, degrade, arguments.out / 'logs', options) for case in missing]
    how = _on_cluster if arguments.scheduler else _on_cores
    with tqdm(total=len(cases), initial=len(cases) - len(missing), unit='case') as bar:
        for case, numbers in how(work, arguments) if work else ():
            report = {'name': case.name, 'options': options, **numbers}
            write_text(results / f'{case.name}.json', json.dumps(report) + '\n')
            bar.update()
    reports = [_checked(results / f'{case.name}.json', options) for case in cases]
    write_text(arguments.out / 'scoreboard.md', page(cases, reports))
    print(f'worst tenth, live: {worst_tenth(cases, reports):.3f} m; {arguments.out}/scoreboard.md')


def _chosen(arguments: argparse.Namespace) -> list[Case]:
    cases = all_cases(arguments.shared / 'data' / 'logs')
    if arguments.short:
        names = set(read_text(_SHORT).split())
        cases = [case for case in cases if case.name in names]
    cases = [case for case in cases if fnmatch(case.name, arguments.only)]
    if not cases:
        raise InputError(f'--only {arguments.only}: no case has such a name')
    return cases


def _options(words: list[str]) -> Numbers:
    """Options of the localizer, each of the type of its default."""
    defaults = vars(LocalizerConfig())
    options: dict[str, Any] = {}
    for word in words:
        name, _, value = word.partition('=')
        if name not in defaults:
            raise ConfigError(f'--set {word}: expected one of {", ".join(sorted(defaults))}')
        kind = type(defaults[name])
        try:
            options[name] = value == 'true' if kind is bool else kind(value)
        except ValueError:
            raise ConfigError(f'--set {word}: expected a value like {defaults[name]}') from None
    LocalizerConfig(**options)
    return options


def _checked(path: Path, options: Numbers) -> Numbers:
    report: Numbers = json.loads(read_text(path))
    if report.get('options') != options:
        raise InputError(f'{path}: of a run with other options: expected another folder for these')
    return report


def _on_cores(work: list[Work], arguments: argparse.Namespace) -> Iterator[tuple[Case, Numbers]]:
    # A process for each case: the memory that it took at the most is then its own.
    context = get_context('spawn')
    with ProcessPoolExecutor(arguments.processes, context, max_tasks_per_child=1) as pool:
        running = {pool.submit(measure, *each): each[0] for each in work}
        for future in as_completed(running):
            yield running[future], future.result()


def _on_cluster(work: list[Work], arguments: argparse.Namespace) -> Iterator[tuple[Case, Numbers]]:
    from dask.distributed import Client
    from dask.distributed import as_completed as as_completed_there

    submit: Callable[..., Any]
    with Client(arguments.scheduler) as client:
        submit = client.submit
        running = {submit(measure, *each, pure=False): each[0] for each in work}
        for future in as_completed_there(list(running)):
            yield running[future], future.result()


if __name__ == '__main__':
    main()
