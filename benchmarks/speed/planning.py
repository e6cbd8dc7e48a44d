"""The wavefront planner on random goals: all that can be reached is, on short ways.

The rest is refused, and soon.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.rows import Row, at_least, at_most
from benchmarks.worlds import Floor, floors
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.wavefront import WavefrontConfig, navigation_function, plan
from thinmap_ros.core.se2 import Array
from thinmap_ros.files.occupancy_maps import read_map

_GOALS = 1000
_GOALS_QUICK = 60
_HAIR = 1e-6


@dataclass
class _Tally:
    """What came of the goals.

    Length of each path over the best one's, and how long each answer took, s.
    """

    reachable: int = 0
    reached: int = 0
    unreachable: int = 0
    refused: int = 0
    too_near: int = 0

    def __post_init__(self) -> None:
        self.ratios: list[float] = []
        self.plan_s: list[float] = []
        self.refuse_s: list[float] = [0.0]


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows over all worlds."""
    rng = np.random.default_rng(0)
    tally = _Tally()
    chosen = floors(worlds, 'kth/50052751' if quick else '')
    for floor in chosen:
        for _ in range(-(-(_GOALS_QUICK if quick else _GOALS) // len(chosen))):
            _try(floor, read_map(floor.path), rng, tally)
    yield Row('goals', f'{tally.reachable + tally.unreachable}')
    yield at_least(
        '  reachable goals with a path, share', tally.reached / max(tally.reachable, 1), 1.0
    )
    yield at_most('  paths with too little clearance', tally.too_near, 0)
    yield at_most(
        '  length / shortest with the same clearance, mean',
        float(np.mean(tally.ratios)),
        1.05,
    )
    yield at_most('  the same, maximum', float(np.max(tally.ratios)), 1.05)
    yield at_least(
        '  unreachable goals rejected, share', tally.refused / max(tally.unreachable, 1), 1.0
    )
    yield at_most('  longest time of a rejection', max(tally.refuse_s), 1.0, 's')
    yield Row('  time of a plan, median', f'{1e3 * np.median(tally.plan_s):.3g} ms')


def _try(floor: Floor, patch: GridPatch, rng: np.random.Generator, tally: _Tally) -> None:
    """Plan from one of the starts of a floor to a point anywhere on its map."""
    config = WavefrontConfig()
    resolution = patch.frame.resolution
    start = floor.starts[rng.integers(len(floor.starts))]
    cell = np.array([rng.integers(size) for size in patch.shape])
    goal = patch.frame.centres_of(cell[None])[0]
    clearance_m = ndimage.distance_transform_edt(np.pad(patch.free, 1))[1:-1, 1:-1] * resolution
    parts, _ = ndimage.label(clearance_m >= config.robot_radius_m - _HAIR, np.ones((3, 3)))
    at = tuple(patch.frame.cells_of(start[None, :2])[0])
    expected = parts[at] > 0 and parts[tuple(cell)] == parts[at]
    # Beside what can be reached, a goal moves a little: neither answer is wrong there.
    low = np.maximum(cell - math.ceil(config.goal_search_radius_m / resolution), 0)
    slack = config.goal_search_radius_m / resolution
    near = parts[low[0] : cell[0] + math.ceil(slack) + 1, low[1] : cell[1] + math.ceil(slack) + 1]
    if parts[at] == 0 or (not expected and (near == parts[at]).any()):
        return
    began = time.perf_counter()
    path = plan(patch, (float(start[0]), float(start[1])), (float(goal[0]), float(goal[1])), config)
    seconds = time.perf_counter() - began
    if expected:
        tally.reachable = tally.reachable + 1
        tally.reached = tally.reached + (path is not None)
        tally.plan_s.append(seconds)
        if path is not None:
            _judge(path, patch, clearance_m, tally, config.robot_radius_m)
    else:
        tally.unreachable = tally.unreachable + 1
        tally.refused = tally.refused + (path is None)
        tally.refuse_s.append(seconds)


def _judge(
    path: Array, patch: GridPatch, clearance_m: NDArray[np.float64], tally: _Tally, radius_m: float
) -> None:
    cells = patch.frame.cells_of(path)
    least_m = float(clearance_m[cells[:, 0], cells[:, 1]].min())
    tally.too_near += least_m < radius_m - _HAIR
    length_m = float(np.hypot(*np.diff(path, axis=0).T).sum())
    cost = np.where(clearance_m >= least_m - _HAIR, 1.0, np.inf)
    start, goal = (tuple(int(v) for v in cells[k]) for k in (0, -1))
    best_m = float(navigation_function(cost, (goal[0], goal[1]))[start]) * patch.frame.resolution
    if best_m > 1.0:
        tally.ratios.append(length_m / best_m)
