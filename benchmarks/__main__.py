"""All benchmarks: python -m benchmarks [NAME ...] [--quick] [--worlds DIR] [--csv DIR]."""

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path

from benchmarks.graphs import compactness, map_to_graph, voronoi
from benchmarks.speed import (
    ekf_step,
    exploration,
    global_localization,
    growth,
    known_map,
    long_paths,
    map_update,
    node_load,
    planning,
    scan_matching,
    thinning,
    topology_update,
)
from benchmarks.worlds import WORLDS
from thinmap_ros.evaluation.machine import machine, write_provenance
from thinmap_ros.evaluation.outcome import Row, show

_ALL: dict[str, Callable[[Path, bool], Iterable[Row]]] = {
    'thinning': thinning.run,
    'mapping': map_update.run,
    'graphs': map_to_graph.run,
    'compactness': compactness.run,
    'voronoi': voronoi.run,
    'online': topology_update.run,
    'nodes': node_load.run,
    'known_map': known_map.run,
    'localization': global_localization.run,
    'matching': scan_matching.run,
    'planning': planning.run,
    'long_paths': long_paths.run,
    'exploration': exploration.run,
    'slam': ekf_step.run,
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
        '--csv',
        type=Path,
        help='folder for the results: NAME.csv each, machine.csv and provenance.txt',
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
        write_provenance(arguments.csv)


if __name__ == '__main__':
    main()
