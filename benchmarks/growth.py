"""What a scan costs, and what the map takes, as the map grows: a long drive through the warehouse of 200 x 200 m."""

import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from benchmarks.table import Row, at_most
from thinmap_ros.adapters.resources import world_path
from thinmap_ros.adapters.world_files import read_tour, read_world
from thinmap_ros.core.slam.localizer import LocalizerConfig
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.lms200 import Lms200Config
from thinmap_ros.sim.pioneer import PRESETS
from thinmap_ros.sim.runner import Simulation
from thinmap_ros.sim.tours import Look, drive, ways_along
from thinmap_ros.sim.world import World

_SPEED_M_S, _ROBOT = 1.0, '2dx'
_MARKS_M, _MARKS_QUICK_M = (100.0, 500.0, 1000.0, 2000.0, 5000.0, 10_000.0), (100.0, 500.0, 1000.0)
_SPAN_M = 100.0  # before a mark, over which its time is measured
_WARM_UP = 20
_RANGE_M = 32.0  # another mode of the LMS200: with 8 m, aisles show too little


@dataclass(frozen=True)
class _Mark:
    """What there is after a way, m: CPU of a scan over the last metres, ms; free area, m2; memory, MB; error, m."""

    way_m: float
    median_ms: float
    slowest_ms: float
    area_m2: float
    resident_mb: float
    off_m: float


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows at some lengths of the drive, as they come."""
    marks = []
    for mark in _drive(list(_MARKS_QUICK_M if quick else _MARKS_M)):
        marks.append(mark)
        yield Row(f'after {mark.way_m:.0f} m: free area in the map', f'{mark.area_m2:.0f} m2')
        yield Row('  CPU a scan, median', f'{mark.median_ms:.3g} ms')
        yield Row('  CPU a scan, 99 of 100', f'{mark.slowest_ms:.3g} ms')
        yield Row('  memory', f'{mark.resident_mb:.0f} MB')
        yield Row('  error of the pose', f'{mark.off_m:.2f} m')
    first, last = marks[0], marks[-1]
    grown_kb = 1e3 * (last.resident_mb - first.resident_mb)
    yield Row('memory a square metre of free area', f'{grown_kb / (last.area_m2 - first.area_m2):.3g} kB')
    what = f'a scan after {last.way_m:.0f} m against the first {first.way_m:.0f} m'
    yield at_most(what, last.median_ms / first.median_ms, 1.2)


def _drive(marks_m: list[float]) -> Iterator[_Mark]:
    """Marks after these lengths of the drive."""
    pipeline: Pipeline | None = None
    way_m, last, taken, ways = 0.0, None, [], []
    for look in _looks():
        if pipeline is None:
            x, y, yaw = look.T_world_base.tolist()
            pipeline = Pipeline(PipelineConfig(localizer=LocalizerConfig(start_x_m=x, start_y_m=y, start_yaw_rad=yaw)))
        way_m += 0.0 if last is None else float(np.hypot(*(look.T_world_base - last)[:2]))
        last = look.T_world_base
        began = time.process_time()
        T_map_base = pipeline.step(look.scan, look.T_odom_base).estimate.T_map_base
        taken.append(1e3 * (time.process_time() - began))
        ways.append(way_m)
        if way_m >= marks_m[0]:
            span = np.array(taken[_WARM_UP:])[np.array(ways[_WARM_UP:]) > way_m - _SPAN_M]
            patch = pipeline.grid.patch()
            yield _Mark(
                way_m, float(np.median(span)), float(np.percentile(span, 99)),
                float(patch.free.sum()) * patch.frame.resolution**2, _resident_mb(),
                float(np.hypot(*(T_map_base - look.T_world_base)[:2])),
            )  # fmt: skip
            marks_m = marks_m[1:]
            if not marks_m:
                return


def _looks() -> Iterator[Look]:
    """The tour of the warehouse, again and again."""
    path = world_path('warehouse')
    world, tour = World.from_patch(*read_world(path)), read_tour(path)
    robot = PRESETS[_ROBOT]
    simulation = Simulation(world, world.start, robot, Lms200Config(range_max_m=_RANGE_M), 0)
    ways = list(ways_along(world, tour, robot.radius_m))  # closed: it begins where it ends
    return drive(simulation, islice(cycle(ways), 20 * len(ways)), _SPEED_M_S)


def _resident_mb() -> float:
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * resource.getpagesize() / 1e6
