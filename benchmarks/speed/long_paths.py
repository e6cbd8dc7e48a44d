"""Distant goals: A* on the graph with the wavefront in a band, against the wavefront alone."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.buildings import BuildingConfig, generate_building
from benchmarks.rows import Row, at_least, at_most
from benchmarks.worlds import floors
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.paths import LONG_PATH_M, route_band
from thinmap_ros.core.planning.wavefront import WavefrontConfig, cost_of_cells, find_path, plan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.experiments.drives import patch_of_world
from thinmap_ros.files.occupancy_maps import read_map

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


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows of some floors and a generated building."""
    for name in _FLOORS:
        for floor in floors(worlds, name):
            yield from _measure(name, read_map(floor.path), quick)
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
    tally.ratios.append(math.inf if along is None else _length(along.points) / _length(alone))


def _times(values_ms: Array) -> str:
    return f'{np.median(values_ms):.3g} ms, {values_ms.max():.3g} ms'


def _length(path: Array) -> float:
    return float(np.hypot(*np.diff(path, axis=0).T).sum())
