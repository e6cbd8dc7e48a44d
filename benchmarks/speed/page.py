"""Make docs/results/speed.md from the results of benchmarks.

Usage: python -m benchmarks.speed.page CSV_DIR [DOCS_DIR].
"""

import csv
import sys
from pathlib import Path

from thinmap_ros.evaluation.machine import provenance

_HEAD = """\
# Speed

{provenance}

{machine}

`python -m benchmarks --csv out/benchmarks` runs the benchmarks (`--quick`: short ones), and
`python -m benchmarks.speed.page out/benchmarks` generates this page. Times are of one core. With a
load average far above the number of cores, times are too long.

`python -m benchmarks.scoreboard -o DIR` measures the localizer on logs, degraded logs and generated
buildings, and writes `DIR/scoreboard.md`. `--short` runs its worst cases in two minutes. `--runs 8`
runs each case eight times with different odometry noise, and lists means and worst errors. With
`--board` it compares the localizer with its targets and writes `DIR/slam.md`, the page
[SLAM](slam.md). The board includes recorded drives, kept in `DIR/drives` or in the folder of
`--recordings`. Delete them when the simulator or the explorer changes.
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
    'exploration': ('Exploration', 'Complete explorations, and decisions on a large floor.'),
    'slam': (
        'EKF-SLAM',
        'A filter step against the number of features in the map: with the features of the local '
        'area in the state (ti), and with all features (full).',
    ),
    'growth': (
        'Growth with the distance driven',
        'Localizer, grid and graph on a long drive through a warehouse of 200 x 200 m.',
    ),
}
_IN_PROVENANCE = ('processor', 'cores', 'Python')


def page(folder: Path) -> str:
    """Text of the page."""
    machine = ', '.join(
        f'{what} {value}'
        for what, value, _, _ in _rows(folder / 'machine.csv')
        if what not in _IN_PROVENANCE
    )
    parts = [_HEAD.format(provenance=provenance(folder), machine=f'Packages and load: {machine}.')]
    for name, (title, about) in _ABOUT.items():
        path = folder / f'{name}.csv'
        if path.exists():
            parts.append(f'## {title}\n\n{about} Benchmark: `{name}`.\n')
            parts.append('| quantity | value | target | |\n|---|---|---|---|')
            parts += [f'| {" | ".join(_indented(row))} |' for row in _rows(path)]
            parts.append('')
    return '\n'.join(parts)


def _rows(path: Path) -> list[list[str]]:
    with path.open(encoding='utf-8', newline='') as file:
        return list(csv.reader(file))[1:]


def _indented(row: list[str]) -> list[str]:
    what, *rest = row
    return ['&nbsp;&nbsp;' * (len(what) - len(what.lstrip())) + what.strip(), *rest]


if __name__ == '__main__':
    docs = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).resolve().parents[2] / 'docs'
    (docs / 'results' / 'speed.md').write_text(page(Path(sys.argv[1])), encoding='utf-8')
