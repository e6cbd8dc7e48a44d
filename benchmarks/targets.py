"""Make docs/development/targets.md: targets of the project, measured values, met or missed.

Usage: python -m benchmarks.targets DIR [DOCS]. DIR has the folders slam, speed and localization of
`python -m benchmarks release`; those that are missing are left out.
"""

from pathlib import Path

from benchmarks.charts import page_program
from benchmarks.kidnapped.page import sections as localization_sections
from benchmarks.rows import VERDICTS, markdown
from benchmarks.scoreboard.board import board_table
from benchmarks.scoreboard.results_page import made_lines, read_reports
from benchmarks.speed.page import sections as speed_sections
from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.parallel_jobs import provenance
from thinmap_ros.files.safe import write_text

_HEAD = """\
# Targets

What the project asks of itself, for those who work on it. The pages [SLAM](../results/slam.md),
[Speed](../results/speed.md) and [Global localization](../results/localization.md) describe what is
measured. `python -m benchmarks release` generates this page.

"""
_COLUMNS = ('quantity', 'target', 'measured', '')
_Line = tuple[str, str, str, str]  # quantity, target, measured, verdict as in VERDICTS


def write(folder: Path, docs: Path) -> Path:
    """Write the page of a folder of all results. Returns its path.

    Raises InputError where no result has a target.
    """
    makers = {'slam': _slam, 'speed': _speed, 'localization': _places}
    there = {folder / name: make for name, make in makers.items() if (folder / name).exists()}
    parts = [part for path, make in there.items() for part in make(path)]
    if not parts:
        raise InputError(f'{folder}: no results: expected slam, speed or localization in it')
    path = docs / 'development' / 'targets.md'
    write_text(path, _HEAD + '\n'.join(parts))
    return path


def _slam(folder: Path) -> list[str]:
    reports = read_reports(folder)
    table = board_table(reports, [report['name'] for report in reports])
    return [f'## SLAM\n\n{made_lines(reports)}\n\n{table}']


def _speed(folder: Path) -> list[str]:
    parts = [f'## Speed\n\n{provenance(folder)}\n']
    for title, rows in speed_sections(folder).items():
        lines = [line for line in _with_parents(rows) if line[1]]
        if lines:
            parts.append(f'### {title}\n\n{table_of(lines)}')
    return parts


def _with_parents(rows: list[list[str]]) -> list[_Line]:
    """Lines of rows; an indented one has the row above it, which it belongs to, in its name."""
    lines: list[_Line] = []
    parent = ''
    for what, value, target, verdict in rows:
        is_indented = what.startswith(' ')
        parent = parent if is_indented else what
        name = f'{parent}: {what.strip()}' if is_indented else what
        lines.append((name, target, value, verdict))
    return lines


def _places(folder: Path) -> list[str]:
    parts = [f'## Global localization\n\n{provenance(folder)}\n']
    for title, rows in localization_sections(folder).items():
        lines = [(r.what, r.target, r.value, VERDICTS[r.good]) for r in rows if r.target]
        if lines:
            parts.append(f'### {title}\n\n{table_of(lines)}')
    return parts


def table_of(lines: list[_Line]) -> str:
    """Markdown table of lines, with the words of the board for met and missed."""
    words = {VERDICTS[True]: 'met', VERDICTS[False]: '**missed**'}
    rows = [(what, target, value, words.get(verdict, '')) for what, target, value, verdict in lines]
    return markdown(_COLUMNS, rows) + '\n'


if __name__ == '__main__':
    page_program(write)
