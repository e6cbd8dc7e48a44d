"""Make docs/results/localization.md from the results of the global localizations.

Usage: python -m benchmarks.kidnapped.page DIR [DOCS_DIR].
"""

import re
from pathlib import Path

from benchmarks.charts import BAD, OURS, Mark, Panel, page_program, picture, write_page
from benchmarks.kidnapped.summary import SECTIONS, by_group, summary
from benchmarks.rows import Row, Written, markdown, read_records
from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.parallel_jobs import provenance

_CHART = 'localization'
_HEAD = """\
# Global localization: correct, false, not localized

{provenance}

{chart}
No other program has been run on these drives, so the chart compares the sections of this page.
[Targets](../development/targets.md) compares them with the targets of the project.

`python -m benchmarks.kidnapped -o DIR` runs the drives (`--count N`: the first N of each section),
`python -m benchmarks.kidnapped.page DIR` generates this page.

- A localization is *correct* with an error of at most 0.3 m and 10 degrees (0.5 m in the log and
  for the kidnapped robot), and *false* with a larger one.
- Unless a section states otherwise, the laser has 181 beams over 180 degrees and a range of 8 m.
  The robot drives to random positions at 0.5 m/s, at most 40 m.
- Worlds: `kth`, floors of a university; `dungeon`, random worlds of 50 x 50 m.
- Times are CPU times, measured next to other load.

[Speed](speed.md) has the times of the parts of a step and the memory of a map.
"""
_GROUP_COLUMNS = (
    'world or laser',
    'drives',
    'correct',
    'false',
    'not localized',
    'distance (m), median',
    'maximum',
)


def write(folder: Path, docs: Path) -> Path:
    """Write the page of a folder of localizations, and its chart. Returns its path."""
    path = docs / 'results' / f'{_CHART}.md'
    return write_page(path, page(folder), [panel(sections(folder))], _KEYS)


def page(folder: Path) -> str:
    """Text of the page: a section for each file."""
    caption = 'Correct and false localizations in the sections of this page.'
    parts = [_HEAD.format(provenance=provenance(folder), chart=picture(_CHART, caption))]
    for name, records in _records(folder).items():
        rows = [(row.what, row.value) for row in summary(name, records)]
        parts += [f'## {SECTIONS[name].title}\n', markdown(('quantity', 'value'), rows), '']
        parts += _groups(records) if SECTIONS[name].is_divided else []
    return '\n'.join(parts)


def sections(folder: Path) -> dict[str, list[Row]]:
    """Summary of each file of a folder, by the title of its section.

    Raises InputError where there is none.
    """
    found = _records(folder).items()
    if not found:
        raise InputError(
            f'{folder}: no results of python -m benchmarks.kidnapped: expected ROW.csv'
        )
    return {SECTIONS[name].title: list(summary(name, records)) for name, records in found}


def _records(folder: Path) -> dict[str, list[Written]]:
    """Records of each section with a file, by name."""
    found = {name: read_records(folder / f'{name}.csv') for name in SECTIONS}
    return {name: records for name, records in found.items() if records}


_KEYS = (('correct', OURS, True), ('false', BAD, True))
_SHARES = {'correct': OURS, 'false': BAD}


def panel(rows: dict[str, list[Row]]) -> Panel:
    """Shares of correct and false localizations, a row for each section that has them."""
    marks = []
    for title, some in rows.items():
        for row in some:
            colour = _SHARES.get(row.what.split()[0])
            if colour and row.what.endswith('localizations (%)'):
                marks.append(Mark(re.split('[,:;]', title)[0], float(row.value), colour))
    return Panel('', 'share of the drives (%)', marks)


def _groups(records: list[Written]) -> list[str]:
    """A table with a line for each world or laser."""
    rows = []
    for name, group in by_group(records).items():
        counts = [
            sum(record['outcome'] == word for record in group)
            for word in ('right', 'wrong', 'open')
        ]
        driven_m = sorted(float(record['way_m']) for record in group)
        middle = f'{driven_m[len(driven_m) // 2]:.1f}'
        rows.append([name, len(group), *counts, middle, f'{driven_m[-1]:.1f}'])
    return [markdown(_GROUP_COLUMNS, rows), '']


if __name__ == '__main__':
    page_program(write)
