"""How much of the error of a thinned log is a matter of stamps, not of poses.

Usage: python -m benchmarks.scoreboard.stamps -o DIR [--shared SHARED].

The Intel log is there with all 13,631 scans, and with 5,438 of them. The same relations judge both.
At most of their stamps the thinned log has no scan. Each version is replayed once, and its live
poses are judged in several ways: DIR/stamps.csv.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, show
from benchmarks.scoreboard.cases import EXACT_S
from benchmarks.scoreboard.measure import play, scans_of
from benchmarks.worlds import SHARED
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import config_with
from thinmap_ros.evaluation.parallel_jobs import write_provenance
from thinmap_ros.evaluation.trajectory_errors import (
    RelationErrors,
    known_relation_errors,
    relation_errors,
)

COMPLETE = 'intel_raw'
THINNED = 'intel'
NAME = 'stamps'
_NEAR_S = 0.1
_SCANS_PER_GRAPH = 10

Path_ = tuple[Array, Array]  # times (N,), s, and poses (N, 3)


def rows(logs: Path) -> Iterator[Row]:
    """Mean errors of both versions, with the nearest scan, with odometry, and where scans are."""
    complete = _live(logs / COMPLETE)
    thinned = _live(logs / THINNED)
    yield from compare(complete, thinned, logs / THINNED)


def compare(complete: Path_, thinned: Path_, folder: Path) -> Iterator[Row]:
    """Rows of two paths of one drive; folder: that of the thinned log, with its relations."""
    reduced = _at_stamps_of(thinned, complete)
    relations = folder / 'relations'
    odometry = folder / 'odom.txt'
    paths = (
        ('complete log', complete),
        ('complete log, only at the scans of the thinned one', reduced),
        ('thinned log', thinned),
    )
    for name, path in paths:
        yield Row(f'{name}: scans', f'{len(path[0])}')
        near = relation_errors(*path, relations, odometry, _NEAR_S)
        yield _row(f'{name}: pose of the scan within {_NEAR_S:g} s', near)
        carried = relation_errors(*path, relations, odometry, EXACT_S)
        yield _row(f'{name}: pose moved to the stamp with odometry', carried)
        both = known_relation_errors(*path, relations, EXACT_S)
        yield _row(f'{name}: relations with a scan at both stamps', both)


def _row(what: str, errors: RelationErrors) -> Row:
    return Row(what, f'{errors.metres.mean():.4f} m, {len(errors.metres)} relations')


def _at_stamps_of(thinned: Path_, complete: Path_) -> Path_:
    """Poses of the complete path at the scans of the thinned one."""
    order = np.argsort(complete[0], kind='stable')
    times = complete[0][order]
    after = np.searchsorted(times, thinned[0]).clip(1, len(times) - 1)
    is_before = thinned[0] - times[after - 1] < times[after] - thinned[0]
    nearest = np.unique(np.where(is_before, after - 1, after))
    return times[nearest], complete[1][order][nearest]


def _live(folder: Path) -> Path_:
    played = play(scans_of(folder, folder.name), config_with({}), _SCANS_PER_GRAPH)
    return np.array(played.stamps_ns) / 1e9, np.array(played.poses)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog='benchmarks.scoreboard.stamps', description=__doc__)
    parser.add_argument('-o', '--out', type=Path, required=True, help=f'folder for {NAME}.csv')
    parser.add_argument('--shared', type=Path, default=SHARED, help='folder of logs and tools')
    arguments = parser.parse_args()
    show(rows(arguments.shared / 'data' / 'logs'), arguments.out / f'{NAME}.csv')
    write_provenance(arguments.out)


if __name__ == '__main__':
    main()
