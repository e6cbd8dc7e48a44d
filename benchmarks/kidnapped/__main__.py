"""Global localization of many robots.

Usage: python -m benchmarks.kidnapped [ROW ...] -o DIR [--count N] [--worlds DIR] [--log LOG].

Each section of docs/results/localization.md has a CSV file with a line for each robot, written as
soon as its drive ends. Drives that are in the file are not run again.
"""

import argparse
from itertools import islice
from pathlib import Path

from benchmarks.kidnapped.cases import ROWS, Setting
from benchmarks.kidnapped.summary import summary
from benchmarks.rows import read_records, run_pending, show
from benchmarks.worlds import WORLDS
from thinmap_ros.evaluation.parallel_jobs import write_provenance

_LOG = WORLDS.parent / 'logs' / 'intel' / 'log.clf'


def main() -> None:
    """Run the rows that are named, or all."""
    parser = argparse.ArgumentParser(
        prog='benchmarks.kidnapped', description='Global localization from random starts'
    )
    parser.add_argument('rows', nargs='*', choices=ROWS, help='default: all')
    parser.add_argument('-o', '--output', type=Path, required=True, help='folder for ROW.csv')
    parser.add_argument(
        '--count', type=int, help='of the cases of each row, the first so many (default: all)'
    )
    parser.add_argument(
        '--worlds', type=Path, default=WORLDS, help=f'folder with worlds.json (default {WORLDS})'
    )
    parser.add_argument(
        '--log',
        type=Path,
        default=_LOG,
        help=f'CARMEN log with laser and odometry (default {_LOG})',
    )
    arguments = parser.parse_args()
    write_provenance(arguments.output)
    setting = Setting(arguments.worlds, arguments.log)
    for row in arguments.rows or ROWS:
        path = arguments.output / f'{row}.csv'
        print(f'-- {row}', flush=True)
        run_pending(list(islice(ROWS[row](setting), arguments.count)), path)
        show(summary(row, read_records(path)))


if __name__ == '__main__':
    main()
