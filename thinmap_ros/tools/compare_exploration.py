"""Run strategies x worlds x starts, on all cores or a Dask cluster: one table, plots of coverage.

What is finished is kept: started again with the same folder, only what is missing is run.
"""

import argparse
import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from thinmap_ros.adapters import figures
from thinmap_ros.adapters.files import read_text, write_text
from thinmap_ros.adapters.world_files import read_world
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.world import World
from thinmap_ros.tools import cli
from thinmap_ros.tools.comparison import markdown
from thinmap_ros.tools.explore_world import STRATEGIES, Options, add_options, explore, options_from

Report = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Job:
    """One run: a world, which of its starts that is, and what it is explored with."""

    world: World
    start: Array
    number: int
    options: Options

    @property
    def name(self) -> str:
        """The folder of its result."""
        return f'{self.world.name}/{self.number}/{self.options.strategy}'


def run_job(job: Job) -> Report:
    """Explore, in its own process, here or on another machine, which needs no file of this one."""
    _, report = explore(job.world, job.start, job.options)
    return report | {'start_number': job.number, 'seed': job.options.seed}


def _jobs(arguments: argparse.Namespace) -> list[Job]:
    jobs = []
    for path in arguments.worlds:
        # Worlds of different folders may have the same file name.
        world = replace(
            World.from_patch(*read_world(path)), name=f'{path.resolve().parent.name}-{path.stem}'
        )
        for number, start in enumerate(_starts(path, world, arguments.starts)):
            jobs += [
                Job(world, start, number, options_from(arguments, name))
                for name in arguments.strategies
            ]
    return jobs


def _starts(path: Path, world: World, count: int) -> list[Array]:
    """The first starts of a world: of worlds.json in the folder above its own, else its own one."""
    listing = path.resolve().parent.parent / 'worlds.json'
    key = f'{path.resolve().parent.name}/{path.stem}'
    if listing.exists():
        try:
            starts = json.loads(read_text(listing))[key]['starts'][:count]
            return [se2.pose(*(float(number) for number in start)) for start in starts]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f'{listing}: {key}: expected starts as lists of x, y, theta'
            ) from error
    if not np.isfinite(world.start).all():
        raise InputError(f'{path}: the world names no start, and there is no {listing}')
    return [world.start]


def _on_cores(jobs: list[Job], processes: int) -> Iterator[tuple[Job, Report]]:
    with ProcessPoolExecutor(processes, mp_context=get_context('spawn')) as pool:
        running = {pool.submit(run_job, job): job for job in jobs}
        for future in as_completed(running):
            yield running[future], future.result()


def _on_cluster(jobs: list[Job], address: str) -> Iterator[tuple[Job, Report]]:
    from dask.distributed import Client
    from dask.distributed import as_completed as as_completed_there

    with Client(address) as client:
        running = {client.submit(run_job, job, pure=False): job for job in jobs}
        for future in as_completed_there(list(running)):
            yield running[future], future.result()


def _report_file(out: Path, job: Job) -> Path:
    return out / 'runs' / job.name / 'report.json'


def _report_of(out: Path, job: Job) -> Report:
    path = _report_file(out, job)
    report: Report = json.loads(read_text(path))
    if report.get('options') != asdict(job.options):
        raise InputError(f'{path}: of a run with other options: expected another folder for these')
    return report


def run_missing(jobs: list[Job], out: Path, arguments: argparse.Namespace) -> None:
    """Run what has no result yet; each result is written as soon as it is there."""
    missing = [job for job in jobs if not _report_file(out, job).exists()]
    how: Callable[[list[Job]], Iterator[tuple[Job, Report]]] = (
        (lambda todo: _on_cluster(todo, arguments.scheduler))
        if arguments.scheduler
        else (lambda todo: _on_cores(todo, arguments.processes))
    )
    with tqdm(
        total=len(jobs), initial=len(jobs) - len(missing), unit='run', disable=arguments.quiet
    ) as bar:
        for job, report in how(missing) if missing else ():
            write_text(_report_file(out, job), json.dumps(report) + '\n')
            bar.update()


def _work(arguments: argparse.Namespace) -> None:
    jobs = _jobs(arguments)
    run_missing(jobs, arguments.out, arguments)
    reports = [_report_of(arguments.out, job) for job in jobs]
    table = markdown(reports)
    write_text(arguments.out / 'table.md', table)
    write_text(arguments.out / 'reports.json', json.dumps(reports) + '\n')
    figures.coverage_figure(arguments.out / 'coverage.png', reports)
    print(table)


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(prog='compare_exploration', description=__doc__)
    parser.add_argument('worlds', type=Path, nargs='+', help='world YAMLs or map_server YAMLs')
    parser.add_argument('-o', '--out', type=Path, required=True, help='folder for the results')
    parser.add_argument(
        '--strategies', nargs='+', default=sorted(STRATEGIES), choices=sorted(STRATEGIES)
    )
    parser.add_argument(
        '--starts', type=int, default=3, help='how many of the starts in worlds.json (default 3)'
    )
    parser.add_argument(
        '--processes', type=int, default=os.cpu_count() or 1, help='runs at a time (default: cores)'
    )
    parser.add_argument(
        '--scheduler', default='', help='address of a Dask scheduler, such as tcp://host:8786'
    )
    add_options(parser)
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
