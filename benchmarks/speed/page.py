"""Make docs/results/speed.md from the results of benchmarks.

Usage: python -m benchmarks.speed.page DIR [DOCS]. The chart has the SLAM programs, too, if there is
a folder of the board beside DIR, slam.
"""

import re
from pathlib import Path

from benchmarks.charts import OTHERS, Mark, Panel, chart_path, draw, page_program, picture
from benchmarks.rows import markdown, read_rows
from benchmarks.scoreboard.results_page import read_reports
from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.parallel_jobs import provenance
from thinmap_ros.evaluation.slam_run import INTEL, Origin, runs
from thinmap_ros.files.safe import write_text

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
# In this order: title, and what is measured.
_ABOUT = {
    'thinning': (
        'Thinning',
        'A real floor, tiled to the given number of cells, against scikit-image, OpenCV (padded, '
        'with the same result) and simpler operations on the same cells.',
    ),
    'mapping': ('Occupancy grid', 'Insertion of scans into the grid.'),
    'graphs': (
        'Topological maps of whole floors',
        'Time against a Voronoi diagram by SciPy; drivable edges and connectivity.',
    ),
    'compactness': (
        'Memory of graph and grid',
        'Bytes of a graph and of the grid of the same floor, cells of 0.1 m: median of the floors '
        '(minimum to maximum). A node has 17 bytes (id, kind, x, y, clearance), an edge 20 '
        '(id, ids of its nodes, length, clearance), its path 4 and 8 for each cell. The grid has a '
        'byte for each cell of the rectangle of known cells. Compressed: the grid as PNG, the '
        'graph by zlib. Paper 1 claims that a topological map needs much less memory than a grid. '
        'This holds for the uncompressed grid of a message. It does not hold for files: the PNG '
        'image of a floor is about as small as the compressed graph without paths, and much '
        'smaller than the one with paths.',
    ),
    'voronoi': (
        'Thinning and Voronoi diagram',
        'Whole floors, cells of 0.1 m. Both methods have the same free space and the same rules '
        'for pruning, merging and corner nodes. Skeleton: from the free space to its lines. Graph: '
        'from the map. Times are CPU times, sums over the floors. Paper 1 claims that thinning '
        'needs less computation and makes additional nodes. The first claim holds. The second does '
        'not: with equal pruning, the numbers of nodes differ by some per cent in both directions.',
    ),
    'online': ('Incremental topological map', 'Grid and global graph on a drive, scan by scan.'),
    'nodes': (
        'ROS nodes',
        'CPU time, memory and latency of the nodes for map, graph and navigation, and the traffic '
        'on their topics.',
    ),
    'localization': ('Global localization', 'Steps with 5,000 samples, and short drives.'),
    'planning': (
        'Wavefront planner',
        'Paths to random goals, and the rejection of unreachable ones.',
    ),
    'long_paths': (
        'Long paths',
        'Goals at a straight-line distance of at least 20 m: A* on the graph with the wavefront in '
        'a band around the route, against the wavefront alone.',
    ),
    'matching': (
        'Scan matching',
        'A scan against ten others from its neighbourhood: the scan matcher of the localizer, and '
        'that of OpenKarto (package karto-scanmatcher, if installed), which renders its map again '
        'for each match.',
    ),
    'slam': (
        'EKF-SLAM',
        'A filter step against the number of features in the map: with the features of the local '
        'area in the state (ti), and with all features (full).',
    ),
    'pose_graph': (
        'Pose graph',
        'What an optimization takes of a scan of a drive back and forth, with matches between.',
    ),
    'growth': (
        'Growth with the distance driven',
        'Localizer, grid and graph on a long drive through a warehouse of 200 x 200 m.',
    ),
}
_IN_PROVENANCE = ('processor', 'cores', 'Python')


def write(folder: Path, docs: Path) -> Path:
    """Write the page of a folder of benchmarks, and its chart. Returns its path."""
    draw(chart_path(docs, _CHART), [panel(folder)], _KEYS)
    path = docs / 'results' / 'speed.md'
    write_text(path, page(folder))
    return path


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
    for name, (title, about) in _ABOUT.items():
        path = folder / f'{name}.csv'
        if path.exists():
            parts.append(f'## {title}\n\n{about} Benchmark: `{name}`.\n')
            rows = [_indented(row)[:2] for row in read_rows(path)]
            parts.append(markdown(('quantity', 'value'), rows))
            parts.append('')
    return '\n'.join(parts)


def sections(folder: Path) -> dict[str, list[list[str]]]:
    """Rows of each benchmark of a folder (what, value, target, verdict), by the section's title."""
    return {
        title: read_rows(folder / f'{name}.csv')
        for name, (title, _) in _ABOUT.items()
        if (folder / f'{name}.csv').exists()
    }


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
