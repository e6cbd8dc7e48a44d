"""Runs the papers' experiments: figures, tables, comparison with the papers, and a page."""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path

from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.outcome import Outcome
from thinmap_ros.evaluation.pages import write_markdown, write_page
from thinmap_ros.evaluation.parallel_jobs import write_provenance
from thinmap_ros.experiments.drives import Source
from thinmap_ros.experiments.exploration import (
    end_nodes,
    exploration,
    node_kinds,
    strategies,
    thinning_stages,
)
from thinmap_ros.experiments.slam import building_floor, feature_count, logs, long_floor, office
from thinmap_ros.experiments.topological_map import (
    global_localization,
    global_map,
    thinning_voronoi,
    wavefront_path,
)
from thinmap_ros.files.safe import write_text
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser, add_out, out_folder
from thinmap_ros.view.plot_writer import write_plot

# In the order of the papers; the longest are started first.
EXPERIMENTS: dict[str, Callable[[Source], Outcome]] = {
    'thinning_voronoi': thinning_voronoi.run,
    'global_map': global_map.run,
    'convergence': global_localization.run,
    'wavefront_path': wavefront_path.run,
    'thinning_stages': thinning_stages.run,
    'node_kinds': node_kinds.run,
    'end_nodes': end_nodes.run,
    'exploration': exploration.run,
    'strategies': strategies.run,
    'office': office.run,
    'building_floor': building_floor.run,
    'feature_count': feature_count.run,
    'long_floor': long_floor.run,
}
# These need logs, or results: not part of `all`
LOGS = 'logs'
PAGE = 'page'
_LONGEST = ('strategies', 'feature_count', 'long_floor', 'convergence')


def run_one(name: str, source: Source, out: Path) -> float:
    """Run an experiment and write its results to the folder out/NAME.

    Returns its duration, s.
    """
    began = time.perf_counter()
    write_outcome(EXPERIMENTS[name](source), out / name)
    return time.perf_counter() - began


def write_outcome(outcome: Outcome, folder: Path) -> None:
    """Write tables (CSV), figures (PNG, SVG) and their descriptions for the page."""
    for table in outcome.tables:
        write_text(folder / f'{table.name}.csv', table.csv())
    for plot in outcome.plots:
        write_plot(folder, plot)
    about = {
        'title': outcome.title,
        'source': outcome.source,
        'how': outcome.how,
        'tables': [
            {'name': table.name, 'timed': table.timed, 'rows': len(table.rows)}
            for table in outcome.tables
        ],
        'plots': [{'name': plot.name, 'caption': plot.caption} for plot in outcome.plots],
        'comparisons': [asdict(comparison) for comparison in outcome.comparisons],
    }
    write_text(folder / 'about.json', json.dumps(about, indent=2) + '\n')


def _run_all(
    names: list[str], source: Source, out: Path, processes: int
) -> Iterator[tuple[str, float]]:
    if len(names) == 1 or processes == 1:
        yield from ((name, run_one(name, source, out)) for name in names)
        return
    order = sorted(names, key=lambda name: name not in _LONGEST)
    with ProcessPoolExecutor(processes, mp_context=get_context('spawn')) as pool:
        running = {pool.submit(run_one, name, source, out): name for name in order}
        for future in as_completed(running):
            yield running[future], future.result()


def _work(arguments: argparse.Namespace) -> None:
    arguments.out = out_folder(arguments.out, 'experiments')
    if arguments.name not in (LOGS, PAGE):
        _work_experiments(arguments)
    elif arguments.name == LOGS:
        _work_logs(arguments)
    done = [name for name in (*EXPERIMENTS, LOGS) if (arguments.out / name / 'about.json').exists()]
    if not done:
        raise InputError(f'{arguments.out}: no results of experiments in it')
    print(write_page(arguments.out, done))
    if arguments.docs is not None:
        print(write_markdown(arguments.out, done, arguments.docs))


def _work_experiments(arguments: argparse.Namespace) -> None:
    names = list(EXPERIMENTS) if arguments.name == 'all' else [arguments.name]
    if arguments.from_bag is not None and not arguments.from_bag.is_dir():
        raise InputError(
            f'{arguments.from_bag}: no such folder: '
            'expected the bags that scripts/record_bags makes'
        )
    source = Source(arguments.seed, arguments.from_bag, arguments.quick)
    write_provenance(arguments.out)
    for name, seconds in _run_all(names, source, arguments.out, arguments.jobs):
        print(f'{name}: {seconds:.0f} s', flush=True)


def _work_logs(arguments: argparse.Namespace) -> None:
    if arguments.logs is None:
        raise InputError('logs: expected --logs FOLDER, with a folder NAME/log.clf for each log')
    write_outcome(logs.run(arguments.logs, arguments.out / LOGS), arguments.out / LOGS)


def main() -> None:
    """Run the program."""
    parser = Parser('experiment', __doc__)
    parser.add_argument(
        'name', choices=[*EXPERIMENTS, 'all', LOGS, PAGE], help='which one; page: none'
    )
    add_out(parser, 'out/experiments')
    parser.add_argument('--seed', type=int, default=0, help='decides all noise (default 0)')
    parser.add_argument(
        '--from-bag',
        type=Path,
        help='folder of bags: drives come from there, not from the simulator',
    )
    parser.add_argument(
        '--logs', type=Path, help='logs: a folder that has a folder NAME/log.clf for each of them'
    )
    parser.add_argument(
        '--docs',
        type=Path,
        help='folder in which results/papers.md is made of all results in --out',
    )
    parser.add_argument(
        '--quick', action='store_true', help='fewer runs and shorter drives, to see that all works'
    )
    parser.add_argument(
        '--jobs', type=int, default=os.cpu_count() or 1, help='at a time (default: cores)'
    )
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
