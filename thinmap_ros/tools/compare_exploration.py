"""Run strategies x worlds x starts, on all cores or a Dask cluster: one table, plots of coverage.

Results are kept: with the same folder, only missing runs are started.
"""

import argparse
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation.exploration_run import explore
from thinmap_ros.evaluation.parallel_jobs import (
    Report,
    add_run_options,
    failure_summary,
    read_report,
    run_pending,
    write_provenance,
)
from thinmap_ros.evaluation.strategy_comparison import markdown
from thinmap_ros.files import package_data
from thinmap_ros.files.safe import read_text, write_text
from thinmap_ros.files.worlds import read_starts, read_world
from thinmap_ros.sim.world import World
from thinmap_ros.strategies import NAMES, check_strategy
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser, add_out, out_folder
from thinmap_ros.tools.explore_world import WORLD_HELP, add_options, options_from
from thinmap_ros.view import figures


@dataclass(frozen=True, eq=False)
class Job:
    """One run: world, number of the start, and options of the exploration."""

    world: World
    start: Array
    number: int
    options: Options

    @property
    def name(self) -> str:
        """Folder of the result."""
        return f'{self.world.name}/{self.number}/{self.options.strategy}'


def run_job(job: Job) -> Report:
    """Explore in a separate process, here or on another machine, without files of this one."""
    _, report = explore(job.world, job.start, job.options)
    return report | {'start_number': job.number, 'seed': job.options.seed}


def _jobs(arguments: argparse.Namespace) -> list[Job]:
    jobs = []
    for path in map(package_data.world_path, arguments.worlds):
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
    """First starts of a world, of worlds.json in the parent folder, or else of the world file.

    That one may have several, or one.
    """
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
    starts = read_starts(path)[:count]
    if len(starts):
        return list(starts)
    if not np.isfinite(world.start).all():
        raise InputError(f'{path}: the world has no start, and there is no {listing}')
    return [world.start]


def _report_file(out: Path, job: Job) -> Path:
    return out / 'runs' / job.name / 'report.json'


def _work(arguments: argparse.Namespace) -> None:
    for name in arguments.strategies:
        check_strategy(name)
    arguments.out = out_folder(arguments.out, 'comparison')
    jobs = _jobs(arguments)
    failures = run_pending(
        run_job, jobs, lambda job: _report_file(arguments.out, job), arguments, arguments.quiet
    )
    if failures:
        raise failure_summary(failures)
    reports = [read_report(_report_file(arguments.out, job), asdict(job.options)) for job in jobs]
    table = markdown(reports)
    write_provenance(arguments.out)
    write_text(arguments.out / 'table.md', table)
    write_text(arguments.out / 'reports.json', json.dumps(reports) + '\n')
    figures.coverage_figure(arguments.out / 'coverage.png', reports)
    print(table)


def main() -> None:
    """Run the program."""
    parser = Parser('compare_exploration', __doc__)
    parser.add_argument('worlds', nargs='+', help=WORLD_HELP)
    add_out(parser, 'out/comparison')
    parser.add_argument(
        '--strategies',
        nargs='+',
        default=sorted(NAMES),
        metavar='NAME',
        help=f'some of {", ".join(NAMES)}, or your own as package.module:factory (default: all)',
    )
    parser.add_argument(
        '--starts',
        type=int,
        default=3,
        help='how many starts of a world, of worlds.json or else of the world file (default 3)',
    )
    add_run_options(parser)
    add_options(parser)
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
