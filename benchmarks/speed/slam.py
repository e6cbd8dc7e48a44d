"""Parts of SLAM: a step of the paper's filter, a match of a scan, a corrected pose graph."""

import importlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rows import Row, at_least, at_most
from benchmarks.speed.mapping import tour
from benchmarks.worlds import floor
from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig, EkfLocalizer
from thinmap_ros.core.ekf_slam.feature_map import AssociationConfig
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, inverse
from thinmap_ros.core.slam.graph.keyframes import Keyframe, KeyframeConfig, Keyframes, Step
from thinmap_ros.core.slam.graph.loop_closure import KeyframeGraph
from thinmap_ros.core.slam.graph.pose_graph import NO_SHARE, Edge
from thinmap_ros.core.slam.matching.local_map import LocalMap
from thinmap_ros.core.slam.matching.scan_matcher import Matcher
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.odometry import OdometryCalibration
from thinmap_ros.core.slam.wall_compass import Heading, Reference
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig
from thinmap_ros.sim.world import World

_CELL_M = 0.05
_WALL_M = 0.1
_WIDTH_M = 10.0
_CORRIDOR_M = 2.0
_ROOM_M = 3.0
_DOOR_M = 1.0
# Steps before a number of features is reached that count for it
_STEP_M = 0.1
_AROUND = 100
_WHEELS = 1.01  # what the odometry makes of a metre
_GAP_M = 0.3  # the walls on both sides of a door are two features, so that there are many


