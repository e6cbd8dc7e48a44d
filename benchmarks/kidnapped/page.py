"""Make docs/results/localization.md from the results of the global localizations.

Usage: python -m benchmarks.kidnapped.page DIR [DOCS_DIR].
"""

import sys
from pathlib import Path

from benchmarks.kidnapped.__main__ import read
from benchmarks.kidnapped.summary import Written, by_group, summary
from thinmap_ros.evaluation.machine import provenance
from thinmap_ros.evaluation.outcome import VERDICTS

_HEAD = """\
# Global localization

{provenance}

`python -m benchmarks.kidnapped -o DIR` runs the drives (`--count N`: the first N of each section),
`python -m benchmarks.kidnapped.page DIR` generates this page.

- A localization is *correct* with an error of at most 0.3 m and 10 degrees (0.5 m in the log and
  for the kidnapped robot), and *false* with a larger one.
- Unless a section states otherwise, the laser has 181 beams over 180 degrees and a range of 8 m.
  The robot drives to random positions at 0.5 m/s, at most 40 m.
- Times are CPU times, measured next to other load.

[Speed](speed.md) has the times of the parts of a step and the memory of a map.
"""
# In this order, the title of each.
_ABOUT = {
    'paper': 'Experiment of the topological map paper: laboratory, map of twelve stops, '
    'start at (2 m, 2 m, 270 deg), 20 seeds, 11 steps of up to 0.3 m',
    'lab': 'Laboratory, random starts, 15 steps of up to 0.3 m',
    'voronoi': 'Laboratory, with the nodes of a Voronoi diagram in the map',
    'kth': 'Real floors, random starts',
    'dungeon': 'Dungeons, random starts',
    'twins': 'Equal rooms, and a floor with a symmetry of 180 degrees; at most 30 m',
    'foreign': 'Robot in another building than that of the map; at most 20 m',
    'foreign_log': 'Real robot (Intel log) with maps of other buildings, and robots in these with '
    'the map of the log; at most 20 m',
    'kidnapped': 'Kidnapped robot during exploration with SLAM',
    'halves': 'Halves of a real log (Intel): map of the first half, start in the second half. A '
    'start is in the map if the map contains 70 % of the beams and agrees with 80 % of these',
    'lasers': 'Other lasers',
    'fine': 'Maps with half the cell size, in another frame',
    'driven': 'Maps from a drive of 400 m, with unobserved areas; starts in the free space of the '
    'map',
}
_DIVIDED = ('kth', 'dungeon', 'lasers', 'fine', 'driven')


def page(folder: Path) -> str:
    """Text of the page: a section for each file."""
    parts = [_HEAD.format(provenance=provenance(folder))]
    for row, about in _ABOUT.items():
        records = read(folder / f'{row}.csv')
        if records:
            lines = [
                f'| {r.what} | {r.value} | {r.target} | {VERDICTS[r.good]} |'
                for r in summary(row, records)
            ]
            parts += [
                f'## {about}\n',
                '| quantity | value | target | |\n|---|---|---|---|',
                *lines,
                '',
            ]
            parts += _groups(records) if row in _DIVIDED else []
    return '\n'.join(parts)


def _groups(records: list[Written]) -> list[str]:
    """A table with a line for each world or laser."""
    lines = [
        '| world or laser | drives | correct | false | not localized '
        '| distance (m), median | maximum |',
        f'|{"---|" * 7}',
    ]
    for name, group in by_group(records).items():
        counts = [
            sum(record['outcome'] == word for record in group)
            for word in ('right', 'wrong', 'open')
        ]
        driven_m = sorted(float(record['way_m']) for record in group)
        cells = [
            name,
            len(group),
            *counts,
            f'{driven_m[len(driven_m) // 2]:.1f}',
            f'{driven_m[-1]:.1f}',
        ]
        lines.append(f'| {" | ".join(str(cell) for cell in cells)} |')
    return [*lines, '']


if __name__ == '__main__':
    docs = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).resolve().parents[2] / 'docs'
    (docs / 'results' / 'localization.md').write_text(page(Path(sys.argv[1])), encoding='utf-8')
