"""The wavefront planner on random goals: all that can be reached is, on short ways.

The rest is refused, and soon.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.buildings import BuildingConfig, generate_building
from benchmarks.rows import Row, at_least, at_most
from benchmarks.worlds import Floor, floor, floors
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.paths import LONG_PATH_M, route_band
from thinmap_ros.core.planning.wavefront import (
    WavefrontConfig,
    cost_of_cells,
    find_path,
    navigation_function,
    plan,
)
from thinmap_ros.core.se2 import Array, path_length_m
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.experiments.drives import patch_of_world
from thinmap_ros.files.occupancy_maps import read_map

_GOALS = 1000
_GOALS_QUICK = 60
_HAIR = 1e-6


@dataclass
class _GoalTally:
    """What came of the goals.

    Length of each path over the best one's, and how long each answer took, s.
    """

    reachable: int = 0
    reached: int = 0
    unreachable: int = 0
    refused: int = 0
    too_near: int = 0

    ratios: list[float] = field(default_factory=list)
    plan_s: list[float] = field(default_factory=list)
    refuse_s: list[float] = field(default_factory=lambda: [0.0])


def goals(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows over all worlds."""
    rng = np.random.default_rng(0)
    tally = _GoalTally()
    chosen = floors(worlds, 'kth/50052751' if quick else '')
    for each in chosen:
        for _ in range(-(-(_GOALS_QUICK if quick else _GOALS) // len(chosen))):
            _try_goal(each, read_map(each.path), rng, tally)
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


def _try_goal(floor: Floor, patch: GridPatch, rng: np.random.Generator, tally: _GoalTally) -> None:
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
    path: Array,
    patch: GridPatch,
    clearance_m: NDArray[np.float64],
    tally: _GoalTally,
    radius_m: float,
) -> None:
    cells = patch.frame.cells_of(path)
    least_m = float(clearance_m[cells[:, 0], cells[:, 1]].min())
    tally.too_near += least_m < radius_m - _HAIR
    cost = np.where(clearance_m >= least_m - _HAIR, 1.0, np.inf)
    start, goal = (tuple(int(v) for v in cells[k]) for k in (0, -1))
    best_m = float(navigation_function(cost, (goal[0], goal[1]))[start]) * patch.frame.resolution
    if best_m > 1.0:
        tally.ratios.append(path_length_m(path) / best_m)


_FLOORS = ('kth/50052748', 'kth/50037764_PLAN1', 'dungeon/d114')
_BUILDING = 100
_BUILDING_M2 = 40_000.0
_PAIRS = 200
_PAIRS_QUICK = 20
_WARM_UP = 3  # pairs before the measurement
_CONFIG = WavefrontConfig()


@dataclass(eq=False)
class _Tally:
    """Planning times, s, and length of each path over that of the wavefront alone."""

    alone_s: list[float] = field(default_factory=list)
    along_s: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)


def long_paths(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows of some floors and a generated building."""
    for name in _FLOORS:
        yield from _measure(name, read_map(floor(name, worlds).path), quick)
    if not quick:
        building = generate_building(_BUILDING, BuildingConfig(area_m2=_BUILDING_M2))
        name = f'generated building {_BUILDING}, {_BUILDING_M2:.0f} m2'
        yield from _measure(name, patch_of_world(building.world), quick)


def _measure(name: str, patch: GridPatch, quick: bool) -> Iterator[Row]:
    topology = build(patch, None, TopologyConfig())
    rng = np.random.default_rng(0)
    cells = np.argwhere(np.isfinite(cost_of_cells(patch, _CONFIG)))
    tally = _Tally()
    wanted = _WARM_UP + (_PAIRS_QUICK if quick else _PAIRS)
    while len(tally.alone_s) < wanted:
        start, goal = patch.frame.centres_of(cells[rng.integers(len(cells), size=2)]).tolist()
        if math.dist(start, goal) >= LONG_PATH_M:
            _try(topology, patch, (start[0], start[1]), (goal[0], goal[1]), tally)
    alone_ms = 1e3 * np.array(tally.alone_s[_WARM_UP:])
    along_ms = 1e3 * np.array(tally.along_s[_WARM_UP:])
    ratios = np.array(tally.ratios[_WARM_UP:])
    planned = np.isfinite(ratios)
    yield Row(name, f'{len(ratios)} pairs')
    yield at_least('  share of paths planned on the graph', float(planned.mean()), 0.8)
    yield Row('  wavefront alone: time, median and maximum', _times(alone_ms))
    yield Row('  on the graph: time, median and maximum', _times(along_ms))
    yield at_most(
        '  time / that of the wavefront alone, median', float(np.median(along_ms / alone_ms)), 1
    )
    yield at_most(
        '  length / that of the wavefront alone, mean', float(ratios[planned].mean()), 1.03
    )
    yield Row('  the same, maximum', f'{ratios[planned].max():.3g}')


def _try(
    topology: TopologicalMap,
    patch: GridPatch,
    start: tuple[float, float],
    goal: tuple[float, float],
    tally: _Tally,
) -> None:
    """Plan between two points by both, where there is a path; a fallback is part of the time."""
    # Masks that a patch keeps are made again for each plan, as for each new map.
    fresh = GridPatch(patch.frame, patch.cells)
    began = time.perf_counter()
    alone = plan(fresh, start, goal, _CONFIG)
    alone_s = time.perf_counter() - began
    if alone is None:
        return
    fresh = GridPatch(patch.frame, patch.cells)
    began = time.perf_counter()
    band = route_band(topology, fresh, start, goal, _CONFIG)
    along = None if band is None else find_path(band.patch, start, goal, _CONFIG, band=band.cells)
    if along is None:
        plan(fresh, start, goal, _CONFIG)
    tally.along_s.append(time.perf_counter() - began)
    tally.alone_s.append(alone_s)
    tally.ratios.append(
        math.inf if along is None else path_length_m(along.points) / path_length_m(alone)
    )


def _times(values_ms: Array) -> str:
    return f'{np.median(values_ms):.3g} ms, {values_ms.max():.3g} ms'
