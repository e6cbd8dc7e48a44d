"""What an optimization of the pose graph takes of a scan, by the number of keyframes."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, at_most
from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, inverse
from thinmap_ros.core.slam.graph.keyframes import Keyframe, KeyframeConfig, Keyframes, Step
from thinmap_ros.core.slam.graph.loop_closure import KeyframeGraph
from thinmap_ros.core.slam.graph.pose_graph import NO_SHARE, Edge
from thinmap_ros.core.slam.odometry import OdometryCalibration
from thinmap_ros.core.slam.wall_compass import Heading, Reference

_NUMBERS = (2000, 5000, 15_000)
_NUMBERS_QUICK = (2000,)
_STEP_M = 0.7
_PER_ROW = 57  # keyframes between two turns
_ROWS = 60  # 3 m apart, before the drive begins again at the first one
_SIGMAS = (0.01, 0.01, 0.002)  # of steps and matches
_HEADING_RAD = 0.003
_COVARIANCE = np.diag(np.square([0.05, 0.05, 0.016]))
_EVERY = 7  # keyframes, of which one has a match with an earlier row
_REACH_M = 4.0


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for each number of keyframes."""
    _optimize(_graph(300))  # compiles
    for number in _NUMBERS_QUICK if quick else _NUMBERS:
        graph = _graph(number)
        taken_ms = _optimize(graph)
        yield Row(f'{number} keyframes: scans until the map is corrected', f'{len(taken_ms)}')
        yield at_most('  CPU time of a scan, median (ms)', float(np.median(taken_ms)), 2.0)
        yield at_most('  CPU time of a scan, longest (ms)', max(taken_ms), 30.0)


def _optimize(graph: KeyframeGraph) -> list[float]:
    """CPU time, ms, of the begin of an optimization, and of each scan that it takes."""
    taken_ms = [_cpu_ms(graph.optimize)]
    while graph.is_moving:
        taken_ms.append(_cpu_ms(graph.step))
    return taken_ms


def _cpu_ms(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return 1e3 * (time.process_time() - began)


def _graph(number: int) -> KeyframeGraph:
    """A drive back and forth whose dead reckoning drifts, and matches between its rows."""
    rng = np.random.default_rng(0)
    truth = _drive(number)

    def measured(a: int, b: int) -> Array:
        return np.asarray(se2.between(truth[a], truth[b]) + rng.normal(0.0, _SIGMAS))

    keyframes = Keyframes(KeyframeConfig())
    T = truth[0]
    for k in range(number):
        T = se2.compose(T, measured(k - 1, k)) if k else T
        heading = float(truth[k, 2] + rng.normal(0.0, _HEADING_RAD)) if k % 2 else None
        keyframes.add(_keyframe(k, T, heading), Step(_COVARIANCE))
    graph = KeyframeGraph(keyframes, OdometryCalibration())
    for k in range(_PER_ROW, number, _EVERY):
        away_m = np.hypot(*(truth[: k - _PER_ROW + 1, :2] - truth[k, :2]).T)
        j = int(away_m.argmin())
        if away_m[j] < _REACH_M:
            graph.edges.append(Edge(j, k, measured(j, k), inverse(_COVARIANCE), True))
    return graph


def _drive(number: int) -> Array:
    """True poses (N, 3)."""
    row, col = np.divmod(np.arange(number), _PER_ROW)
    is_forth = row % 2 == 0
    x = _STEP_M * np.where(is_forth, col, _PER_ROW - 1 - col)
    return np.column_stack([x, 3.0 * (row % _ROWS), np.where(is_forth, 0.0, np.pi)])


def _keyframe(k: int, T: Array, heading: float | None) -> Keyframe:
    scan = Scan.create(k, np.ones(3), -0.1, 0.1, 0.1, 8.0)
    reference = Reference(_HEADING_RAD**2, NO_SHARE)
    measured = None if heading is None else Heading(heading, _HEADING_RAD**2, reference)
    return Keyframe(scan, np.zeros((0, 5)), T, _STEP_M * k, _COVARIANCE, 0, measured)
