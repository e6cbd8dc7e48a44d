"""What a step of the paper's filter costs as the map grows.

The filter over the local area against the filter over all.
"""

import math
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, at_least, at_most
from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig, EkfLocalizer
from thinmap_ros.core.ekf_slam.feature_map import AssociationConfig
from thinmap_ros.core.grid.patch import GridFrame
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


def run(worlds: Path, quick: bool) -> Iterator[Row]:
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