def ekf_step(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows of the cost of a step by the number of features in the map."""
    numbers = [25, 88, 400] if quick else [25, 88, 400, 1000, 3000]
    local = dict(_cost('ekf_ti', numbers))
    for number, (median, longest) in local.items():
        limit = 15.0 if number <= 1000 else 50.0
        yield at_most(f'ti, {number} features: step, median', median, 3.0, 'ms')
        yield at_most(f'ti, {number} features: longest step', longest, limit, 'ms')
    numbers = [number for number in numbers if number in local]
    yield at_most(
        f'ti: {numbers[-1]} features / {numbers[0]} features',
        local[numbers[-1]][0] / local[numbers[0]][0],
        1.5,
    )
    whole = dict(_cost('ekf_full', [number for number in numbers if number <= 1000]))
    for number, (median, _) in whole.items():
        yield Row(f'full, {number} features: step, median', f'{median:.3g} ms')
    most = max(whole)
    ratio = whole[most][0] / local[most][0]
    yield at_least(f'full / ti with {most} features (target: with 1000)', ratio, 30.0, 'x')


def _cost(slam: str, numbers: list[int]) -> Iterator[tuple[int, tuple[float, float]]]:
    """For each number of features.

    Median and longest step of the last ones before the map holds so many, ms.
    """
    length = 1.5 * numbers[-1] + 60.0
    world = _floor(length)
    laser = LaserScanner(LaserScannerConfig(), 0)
    truth = np.array([1.0, 0.5 * _WIDTH_M, 0.0])
    localizer = EkfLocalizer(
        EkfConfig(
            slam=slam,
            association=AssociationConfig(max_gap_m=_GAP_M),
            initial_x_m=truth[0],
            initial_y_m=truth[1],
        )
    )
    odom = np.zeros(3)
    taken = [0.0]
    left = list(numbers)
    number = 0
    while left and truth[0] < length - 2.0:
        scan = laser.scan(world, truth, 200_000_000 * number)
        started = time.process_time()
        features = localizer.step(scan, odom).n_features
        taken.append(1000.0 * (time.process_time() - started))
        if features >= left[0]:
            last = np.array(taken[-_AROUND:])
            yield left.pop(0), (float(np.median(last)), float(last.max()))
        step = np.array([_STEP_M, 0.0, 0.002 * math.cos(0.05 * number)])
        truth = se2.compose(truth, step)
        odom = se2.compose(odom, step * [_WHEELS, 1.0, 1.0])
        number += 1


def _floor(length_m: float) -> World:
    """A corridor with rooms on both sides, each with a door and a cupboard."""
    rng = np.random.default_rng(0)
    cells = np.zeros((round(_WIDTH_M / _CELL_M) + 2, round(length_m / _CELL_M) + 2), dtype=np.uint8)
    sides = (0.5 * (_WIDTH_M - _CORRIDOR_M), 0.5 * (_WIDTH_M + _CORRIDOR_M))
    _fill(cells, (0.0, 0.0, length_m, _WALL_M), (0.0, _WIDTH_M, length_m, _WIDTH_M + _WALL_M))
    _fill(cells, (0.0, 0.0, _WALL_M, _WIDTH_M), (length_m, 0.0, length_m + _WALL_M, _WIDTH_M))
    for a, b in pairwise(np.arange(0.0, length_m + 1e-6, _ROOM_M)):
        for y, low, high in ((sides[0], 0.0, sides[0]), (sides[1], sides[1], _WIDTH_M)):
            door = rng.uniform(a + 0.9, b - 0.9 - _DOOR_M)
            _fill(
                cells,
                (a, y, door, y + _WALL_M),
                (door + _DOOR_M, y, b, y + _WALL_M),
                (b, low, b + _WALL_M, high),
            )
            x = rng.uniform(a + 0.2, b - 1.4)
            depth = rng.uniform(0.4, 0.8)
            _fill(
                cells,
                (x, low, x + 1.2, low + depth) if low == 0.0 else (x, high - depth, x + 1.2, high),
            )
    return World('floor', cells, GridFrame(0.0, 0.0, _CELL_M), np.array([1.0, 0.5 * _WIDTH_M, 0.0]))


def _fill(cells: np.ndarray, *boxes: tuple[float, float, float, float]) -> None:
    """Make boxes (x, y, end_x, end_y), m, solid."""
    for box in boxes:
        x, y, end_x, end_y = (round(float(v) / _CELL_M) for v in box)
        cells[y:end_y, x:end_x] = 1


_QUICK = ('kth/50052751',)
_WORLDS = ('kth/50052751', 'kth/50052748', 'dungeon/d114', 'dungeon/d2555')
# Scans that make the map, poses of a tour between them, and between cases.
_BEFORE = 10
_APART = 5
_EVERY = 12
_RANGE_M = 30.0  # the laser's other mode; both are made for it
# Greatest error of a prior in each direction, m, and in degrees.
_PRIORS = {'near': (0.1, 5.0), 'far': (0.4, 15.0)}
_RIGHT_M = 0.1
_RIGHT_DEG = 2.0


@dataclass(frozen=True, eq=False)
class _Case:
    """A scan made at a pose (3,) that is to be found, and scans with their poses round it."""

    before: list[tuple[Scan, Array]]
    scan: Scan
    T_map_base: Array


# Scan and prior (3,) -> pose; made of the scans before it, and the greatest errors of a prior.
Match = Callable[[Scan, Array], Array]
Maker = Callable[[list[tuple[Scan, Array]], tuple[float, float]], Match]


def matching(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for each matcher, for good and for bad priors."""
    cases = [
        case
        for name in (_QUICK if quick else _WORLDS)
        for case in _cases(worlds, name, 8 if quick else 20)
    ]
    yield Row('scans matched', f'{len(cases)}')
    makers: dict[str, Maker] = {'thinmap': _ours}
    try:
        makers['karto-scanmatcher'] = _karto(importlib.import_module('karto_scanmatcher'))
    except ImportError:
        yield Row('karto-scanmatcher', 'not installed')
    for prior, errors in _PRIORS.items():
        yield Row(
            f'prior error up to {errors[0]:g} m and {errors[1]:g} degrees in each direction', ''
        )
        found = {name: _measure(maker, cases, errors) for name, maker in makers.items()}
        for name, (match_ms, drawn_ms, off) in found.items():
            off_m = np.hypot(off[:, 0], off[:, 1])
            off_deg = np.degrees(np.abs(off[:, 2]))
            right = float(((off_m <= _RIGHT_M) & (off_deg <= _RIGHT_DEG)).mean())
            yield Row(f'  {name}: CPU time of a match, median', f'{np.median(match_ms):.3g} ms')
            yield Row(
                f'  {name}: the same, with the insertion of {_BEFORE} scans',
                f'{np.median(drawn_ms):.3g} ms',
            )
            yield Row(
                f'  {name}: error, median',
                f'{1e3 * np.median(off_m):.3g} mm, {np.median(off_deg):.2g} degrees',
            )
            yield at_least(
                f'  {name}: share within {_RIGHT_M:g} m and {_RIGHT_DEG:g} degrees, {prior}',
                right,
                0.95,
            )


def _cases(worlds: Path, name: str, goals: int) -> Iterator[_Case]:
    """Places along a tour of a floor."""
    there = floor(name, worlds)
    poses = tour(there.world, there.starts[0], 0.25, goals, 0)
    laser = LaserScanner(LaserScannerConfig(range_max_m=_RANGE_M), 0)
    for at in range(_BEFORE * _APART, len(poses), _EVERY):
        around = [poses[at - k * _APART] for k in range(_BEFORE, 0, -1)]
        before = [(laser.scan(there.world, T, 0), T) for T in around]
        yield _Case(before, laser.scan(there.world, poses[at], 0), poses[at])


def _measure(
    maker: Maker, cases: list[_Case], errors: tuple[float, float]
) -> tuple[Array, Array, Array]:
    """CPU time of each match without and with rendering of its map, ms, and errors, (N, 3)."""
    rng = np.random.default_rng(0)
    taken = []
    off = []
    for case in (cases[0], *cases):  # the first one twice: it compiles
        prior = se2.compose(
            case.T_map_base,
            rng.uniform(-1.0, 1.0, 3) * (errors[0], errors[0], np.radians(errors[1])),
        )
        began = time.process_time()
        match = maker(case.before, errors)
        drawn = time.process_time()
        found = match(case.scan, prior)
        taken.append((time.process_time() - drawn, time.process_time() - began))
        off.append(se2.between(case.T_map_base, found))
    match_s, all_s = np.array(taken[1:]).T
    return 1e3 * match_s, 1e3 * all_s, np.array(off[1:])


def _ours(before: list[tuple[Scan, Array]], errors: tuple[float, float]) -> Match:
    """The matcher of this project, told how good the prior is."""
    matcher = Matcher()
    local_map = LocalMap()
    for scan, T in before:
        local_map.add_scan(surface_points(scan), scan.T_base_laser, T)
    sigmas = np.array([errors[0], errors[0], np.radians(errors[1])]) / np.sqrt(3.0)
    covariance = np.diag(np.square(sigmas))
    return lambda scan, prior: (
        matcher.match(surface_points(scan), scan.T_base_laser, local_map, prior, covariance).pose
    )


def _karto(karto: Any) -> Maker:
    """The peer with its own defaults, but for a search wide enough for the prior.

    It draws its map for every match.
    """

    def maker(before: list[tuple[Scan, Array]], errors: tuple[float, float]) -> Match:
        config = karto.ScanMatcherConfig()
        config.search_size = max(config.search_size, 2.0 * errors[0] + 0.1)
        matcher = karto.Wrapper(config)
        laser = _karto_laser(karto, before[0][0])
        known = [_karto_scan(karto, laser, scan, T, k) for k, (scan, T) in enumerate(before)]

        def match(scan: Scan, prior: Array) -> Array:
            found = matcher.match_scan(
                _karto_scan(karto, laser, scan, prior, len(known)), known, True, True
            ).best_pose
            return se2.pose(found.x, found.y, found.yaw)

        return match

    return maker


def _karto_laser(karto: Any, scan: Scan) -> Any:
    last = scan.angle_min_rad + (scan.ranges_m.size - 1) * scan.angle_increment_rad
    limits = (scan.range_min_m, scan.range_max_m, scan.range_max_m)
    return karto.LaserScanConfig(
        scan.angle_min_rad, last, scan.angle_increment_rad, *limits, 'laser'
    )


def _karto_scan(karto: Any, laser: Any, scan: Scan, T_map_base: Array, number: int) -> Any:
    pose = karto.Pose2(*T_map_base.tolist())
    return karto.LocalizedRangeScan(laser, scan.ranges_m.tolist(), pose, pose, number, 0.0)


_NUMBERS = (2000, 5000, 15_000)
_NUMBERS_QUICK = (2000,)
_BETWEEN_M = 0.7
_PER_ROW = 57  # keyframes between two turns
_ROWS = 60  # 3 m apart, before the drive begins again at the first one
_SIGMAS = (0.01, 0.01, 0.002)  # of steps and matches
_HEADING_RAD = 0.003
_COVARIANCE = np.diag(np.square([0.05, 0.05, 0.016]))
_MATCHED_EVERY = 7  # keyframes, of which one has a match with an earlier row
_REACH_M = 4.0


def pose_graph(worlds: Path, quick: bool) -> Iterator[Row]:
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
    for k in range(_PER_ROW, number, _MATCHED_EVERY):
        away_m = np.hypot(*(truth[: k - _PER_ROW + 1, :2] - truth[k, :2]).T)
        j = int(away_m.argmin())
        if away_m[j] < _REACH_M:
            graph.edges.append(Edge(j, k, measured(j, k), inverse(_COVARIANCE), True))
    return graph


def _drive(number: int) -> Array:
    """True poses (N, 3)."""
    row, col = np.divmod(np.arange(number), _PER_ROW)
    is_forth = row % 2 == 0
    x = _BETWEEN_M * np.where(is_forth, col, _PER_ROW - 1 - col)
    return np.column_stack([x, 3.0 * (row % _ROWS), np.where(is_forth, 0.0, np.pi)])


def _keyframe(k: int, T: Array, heading: float | None) -> Keyframe:
    scan = Scan.create(k, np.ones(3), -0.1, 0.1, 0.1, 8.0)
    reference = Reference(_HEADING_RAD**2, NO_SHARE)
    measured = None if heading is None else Heading(heading, _HEADING_RAD**2, reference)
    return Keyframe(scan, np.zeros((0, 5)), T, _BETWEEN_M * k, _COVARIANCE, 0, measured)
