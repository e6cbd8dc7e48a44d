"""Global localization of many robots.

Usage: python -m benchmarks.kidnapped [ROW ...] -o DIR [--count N] [--worlds DIR] [--log LOG].

Each section of docs/results/localization.md has a CSV file with a line for each robot, written as
soon as its drive ends. Drives that are in the file are not run again.
"""

import argparse
import csv
from itertools import islice
from pathlib import Path

from benchmarks.kidnapped.cases import ROWS, Case, Setting
from benchmarks.kidnapped.summary import Written, summary
from benchmarks.rows import show
from benchmarks.worlds import WORLDS
from thinmap_ros.evaluation.parallel_jobs import write_provenance

_LOG = WORLDS.parent / 'logs' / 'intel' / 'log.clf'


def read(path: Path) -> list[Written]:
    """Records of a file; none where there is no file."""
    if not path.exists():
        return []
    with path.open(encoding='utf-8', newline='') as file:
        return list(csv.DictReader(file))


def run_pending(cases: list[Case], path: Path) -> None:
    """Run the cases that a file does not have yet, and add a line for each."""
    path.parent.mkdir(parents=True, exist_ok=True)
    done = {record['case'] for record in read(path)}
    for case in cases:
        if case.name in done:
            continue
        record = {'case': case.name, **case.run()}
        with path.open('a', encoding='utf-8', newline='') as file:
            writer = csv.DictWriter(file, list(record), lineterminator='\n')
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow(record)


def main() -> None:
    """Run the rows that are named, or all."""
    parser = argparse.ArgumentParser(
        prog='benchmarks.kidnapped', description='Global localization from random starts'
    )
    parser.add_argument('rows', nargs='*', help=f'some of {", ".join(ROWS)} (default: all)')
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
    if unknown := set(arguments.rows) - set(ROWS):
        parser.error(f'unknown row {sorted(unknown)[0]}: expected some of {", ".join(ROWS)}')
    write_provenance(arguments.output)
    setting = Setting(arguments.worlds, arguments.log)
    for row in arguments.rows or ROWS:
        path = arguments.output / f'{row}.csv'
        print(f'-- {row}', flush=True)
        run_pending(list(islice(ROWS[row](setting), arguments.count)), path)
        show(summary(row, read(path)))


if __name__ == '__main__':
    main()
