"""Make docs/results/speed.md of the results of benchmarks.

Usage: python -m benchmarks.speed.page CSV_DIR [DOCS_DIR].
"""

import csv
import sys
from pathlib import Path

_HEAD = """\
# Benchmarks

Made by `python -m benchmarks.speed.page out/benchmarks` of the files that
`python -m benchmarks --csv out/benchmarks` leaves (`--quick` where a table is short). Times are
of one core; a load far above the number of cores says that the machine was busy with other things,
and that all times are much too long.

Another program measures the localizer on real logs, on degraded ones and in generated buildings:
`python -m benchmarks.scoreboard -o DIR` (`--short`: two minutes of its worst
cases) leaves its page in `DIR/scoreboard.md`. A complete run: [slam.md](slam.md).
Where small causes have large effects, as where a loop is found a scan later, one run tells little:
`--runs 8` runs each case eight times, all but the first with odometry disturbed by less than wheels
err by, and tells mean and worst.

`--board` makes one table in `DIR/board.md` (each case: `DIR/cases.md`): what is asked of the
localizer, what was measured, met or missed. Beside logs and buildings it has recorded drives and
the closed loop, also with lasers of 3.5 m and 12 m. A *recorded drive* is the first 20 minutes of
an exploration by the true pose; its scans are replayed with the wheel odometry that a simulation
with another seed would have. It is recorded once, into `DIR/drives` or the folder of
`--recordings`, which several runs may share; delete it when the simulator or the explorer changes.
On the largest floor, `kth/50037764_PLAN1`, the closed loop is cut short after 20 simulated minutes.
`--board --only 'drive_kth*'` runs a part; `--set`, `--against` and `--processes` work as elsewhere.
The graph is updated with each tenth scan of a drive, a building or a dense log, so that errors
differ a little from those of the complete scoreboard.

Machine: {machine}.
"""
# In this order, what each is about.
_ABOUT = {
    'thinning': 'Thinning a real floor, laid side by side to a size, against scikit-image, OpenCV '
    '(padded: the same cells) and simpler work on the same cells.',
    'mapping': 'Scans into the occupancy grid.',
    'graphs': 'Maps of whole floors into graphs, against the Voronoi diagram by SciPy; are they '
    'drivable and complete?',
    'compactness': 'Bytes of a graph and of the grid of the same floor, cells of 0.1 m: median '
    'of the floors (least to most). A node has 17 bytes (id, kind, x, y, clearance), an edge 20 '
    '(id, ids of its nodes, length, clearance), its path 4 and 8 for each cell. The grid has a '
    'byte for each cell of the rectangle of known cells. Compressed: the grid as PNG, the graph by '
    'zlib. Paper 1 claims that a topological map needs much less memory than a grid. That holds '
    'for the uncompressed grid of a message. It does not hold for files: the PNG image of a floor '
    'is about as small as the compressed graph without paths, and much smaller than the one with '
    'paths.',
    'voronoi': 'Thinning against the Voronoi diagram on whole floors, cells of 0.1 m. Both have '
    'the same free space and, along their lines, the same rules of pruning, merging and corner '
    'nodes. Skeleton: from the free space to its lines. Graph: from the map. Times are CPU times, '
    'sums over the floors. Paper 1 claims that thinning needs less computation and makes '
    'additional nodes. The first claim holds. The second does not: with equal rules, the numbers '
    'of nodes differ by some per cent, in both directions.',
    'online': 'Grid and global graph on a drive, scan by scan.',
    'nodes': 'What the ROS nodes of map and graph need for a scan.',
    'localization': 'Global localization from 5,000 samples.',
    'planning': 'The wavefront planner.',
    'long_paths': 'Goals at least 20 m away in a straight line: A* on the graph with the wavefront '
    'in a band around the route, against the wavefront alone.',
    'matching': 'A scan against ten others round its place: the scan matcher of the localizer, and '
    'that of OpenKarto (package karto-scanmatcher, where it is installed), which '
    'renders its map again for each match.',
    'slam': "A step of the paper's filter by the number of features in the map: with those of the "
    'local area in the state (ti), with all of them (full).',
    'growth': 'Localizer, grid and graph together on a long drive through the warehouse of '
    '200 x 200 m.',
}


def page(folder: Path) -> str:
    """Text of the page."""
    machine = ', '.join(f'{what} {value}' for what, value, _, _ in _rows(folder / 'machine.csv'))
    parts = [_HEAD.format(machine=machine)]
    for name, about in _ABOUT.items():
        path = folder / f'{name}.csv'
        if path.exists():
            parts.append(f'## {name}\n\n{about}\n')
            parts.append('| what | value | target | |\n|---|---|---|---|')
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
