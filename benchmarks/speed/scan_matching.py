"""Scan matching against OpenKarto's scan matcher: same scans round the same place, same priors.

The peer is the package karto-scanmatcher, as it comes; where it is not installed, it is left out.
"""

import importlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.drive import tour
from benchmarks.rows import Row, at_least
from benchmarks.worlds import floors
from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.matching.local_map import LocalMap
from thinmap_ros.core.slam.matching.scan_matcher import Matcher
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig

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


def run(worlds: Path, quick: bool) -> Iterator[Row]:
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
    floor = floors(worlds, name)[0]
    poses = tour(floor.world, floor.starts[0], 0.25, goals, 0)
    laser = LaserScanner(LaserScannerConfig(range_max_m=_RANGE_M), 0)
    for at in range(_BEFORE * _APART, len(poses), _EVERY):
        around = [poses[at - k * _APART] for k in range(_BEFORE, 0, -1)]
        before = [(laser.scan(floor.world, T, 0), T) for T in around]
        yield _Case(before, laser.scan(floor.world, poses[at], 0), poses[at])


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
