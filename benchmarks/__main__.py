"""All benchmarks: python -m benchmarks [NAME ...] [--quick] [--worlds DIR] [--csv DIR].

`python -m benchmarks release` makes all pages of results.
"""

import argparse
import sys
from pathlib import Path

from benchmarks import release
from benchmarks.catalogue import BENCHMARKS
from benchmarks.rows import show
from benchmarks.time_and_memory import machine
from benchmarks.worlds import WORLDS
from thinmap_ros.evaluation.parallel_jobs import write_provenance


def main() -> None:
    """Run the benchmarks that are named, or all; `release` has its own command line."""
    if sys.argv[1:2] == ['release']:
        release.main(sys.argv[2:])
        return
    parser = argparse.ArgumentParser(
        prog='benchmarks',
        description='Benchmarks of the core. `benchmarks release --help`: all pages of results',
    )
    parser.add_argument('names', nargs='*', choices=BENCHMARKS, help='default: all')
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
    for name in arguments.names or BENCHMARKS:
        print(f'-- {name}')
        rows = BENCHMARKS[name].rows(arguments.worlds, arguments.quick)
        show(rows, arguments.csv and arguments.csv / f'{name}.csv')
    if arguments.csv:
        show(machine(), arguments.csv / 'machine.csv')
        write_provenance(arguments.csv)


if __name__ == '__main__':
    main()
