"""Compares a trajectory with a reference: absolute and relative pose errors, as evo does."""

import thinmap_ros.startup  # isort: skip  # noqa: F401  before all other modules
import argparse
import json
from dataclasses import asdict
from pathlib import Path

from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.trajectory_errors import (
    MAX_TIME_DIFFERENCE_S,
    Comparison,
    compare_with_relations,
    compare_with_tum,
)
from thinmap_ros.files.safe import write_text
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser, check_place

# Of a folder of replay: live poses, and the same after all corrections.
_TRAJECTORIES = ('trajectory.tum', 'trajectory_final.tum')
_RELATIONS = 'relations'
_EPILOG = """A run is a folder of replay or explore_world, whose trajectory.tum (poses of each scan
when it came) and trajectory_final.tum (after all corrections) are compared, or a file in TUM
format. A reference that ends in .tum is a trajectory; one named relations, or that ends in
.relations, has lines `t1 t2 x y z roll pitch yaw`: the motion between two stamps."""


def _trajectories(run: Path) -> list[Path]:
    if not run.is_dir():
        return [run]
    found = [run / name for name in _TRAJECTORIES if (run / name).exists()]
    if not found:
        raise InputError(f'{run}: no {" and no ".join(_TRAJECTORIES)}: expected one of them')
    return found


def _compared(path: Path, arguments: argparse.Namespace) -> Comparison:
    reference: Path = arguments.reference
    if reference.suffix == '.tum':
        return compare_with_tum(
            path, reference, arguments.align, arguments.t_max_diff, arguments.delta
        )
    if reference.name == _RELATIONS or reference.suffix == f'.{_RELATIONS}':
        return compare_with_relations(path, reference, arguments.t_max_diff)
    raise InputError(f'{reference}: expected a name that ends in .tum or {_RELATIONS}')


def _work(arguments: argparse.Namespace) -> None:
    if not arguments.t_max_diff >= 0.0 or arguments.delta < 1:
        given = f'--t-max-diff {arguments.t_max_diff:g}, --delta {arguments.delta}'
        raise InputError(f'{given}: expected no negative time, and at least 1 pose')
    if arguments.json is not None:
        check_place(arguments.json)
    results = {path: _compared(path, arguments) for path in _trajectories(arguments.run)}
    for path, result in results.items():
        print(f'{path}: {result.poses} compared with {arguments.reference}')
        for name, of in result.errors.items():
            numbers = '  '.join(f'{key} {value:.6f}' for key, value in asdict(of).items())
            print(f'  {name:14} {numbers}')
    if arguments.json is not None:
        content = {path.name: result.as_dict() for path, result in results.items()}
        write_text(arguments.json, json.dumps(content, indent=2) + '\n')


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
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
