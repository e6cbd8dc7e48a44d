"""Make docs/results/speed.md from the results of benchmarks.

Usage: python -m benchmarks.speed.page DIR [DOCS]. The chart has the SLAM programs, too, if there is
a folder of the board beside DIR, slam.
"""

import re
from pathlib import Path

from benchmarks.catalogue import BENCHMARKS, Benchmark
from benchmarks.charts import OTHERS, Mark, Panel, page_program, picture, write_page
from benchmarks.rows import markdown, read_rows
from benchmarks.scoreboard.results_page import read_reports
from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.parallel_jobs import provenance
from thinmap_ros.evaluation.slam_run import INTEL, Origin, runs

_CHART = 'speed'
_HEAD = """\
# Speed: computing time and memory

{provenance}

{chart}
{machine}

`python -m benchmarks --csv DIR` runs the benchmarks (`--quick`: short ones), and `python -m
benchmarks.speed.page DIR` generates this page; `python -m benchmarks release` does both. Times are
of one core. With a load average far above the number of cores, times are too long. The page
[SLAM](slam.md) has the time of SLAM per scan beside other programs, and
[Targets](../development/targets.md) the targets of the project.
"""
_IN_PROVENANCE = ('processor', 'cores', 'Python')


def write(folder: Path, docs: Path) -> Path:
    """Write the page of a folder of benchmarks, and its chart. Returns its path."""
    return write_page(docs / 'results' / f'{_CHART}.md', page(folder), [panel(folder)], _KEYS)


def page(folder: Path) -> str:
    """Text of the page. Raises InputError where the folder has no results."""
    if not (folder / 'machine.csv').exists():
        raise InputError(f'{folder}: no machine.csv: expected results of python -m benchmarks')
    machine = ', '.join(
        f'{what} {value}'
        for what, value, _, _ in read_rows(folder / 'machine.csv')
        if what not in _IN_PROVENANCE
    )
    caption = (
        'Time of other programs for the same work, relative to thinmap; left of the line: faster '
        'than thinmap. SLAM by others was run by the team, on another machine.'
    )
    parts = [
        _HEAD.format(
            provenance=provenance(folder),
            chart=picture(_CHART, caption),
            machine=f'Packages and load: {machine}.',
        )
    ]
    for each in _measured(folder):
        rows = [_indented(row)[:2] for row in read_rows(folder / f'{each.name}.csv')]
        parts.append(f'## {each.title}\n\n{each.about} Benchmark: `{each.name}`.\n')
        parts.append(markdown(('quantity', 'value'), rows) + '\n')
    return '\n'.join(parts)


def sections(folder: Path) -> dict[str, list[list[str]]]:
    """Rows of each benchmark of a folder (what, value, target, verdict), by the section's title."""
    return {each.title: read_rows(folder / f'{each.name}.csv') for each in _measured(folder)}


def _measured(folder: Path) -> list[Benchmark]:
    """Benchmarks of the page that a folder has results of."""
    known = (each for each in BENCHMARKS.values() if each.title)
    return [each for each in known if (folder / f'{each.name}.csv').exists()]


_KEYS = (('other programs', OTHERS[Origin.TEAM], True),)
# Name in the chart; file, a row above the value, and the row of a ratio.
_RATIOS = (
    ('thinning by scikit-image', 'thinning', '1000 x 1000 cells', 'times faster than skimage'),
    ('thinning by OpenCV', 'thinning', '1000 x 1000 cells', 'times faster than opencv'),
    (
        'Voronoi graph by SciPy',
        'graphs',
        'kth/50052751',
        'times faster than a Voronoi graph (SciPy)',
    ),
)
_MATCH = 'CPU time of a match, median'


def panel(folder: Path) -> Panel:
    """Times of other programs for the same work, relative to thinmap, as far as measured."""
    marks = []
    for label, name, above, what in _RATIOS:
        value = _value(folder / f'{name}.csv', what, above)
        if value is not None:
            marks.append(Mark(label, value, OTHERS[Origin.TEAM]))
    times = [
        _value(folder / 'matching.csv', f'{program}: {_MATCH}')
        for program in ('thinmap', 'karto-scanmatcher')
    ]
    if times[0] and times[1]:
        marks.append(Mark('scan matching by OpenKarto', times[1] / times[0], OTHERS[Origin.TEAM]))
    marks += _slam(folder.parent / 'slam')
    return Panel('', 'time / time of thinmap', marks, is_log=True, limit=1.0)


def _slam(folder: Path) -> list[Mark]:
    """CPU times of SLAM programs per scan of the Intel log, relative to that of the board's run."""
    if not folder.exists():
        return []
    own = [report for report in read_reports(folder) if report['name'] == INTEL]
    return [
        Mark(f'SLAM by {run.system}', run.cpu_ms / report['ms_mean'], OTHERS[run.origin])
        for report in own
        for run in runs(INTEL)
        if run.cpu_ms is not None
    ]


def _value(path: Path, what: str, above: str = '') -> float | None:
    """First number of a row, of the first that comes after another row; None if there is none."""
    is_after = not above
    for title, value, *_ in read_rows(path):
        is_after = is_after or title == above
        number = re.match(r'[\d.e+-]+', value)
        if is_after and title.strip() == what and number:
            return float(number[0])
    return None


def _indented(row: list[str]) -> list[str]:
    what, *rest = row
    return ['&nbsp;&nbsp;' * (len(what) - len(what.lstrip())) + what.strip(), *rest]


if __name__ == '__main__':
    page_program(write)
