"""Make docs/results/localization.md of what the lost robots left.

Usage: python -m benchmarks.kidnapped.page DIR [DOCS_DIR].
"""

import sys
from pathlib import Path

from benchmarks.kidnapped.__main__ import read
from benchmarks.kidnapped.summary import Written, by_group, summary
from thinmap_ros.evaluation.outcome import VERDICTS

_HEAD = """\
# Global localization, measured

Made by `python -m benchmarks.kidnapped.page DIR` of the files that
`python -m benchmarks.kidnapped -o DIR` left; with `--count` the first so many of each row. A robot
is right that is sure within 0.3 m (0.5 m in the log, and when kidnapped) and 10 degrees of where
it is; unless told otherwise it has a laser of 181 beams over 180 degrees that reaches 8 m, drives
at 0.5 m/s to random places, and has 40 m of way. Times are of the processor, on a machine that did
other things as well. Times of a step's parts and what a map takes in memory are in
[benchmarks](speed.md).
"""
# In this order, what each is about.
_ABOUT = {
    'paper': 'The experiment of the topological map paper: laboratory, map of twelve stops, '
    'start at (2 m, 2 m, 270 deg), 20 seeds, 11 steps of up to 0.3 m',
    'lab': 'The laboratory, random starts, 15 steps of up to 0.3 m',
    'voronoi': 'The same with the nodes of a Voronoi diagram in the map',
    'kth': 'Real floors, random starts',
    'dungeon': 'Dungeons, random starts',
    'twins': 'Twin rooms, and a floor that looks the same when turned by 180 degrees; 30 m of way',
    'foreign': 'Robots in other buildings than that of the map; 20 m of way',
    'foreign_log': 'A real robot (Intel) in the maps of other buildings, and robots of these in '
    'its map; 20 m of way',
    'kidnapped': 'Kidnapped while exploring with SLAM',
    'halves': 'A real log (Intel) in halves: map of the first, robot switched on in the second. '
    'In the map is a place of which the map shows 70 of 100 beams, and agrees with 80 of 100 of '
    'these',
    'lasers': 'Other lasers',
    'fine': 'Maps with cells of half the size, in another frame',
    'driven': 'Maps made by a robot on a drive of 400 m, with all that it did not see; starts '
    'where the map is free',
}
_DIVIDED = ('kth', 'dungeon', 'lasers', 'fine', 'driven')


def page(folder: Path) -> str:
    """Text of the page: a section for each file."""
    parts = [_HEAD]
    for row, about in _ABOUT.items():
        records = read(folder / f'{row}.csv')
        if records:
            lines = [
                f'| {r.what} | {r.value} | {r.target} | {VERDICTS[r.good]} |'
                for r in summary(row, records)
            ]
            parts += [f'## {about}\n', '| what | value | target | |\n|---|---|---|---|', *lines, '']
            parts += _groups(records) if row in _DIVIDED else []
    return '\n'.join(parts)


def _groups(records: list[Written]) -> list[str]:
    """A table with a line for each world or laser."""
    lines = [
        '| where | drives | right | wrong | not sure | way, m: median | longest |',
        f'|{"---|" * 7}',
    ]
    for name, group in by_group(records).items():
        counts = [
            sum(record['outcome'] == word for record in group)
            for word in ('right', 'wrong', 'open')
        ]
        ways = sorted(float(record['way_m']) for record in group)
        cells = [name, len(group), *counts, f'{ways[len(ways) // 2]:.1f}', f'{ways[-1]:.1f}']
        lines.append(f'| {" | ".join(str(cell) for cell in cells)} |')
    return [*lines, '']


if __name__ == '__main__':
    docs = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).resolve().parents[2] / 'docs'
    (docs / 'results' / 'localization.md').write_text(page(Path(sys.argv[1])), encoding='utf-8')
