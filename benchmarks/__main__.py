"""All benchmarks: python -m benchmarks [NAME ...] [--quick] [--worlds DIR] [--csv DIR]."""

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path

from benchmarks.speed import ekf_step as slam
from benchmarks.speed import exploration, growth, planning, thinning
from benchmarks.speed import global_localization as localization
from benchmarks.speed import map_to_graph as graphs
from benchmarks.speed import map_update as mapping
from benchmarks.speed import node_load as nodes
from benchmarks.speed import scan_matching as matching
from benchmarks.speed import topology_update as online
from benchmarks.worlds import WORLDS
from thinmap_ros.evaluation.machine import machine
from thinmap_ros.evaluation.outcome import Row, show

_ALL: dict[str, Callable[[Path, bool], Iterable[Row]]] = {
    'thinning': thinning.run,
    'mapping': mapping.run,
    'graphs': graphs.run,
    'online': online.run,
    'nodes': nodes.run,
    'localization': localization.run,
    'matching': matching.run,
    'planning': planning.run,
    'exploration': exploration.run,
    'slam': slam.run,
    'growth': growth.run,
}


def main() -> None:
    """Run the benchmarks that are named, or all."""
    parser = argparse.ArgumentParser(prog='benchmarks', description='Benchmarks of the core')
    parser.add_argument('names', nargs='*', help=f'some of {", ".join(_ALL)} (default: all)')
    parser.add_argument(
        '--quick', action='store_true', help='fewer worlds, pairs and scans: a minute or two'
    )
    parser.add_argument(
        '--worlds', type=Path, default=WORLDS, help=f'folder with worlds.json (default {WORLDS})'
    )
    parser.add_argument(
        '--csv', type=Path, help='folder for the results: NAME.csv each, and machine.csv'
    )
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(_ALL):
        parser.error(f'unknown benchmark {sorted(unknown)[0]}: expected some of {", ".join(_ALL)}')
    for name in arguments.names or _ALL:
        print(f'-- {name}')
        rows = _ALL[name](arguments.worlds, arguments.quick)
        show(rows, arguments.csv and arguments.csv / f'{name}.csv')
    if arguments.csv:
        show(machine(), arguments.csv / 'machine.csv')


if __name__ == '__main__':
    main()
