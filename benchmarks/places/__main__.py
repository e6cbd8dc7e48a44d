"""Place recognition between pieces of map, and joining them.

Usage: python -m benchmarks.places [TABLE ...] --pieces DIR [--count N] [--data DIR] [-o DIR].

Pieces are halves of real logs and simulated explorations, each from an origin of its own. They are
made once, in the folder of --pieces: 10 to 60 s each.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

from benchmarks.places import tables
from benchmarks.places.generators import generators
from benchmarks.places.pieces import RecordedPiece, recorded
from benchmarks.rows import show_tables
from benchmarks.worlds import WORLDS
from thinmap_ros.evaluation.outcome import Table

_TABLES: dict[str, Callable[[list[RecordedPiece]], Table]] = {
    'shared': tables.shared,
    'foreign': tables.foreign,
    'bare': tables.bare,
    'joined': tables.joined,
    'generators': generators,
}


def main() -> None:
    """Print the tables that are named, or all."""
    parser = argparse.ArgumentParser(
        prog='benchmarks.places', description='Place recognition between pieces of map'
    )
    parser.add_argument('tables', nargs='*', choices=_TABLES, help='default: all')
    parser.add_argument('--pieces', type=Path, required=True, help='folder of the pieces')
    parser.add_argument(
        '--count', type=int, help='of the logs and of the explorations the first so many'
    )
    data = WORLDS.parent
    parser.add_argument(
        '--data', type=Path, default=data, help=f'folder with logs and worlds (default {data})'
    )
    parser.add_argument('-o', '--output', type=Path, help='folder for TABLE.csv')
    arguments = parser.parse_args()
    pieces = recorded(arguments.pieces, arguments.data, arguments.count)
    made = (_TABLES[name](pieces) for name in arguments.tables or _TABLES)
    show_tables(made, arguments.output)


if __name__ == '__main__':
    main()
