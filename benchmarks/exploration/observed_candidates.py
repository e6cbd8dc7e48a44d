"""Worlds to explore, by name: `building/SEED/AREA` is generated, all others are given."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.buildings import BuildingConfig, generate_building
from benchmarks.worlds import floor
from thinmap_ros.closed_loop.loop import make_loop, no_progress
from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.core.exploration.explorer import Explorer
from thinmap_ros.core.exploration.strategy import Decision
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import kernel
from thinmap_ros.sim.coverage import ObservableCells, robot_observable_cells
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World

_GENERATED = 'building/'


def load_case(name: str) -> tuple[World, Array]:
    """World and first start (3,) of a case."""
    if not name.startswith(_GENERATED):
        there = floor(name)
        return there.world, there.starts[0]
    _, seed, area_m2 = name.split('/')
    config = BuildingConfig(
        area_m2=float(area_m2), people_per_1000_m2=0.0, moving_doors=0.0, glass_share=0.0
    )
    world = generate_building(int(seed), config).world
    return world, np.asarray(world.start)


def generated(first_seed: int, count: int) -> list[str]:
    """Names of generated buildings of 300 to 900 m2."""
    seeds = range(first_seed, first_seed + count)
    return [f'{_GENERATED}{seed}/{300 + 100 * (seed % 7)}' for seed in seeds]


Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
COLUMNS = (
    'evidence_id',
    'length_m',
    'hidden_m2',
    'depth_m',
    'visits',
    'probability',
    'expected_m2',
    'area_m2',
)
_DECISIONS_PER_ROW = 40
_SPEED_M_S = 0.5
_LIMIT_S = 4000.0


@dataclass(frozen=True)
class Case:
    """An exploration whose candidates are recorded."""

    world: str

    @property
    def name(self) -> str:
        """Name of the result."""
        return f'{self.world}/0'


def observe(case: Case) -> dict[str, Any]:
    """Explore a world; returns a row of COLUMNS for each candidate, now and then."""
    world, start = load_case(case.world)
    options = Options(speed_m_s=_SPEED_M_S)
    observable = robot_observable_cells(
        world, start, PRESETS[options.robot], options.laser.range_max_m
    )
    rows: list[list[float]] = []
    decisions = 0

    def watch(decision: Decision, T_map_base: Array) -> None:
        nonlocal decisions
        decisions += 1
        if decisions % _DECISIONS_PER_ROW == 0:
            rows.extend(_rows(robot.explorer, robot.pipeline.grid.known_area(), observable))

    loop = make_loop(world, [start], options)
    (robot,) = loop.robots
    robot.watch = watch
    outcome = loop.run(observable, _LIMIT_S, no_progress, scans_per_show=50)
    return {
        'rows': rows,
        'finished': outcome.finished,
        'coverage': loop.coverage[-1][1],
        'options': case.name,
    }


def _rows(explorer: Explorer, patch: GridPatch, observable: ObservableCells) -> list[list[float]]:
    candidates = explorer.candidates
    if not candidates:
        return []
    frame = explorer.frontier_map.frame
    areas = hidden_areas(
        [c.cells[explorer.frontier_map.mask[tuple(c.cells.T)]] for c in candidates],
        frame,
        patch,
        observable,
    )
    return [
        [
            c.evidence.id,
            c.length_m,
            c.view.hidden_m2,
            c.view.depth_m,
            c.evidence.visits,
            c.probability,
            c.expected_area_m2,
            area,
        ]
        for c, area in zip(candidates, areas.tolist(), strict=True)
    ]


def hidden_areas(
    frontiers: list[Cells], frame: GridFrame, patch: GridPatch, observable: ObservableCells
) -> Array:
    """Observable area, m2, that is not known as free and nearest to each frontier (N, 2), (M,).

    Distances lead through that area only. frame: of the frontier cells.
    """
    own = observable.frame
    scale = own.resolution
    missing = observable.cells & ~known_free_cells(patch, observable)
    seeds = [own.cells_of(frame.centres_of(cells)) for cells in frontiers]
    owners = [np.full(len(cells), i) for i, cells in enumerate(seeds)]
    labels = _partition(missing, np.vstack(seeds), np.concatenate(owners))
    counts = np.bincount(labels[labels >= 0], minlength=len(frontiers))
    return np.asarray(counts * scale**2)


def known_free_cells(patch: GridPatch, observable: ObservableCells) -> Mask:
    """Observable cells that are known as free, (H, W)."""
    known = np.zeros(observable.cells.shape, dtype=np.bool_)
    cells = np.argwhere(observable.cells)
    at = patch.frame.cells_of(observable.frame.centres_of(cells))
    inside = ((at >= 0) & (at < patch.shape)).all(axis=1)
    cells = cells[inside]
    known[cells[:, 0], cells[:, 1]] = patch.free[at[inside, 0], at[inside, 1]]
    return known


@kernel
def _partition(missing: Mask, seeds: Cells, owners: Cells) -> NDArray[np.int32]:
    """Owner of the nearest seed (N, 2) of each missing cell (H, W), or -1; breadth first."""
    rows, cols = missing.shape
    labels = np.full((rows, cols), -1, dtype=np.int32)
    queue = np.empty((rows * cols, 2), dtype=np.int64)
    tail = 0
    for i in range(seeds.shape[0]):
        for r in range(max(seeds[i, 0] - 2, 0), min(seeds[i, 0] + 3, rows)):
            for c in range(max(seeds[i, 1] - 2, 0), min(seeds[i, 1] + 3, cols)):
                if missing[r, c] and labels[r, c] < 0:
                    labels[r, c] = owners[i]
                    queue[tail, 0] = r
                    queue[tail, 1] = c
                    tail += 1
    head = 0
    while head < tail:
        row = queue[head, 0]
        col = queue[head, 1]
        head += 1
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(col - 1, 0), min(col + 2, cols)):
                if missing[r, c] and labels[r, c] < 0:
                    labels[r, c] = labels[row, col]
                    queue[tail, 0] = r
                    queue[tail, 1] = c
                    tail += 1
    return labels
