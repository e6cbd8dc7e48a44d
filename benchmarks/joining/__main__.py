"""Joint maps of several robots.

Usage: python -m benchmarks.joining [TABLE ...] [--worlds WORLD ...] [--seconds S] [-o DIR].

Tables: two_robots (10 to 60 s of computing for each robot), load, foreign.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.joining import tables
from benchmarks.rows import show_tables
from benchmarks.worlds import WORLDS, Floor, floor
from thinmap_ros.evaluation.outcome import Table
from thinmap_ros.tools import cli

# Three floors and three dungeons; five robots; six buildings.
_SIX = (
    'kth/50052748',
    'kth/50052751',
    'kth/50052749',
    'dungeon/d114',
    'dungeon/d1305',
    'dungeon/d1115',
)
_LARGE = ('kth/50052748',)
_TABLES: dict[str, tuple[Callable[[Sequence[Floor], float], Table], tuple[str, ...], float]] = {
    'two_robots': (tables.two_robots, _SIX, 400.0),
    'load': (tables.load, _LARGE, 600.0),
    'foreign': (tables.foreign, _SIX, 960.0),
}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog='benchmarks.joining', description='Joint maps of several robots'
    )
    parser.add_argument('tables', nargs='*', choices=_TABLES, help='default: all')
    parser.add_argument('--worlds', nargs='+', help='names (default: those of each table)')
    parser.add_argument('--seconds', type=float, help='of each drive (default: of each table)')
    parser.add_argument('--folder', type=Path, default=WORLDS, help='folder with worlds.json')
    parser.add_argument('-o', '--output', type=Path, help='folder for TABLE.csv')
    cli.run(_run, parser)


def _run(arguments: argparse.Namespace) -> None:
    """Print the tables that are named, or all."""

    def made(name: str) -> Table:
        make, worlds, seconds = _TABLES[name]
        chosen = [floor(world, arguments.folder) for world in arguments.worlds or worlds]
        return make(chosen, arguments.seconds or seconds)

    show_tables(map(made, arguments.tables or _TABLES), arguments.output)


if __name__ == '__main__':
    main()
