"""Compares a trajectory with a reference: absolute and relative pose errors, as evo does."""

import thinmap_ros.startup  # isort: skip  # noqa: F401  before all other modules
import argparse
import json
from pathlib import Path

from thinmap_ros.evaluation.run_errors import evaluate, trajectory_files
from thinmap_ros.evaluation.trajectory_errors import MAX_TIME_DIFFERENCE_S
from thinmap_ros.files.safe import atomic_write, write_text
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser, check_picture, check_place
from thinmap_ros.view.plot_writer import drawn
from thinmap_ros.view.plots import error_plot

_EPILOG = """A run is a folder of replay or explore_world, whose trajectory.tum (poses of each scan
when it came) and trajectory_final.tum (after all corrections) are compared, or a file in TUM
format. A reference that ends in .tum is a trajectory; one named relations, or that ends in
.relations, has lines `t1 t2 x y z roll pitch yaw`: the motion between two stamps."""


def _work(arguments: argparse.Namespace) -> None:
    if arguments.json is not None:
        check_place(arguments.json)
    check_picture(arguments.picture)
    results = evaluate(
        arguments.run,
        arguments.reference,
        align=arguments.align,
        max_difference_s=arguments.t_max_diff,
        delta=arguments.delta,
    )
    for path in trajectory_files(arguments.run):
        result = results[path.name]
        print(f'{path}: {result.poses} compared with {arguments.reference}')
        print(result)
    if arguments.json is not None:
        content = {name: result.as_dict() for name, result in results.items()}
        write_text(arguments.json, json.dumps(content, indent=2) + '\n')
    if arguments.picture is not None:
        plot = error_plot({name: result.curves for name, result in results.items()})
        with atomic_write(arguments.picture) as aside:
            aside.write_bytes(*drawn(plot, ['png']))


def main() -> None:
    """Run the program."""
    parser = Parser('evaluate', __doc__, epilog=_EPILOG)
    parser.add_argument('run', type=Path, help='folder of a run, or FILE.tum')
    parser.add_argument('--reference', type=Path, required=True, help='FILE.tum or relations')
    parser.add_argument(
        '-a',
        '--align',
        action='store_true',
        help='move the trajectory onto the reference first, by least squares of positions; needed '
        'where their frames differ',
    )
    parser.add_argument(
        '--t-max-diff',
        type=float,
        default=MAX_TIME_DIFFERENCE_S,
        help='largest time between a pose and that of the reference, s (default '
        f'{MAX_TIME_DIFFERENCE_S:g})',
    )
    parser.add_argument(
        '--delta', type=int, default=1, help='poses between those of a relative error (default 1)'
    )
    parser.add_argument('--json', type=Path, help='FILE.json for all numbers')
    parser.add_argument('--picture', type=Path, help='FILE.png: errors over time')
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
