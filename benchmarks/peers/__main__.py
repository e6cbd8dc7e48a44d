"""IRIS LaMa and thinmap on the same scans: errors and CPU time, per scan and per processed scan.

Usage: python -m benchmarks.peers DRIVER [-o DIR] [--logs LOG ...] [--shared FOLDER]. DIR/peers.csv
has a line for each run, written as soon as it ends; runs that are in the file are not run again.
docs/results/peers.md says how DRIVER is built.

IRIS LaMa skips each scan that is nearer to its last one than both thresholds; its pose there is the
last one moved by the odometry. So its time per scan depends on how many it skips.
"""

import argparse
import subprocess
from collections.abc import Iterator
from functools import lru_cache, partial
from io import StringIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rows import Case, run_pending
from benchmarks.scoreboard.cases import log_case
from benchmarks.scoreboard.measure import scans_of
from benchmarks.scoreboard.played import rehearse
from benchmarks.worlds import SHARED
from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation.parallel_jobs import write_provenance
from thinmap_ros.evaluation.trajectory_errors import relation_errors
from thinmap_ros.pipeline import Pipeline, PipelineConfig

_OUT = Path(__file__).parent  # of the page Peers
_LOGS = ('intel', 'aces_raw')
_MODES = ('slam2d', 'graph', 'pf')
_THRESHOLDS = ('0.5 0.5', '0.2 0.2', '0.05 0.1')  # m and rad
_RANGE_M = 30.0  # of the points that IRIS LaMa is given


def cases(log: str, driver: Path, shared: Path) -> Iterator[Case]:
    """Runs of a log: thinmap, and IRIS LaMa in each mode with each pair of thresholds."""
    own = shared / 'data' / 'logs' / log
    yield Case(f'{log}: thinmap', partial(_thinmap, own))
    for mode, thresholds in product(_MODES, _THRESHOLDS):
        name = f'{log}: IRIS LaMa {mode}, {thresholds.replace(" ", " m, ")} rad'
        yield Case(name, partial(_lama, own, [driver, mode, *thresholds.split()]))


def _thinmap(own: Path) -> dict[str, Any]:
    rehearse()
    pipeline = Pipeline(PipelineConfig(grid=PAPER_GRID))
    times = []
    poses = []
    for scan, T_odom_base in scans_of(own, own.name):
        times.append(scan.stamp_ns / 1e9)
        poses.append(pipeline.step(scan, T_odom_base).estimate.T_map_base)
    stages = pipeline.stage_seconds
    taken_ms = 1e3 * np.add(stages['localizer'], stages['grid'])
    is_processed = np.ones(len(times), dtype=np.bool_)
    return _record(own, np.array(times), np.array(poses), is_processed, taken_ms)


def _lama(own: Path, command: list[str | Path]) -> dict[str, Any]:
    text, odometry = _given(own)
    done = subprocess.run(command, input=text, stdout=subprocess.PIPE, text=True, check=True)
    written = np.loadtxt(StringIO(done.stdout))
    is_processed = written[:, 4] > 0
    poses = carried(written[:, 1:4], odometry, is_processed)
    return _record(own, written[:, 0], poses, is_processed, written[:, 5])


@lru_cache(maxsize=1)
def _given(own: Path) -> tuple[str, Array]:
    """All scans of a log as the driver reads them, and the odometry (N, 3) at them."""
    pairs = list(scans_of(own, own.name))
    return '\n'.join(_line(scan, T) for scan, T in pairs), np.array([T for _, T in pairs])


def _line(scan: Scan, T_odom_base: Array) -> str:
    # With all digits: of points rounded to .1 mm another map may come.
    points = scan.points_laser()
    near = points[np.hypot(*points.T) < _RANGE_M]
    head = [scan.stamp_ns / 1e9, *T_odom_base.tolist(), *scan.T_base_laser]
    words = [f'{value:.9f}' for value in (*head, *near.ravel())]
    return ' '.join([*words[: len(head)], str(len(near)), *words[len(head) :]])


def carried(poses: Array, odometry: Array, is_processed: np.ndarray) -> Array:
    """Poses (N, 3) of the last processed scans, moved by the odometry (N, 3) since."""
    last = np.maximum.accumulate(np.where(is_processed, np.arange(len(poses)), 0))
    moved = [se2.between(odometry[j], T) for j, T in zip(last, odometry, strict=True)]
    return np.array([se2.compose(T, step) for T, step in zip(poses, moved, strict=True)])


def _record(
    own: Path, times: Array, poses: Array, is_processed: np.ndarray, taken_ms: Array
) -> dict[str, Any]:
    exact_s = log_case(own.name).exact_s
    errors = relation_errors(times, poses, own / 'relations', own / 'odom.txt', exact_s)
    count = max(int(is_processed.sum()), 1)
    return {
        'processed': f'{100.0 * is_processed.mean():.0f} %',
        'live_m': f'{errors.metres.mean():.3f}',
        'ms': f'{taken_ms.mean():.2f}',
        'processed_ms': f'{taken_ms.sum() / count:.2f}',
    }


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog='benchmarks.peers', description=__doc__)
    parser.add_argument('driver', type=Path, help='program made of benchmarks/peers/iris_lama.cpp')
    parser.add_argument('-o', '--out', type=Path, default=_OUT, help='folder for peers.csv')
    parser.add_argument('--logs', nargs='+', default=_LOGS, help=f'default: {" ".join(_LOGS)}')
    parser.add_argument('--shared', type=Path, default=SHARED, help='folder of logs and tools')
    arguments = parser.parse_args()
    write_provenance(arguments.out)
    for log in arguments.logs:
        driver = arguments.driver.resolve()
        run_pending(cases(log, driver, arguments.shared), arguments.out / 'peers.csv')


if __name__ == '__main__':
    main()
