"""What a scan and the map cost as it grows: a long drive through the warehouse of 200 x 200 m."""

import math
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, at_most
from benchmarks.time_and_memory import resident_mb
from benchmarks.worlds import floor
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.files.worlds import read_tour
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.drives import DriveConfig, DriveSample, drive, tour_paths
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import Simulation

_SPEED_M_S = 1.0
_ROBOT = '2dx'
_MARKS_M = (100.0, 500.0, 1000.0, 2000.0, 3000.0, 5000.0, 7500.0, 10_000.0)
_MARKS_QUICK_M = (100.0, 500.0, 1000.0)
_SPAN_M = 100.0  # before a mark, over which its time is measured
_KILOMETRE_M = 1000.0
_MAX_GROWTH = 1.3  # of a kilometre over the first one
_WARM_UP = 300  # scans of a drive that is thrown away
_RANGE_M = 32.0  # another mode of the LMS200: with 8 m, aisles show too little
_PARTS = ('localizer', 'grid', 'topology')


@dataclass(frozen=True, eq=False)
class _Mark:
    """Measurements at a distance, m: CPU by part, ms; area, m2; memory, MB; pose error, m.

    kilometre_ms: CPU time of a scan on the last kilometre, mean.
    """

    travelled_m: float
    taken_ms: dict[str, Array]
    kilometre_ms: float
    area_m2: float
    resident_mb: float
    off_m: float


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows at some lengths of the drive, as they come."""
    deque(_drive(islice(_samples()[0], _WARM_UP), [math.inf]), maxlen=0)  # compiles
    samples, lap_m = _samples()
    # A further drive along the first part.
    again = [lap * lap_m + _MARKS_M[0] for lap in range(1, 4)]
    first: _Mark | None = None
    new: _Mark | None = None  # the last one of the first lap
    kilometre: _Mark | None = None  # the first one
    for mark in _drive(samples, sorted(_MARKS_QUICK_M if quick else {*_MARKS_M, *again})):
        yield from _rows(mark)
        first = first or mark
        if mark is first:
            continue
        lap = again.index(mark.travelled_m) + 2 if mark.travelled_m in again else None
        where = f'lap {lap}, first {_SPAN_M:.0f} m' if lap else f'after {mark.travelled_m:.0f} m'
        yield from _ratios(where, mark, first)
        if kilometre is not None:
            yield from _against_kilometre(mark, kilometre)
        elif mark.travelled_m >= _KILOMETRE_M:
            kilometre = mark
        if mark.travelled_m <= lap_m:
            new = mark
            grown_kb = 1e3 * (mark.resident_mb - first.resident_mb)
            yield Row(
                '  memory per square metre of new free area',
                f'{grown_kb / (mark.area_m2 - first.area_m2):.3g} kB',
            )
        elif new is not None:
            more_mb = (mark.resident_mb - new.resident_mb) / (
                1e-3 * (mark.travelled_m - new.travelled_m)
            )
            yield Row('  memory per kilometre in the known area', f'{more_mb:.3g} MB')


def _rows(mark: _Mark) -> Iterator[Row]:
    yield Row(f'after {mark.travelled_m:.0f} m: free area in the map', f'{mark.area_m2:.0f} m2')
    every = mark.taken_ms['all']
    yield Row(
        '  CPU time of a scan, median and mean', f'{np.median(every):.3g} and {every.mean():.3g} ms'
    )
    for of, name in ((np.median, 'median'), (np.mean, 'mean')):
        parts = ', '.join(f'{of(mark.taken_ms[part]):.2f}' for part in _PARTS)
        yield Row(f'  {", ".join(_PARTS)}: {name}', f'{parts} ms')
    yield Row('  CPU time of a scan, 99th percentile', f'{np.percentile(every, 99):.3g} ms')
    yield Row('  memory', f'{mark.resident_mb:.0f} MB')
    yield Row('  position error', f'{mark.off_m:.2f} m')


def _ratios(where: str, mark: _Mark, first: _Mark) -> Iterator[Row]:
    now = mark.taken_ms['all']
    then = first.taken_ms['all']
    yield at_most(
        f'  {where}: CPU time / that of the first time, median',
        float(np.median(now) / np.median(then)),
        1.2,
    )
    yield at_most('  the same, mean', float(now.mean() / then.mean()), 1.2)


def _against_kilometre(mark: _Mark, first: _Mark) -> Iterator[Row]:
    yield at_most(
        '  last kilometre: CPU time / that of the first one, mean',
        mark.kilometre_ms / first.kilometre_ms,
        _MAX_GROWTH,
    )
    yield at_most(
        '  memory / that after the first kilometre',
        mark.resident_mb / first.resident_mb,
        _MAX_GROWTH,
    )


def _drive(samples: Iterator[DriveSample], marks_m: list[float]) -> Iterator[_Mark]:
    """Marks after these lengths of the drive."""
    pipeline: Pipeline | None = None
    travelled_m = 0.0
    last = None
    ways = []
    taken: dict[str, list[float]] = {part: [] for part in ('all', *_PARTS)}
    for sample in samples:
        if pipeline is None:
            x, y, yaw = sample.T_world_base.tolist()
            pipeline = Pipeline(
                PipelineConfig(
                    localizer=LocalizerConfig(initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw),
                    grid=PAPER_GRID,
                )
            )
        travelled_m += 0.0 if last is None else float(np.hypot(*(sample.T_world_base - last)[:2]))
        last = sample.T_world_base
        began = time.process_time()
        T_map_base = pipeline.step(sample.scan, sample.T_odom_base).estimate.T_map_base
        _ = pipeline.topology  # made for each scan, as an explorer asks for it
        taken['all'].append(time.process_time() - began)
        for part in _PARTS:
            taken[part].append(pipeline.stage_seconds[part][-1])
        ways.append(travelled_m)
        if travelled_m >= marks_m[0]:
            on_span = np.array(ways) > travelled_m - _SPAN_M
            on_kilometre = np.array(ways) > travelled_m - _KILOMETRE_M
            patch = pipeline.grid.known_area()
            yield _Mark(
                marks_m[0],
                {part: 1e3 * np.array(each)[on_span] for part, each in taken.items()},
                1e3 * float(np.array(taken['all'])[on_kilometre].mean()),
                float(patch.free.sum()) * patch.frame.resolution**2,
                resident_mb(),
                float(np.hypot(*(T_map_base - sample.T_world_base)[:2])),
            )
            marks_m = marks_m[1:]
            if not marks_m:
                return


def _samples() -> tuple[Iterator[DriveSample], float]:
    """The tour of the warehouse, again and again, and its length, m."""
    warehouse = floor('warehouse')
    world = warehouse.world
    tour = read_tour(warehouse.path)
    robot = PRESETS[_ROBOT]
    simulation = Simulation(world, world.start, robot, LaserScannerConfig(range_max_m=_RANGE_M), 0)
    ways = list(tour_paths(world, tour, robot.radius_m))  # closed: it begins where it ends
    lap_m = float(sum(np.hypot(*np.diff(way, axis=0).T).sum() for way in ways))
    laps = islice(cycle(ways), 20 * len(ways))
    return drive(simulation, laps, DriveConfig(_SPEED_M_S)), lap_m
