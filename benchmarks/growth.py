"""What a scan costs, and what the map takes, as the map grows: a long drive through the warehouse of 200 x 200 m."""

import resource
import time
from collections.abc import Iterator
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from benchmarks.table import Row, at_most
from benchmarks.warehouse import WAREHOUSE
from thinmap_ros.adapters.world_files import read_tour, read_world
from thinmap_ros.core.slam.localizer import LocalizerConfig
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.lms200 import Lms200Config
from thinmap_ros.sim.pioneer import PRESETS
from thinmap_ros.sim.runner import Simulation
from thinmap_ros.sim.tours import Look, drive, ways_along
from thinmap_ros.sim.world import World

_SPEED_M_S, _ROBOT = 1.0, '2dx'
_MARKS_M, _MARKS_QUICK_M = (100.0, 500.0, 1000.0, 2000.0, 5000.0, 10_000.0), (100.0, 300.0)
_SPAN_M = 100.0  # before a mark, over which its time is measured
_WARM_UP = 20


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows at some lengths of the drive, as they come."""
    marks = list(_MARKS_QUICK_M if quick else _MARKS_M)
    first, started_mb, off = 0.0, _resident_mb(), 0.0
    for mark in _drive(marks):
        way_m, median_ms, slowest_ms, area_m2, off = mark
        grown_mb = _resident_mb() - started_mb
        yield Row(f'warehouse after {way_m:.0f} m: map', f'{area_m2:.0f} m2')
        yield Row('  CPU a scan, median', f'{median_ms:.3g} ms')
        yield Row('  CPU a scan, 99 of 100', f'{slowest_ms:.3g} ms')
        yield Row('  memory grown by', f'{grown_mb:.3g} MB')
        yield Row('  memory a square metre of map', f'{1e3 * grown_mb / area_m2:.3g} kB')
        first = first or median_ms
    yield at_most(f'a scan after {marks[-1]:.0f} m against the first {marks[0]:.0f} m', median_ms / first, 1.2)
    yield at_most('  error of the pose there', off, 1.0, 'm')


def _drive(marks: list[float]) -> Iterator[tuple[float, float, float, float, float]]:
    """At each mark: way, CPU of a scan (median, 99 of 100), ms; free area, m2; error of the pose, m."""
    pipeline: Pipeline | None = None
    way, last, taken, ways = 0.0, None, [], []
    for look in _looks():
        if pipeline is None:
            x, y, yaw = look.T_world_base.tolist()
            pipeline = Pipeline(PipelineConfig(localizer=LocalizerConfig(start_x_m=x, start_y_m=y, start_yaw_rad=yaw)))
        way += 0.0 if last is None else float(np.hypot(*(look.T_world_base - last)[:2]))
        last = look.T_world_base
        began = time.process_time()
        estimate = pipeline.step(look.scan, look.T_odom_base).estimate
        taken.append(1e3 * (time.process_time() - began))
        ways.append(way)
        if way >= marks[0]:
            span = np.array(taken[_WARM_UP:])[np.array(ways[_WARM_UP:]) > way - _SPAN_M]
            free = pipeline.grid.patch()
            off = float(np.hypot(*(estimate.T_map_base - look.T_world_base)[:2]))
            area_m2 = float(free.free.sum()) * free.frame.resolution**2
            yield way, float(np.median(span)), float(np.percentile(span, 99)), area_m2, off
            marks = marks[1:]
            if not marks:
                return


def _looks() -> Iterator[Look]:
    """The tour of the warehouse, again and again."""
    world, tour = World.from_patch(*read_world(WAREHOUSE)), read_tour(WAREHOUSE)
    robot = PRESETS[_ROBOT]
    simulation = Simulation(world, world.start, robot, Lms200Config(), 0)
    first = list(ways_along(world, tour, robot.radius_m))
    return drive(simulation, islice(cycle(first), 20 * len(first)), _SPEED_M_S)


def _resident_mb() -> float:
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * resource.getpagesize() / 1e6
