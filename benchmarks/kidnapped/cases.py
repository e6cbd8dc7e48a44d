"""Which robots are switched on where: the rows of docs/results/localization.md, case by case."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from benchmarks.kidnapped import trials
from benchmarks.kidnapped.trials import Map, Record, fresh, prepared, search
from benchmarks.rows import Case
from benchmarks.worlds import floor, floors
from thinmap_ros.closed_loop import Options
from thinmap_ros.core.places.global_localizer import GlobalLocalization
from thinmap_ros.core.se2 import pose
from thinmap_ros.evaluation.exploration_run import explore
from thinmap_ros.sim.drives import random_drive, random_start
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.world import World

_STEP_SCANS = 3  # a step of the laboratory's experiment: at 0.5 m/s and 5 Hz, up to 0.3 m
_WAY_M = 40.0
_TWIN_WAY_M = 30.0
_FOREIGN_WAY_M = 20.0
_AT_A_TIME = 5  # drives in a world, before its map makes way for the next one's
_CARRIED_S = 150.0
_LIMIT_S = 300.0
_SHIFT_M = (-12.34, 56.785)
_FULL = LaserScannerConfig()
LASERS = {
    '270 deg in 0.5, 20 m': LaserScannerConfig(
        beams=541, field_of_view_deg=270.0, range_max_m=20.0
    ),
    '270 deg in 0.25, 30 m, 0.2 m ahead': LaserScannerConfig(
        beams=1081, field_of_view_deg=270.0, range_max_m=30.0, laser_x_m=0.2
    ),
    '360 deg in 1, 4 m': LaserScannerConfig(beams=360, field_of_view_deg=360.0, range_max_m=4.0),
    '240 deg in 0.36, 4 m': LaserScannerConfig(beams=667, field_of_view_deg=240.0, range_max_m=4.0),
}


@dataclass(frozen=True)
class Setting:
    """Where worlds and the log are."""

    worlds: Path
    log: Path


def paper(_: Setting) -> Iterator[Case]:
    """The paper's experiment: the laboratory, from its start, 11 steps."""
    for seed in range(20):
        yield Case(f'{seed}', partial(_in_lab, seed, 11, 'paper'))


def lab(_: Setting) -> Iterator[Case]:
    """The laboratory, 500 random starts, 15 steps."""
    for seed in range(500):
        yield Case(f'{seed}', partial(_in_lab, seed, 15, 'lab'))


def voronoi(_: Setting) -> Iterator[Case]:
    """The first of these again, with the nodes of a Voronoi diagram in the map."""
    for seed in range(500):
        yield Case(f'{seed}', partial(_in_lab, seed, 15, 'voronoi'))


def _in_lab(seed: int, steps: int, row: str) -> Record:
    world = floor('lab').world
    known = trials.voronoi_lab_map() if row == 'voronoi' else trials.lab_map()
    if row == 'paper':
        start = pose(*trials.LAB_START)
    else:
        start = random_start(world, np.random.default_rng([1, seed]))
    finder = GlobalLocalization(known.patch, known.topology, seed=seed)
    return search(finder, random_drive(world, start, seed), every=_STEP_SCANS, steps=steps)


def kth(setting: Setting) -> Iterator[Case]:
    """Real floors, 100 random starts each, 40 m of way."""
    yield from _floor_by_floor(setting, _in_building, 100, _AT_A_TIME, 'kth/')


def dungeon(setting: Setting) -> Iterator[Case]:
    """Dungeons, 100 random starts each, 40 m of way."""
    yield from _floor_by_floor(setting, _in_building, 100, _AT_A_TIME, 'dungeon/')


def _floor_by_floor(
    setting: Setting,
    run: Callable[[Path, str, int], Record],
    drives: int,
    at_a_time: int,
    part: str = '',
) -> Iterator[Case]:
    """So many drives in each world, some at a time: a row that is cut off has been everywhere."""
    for first in range(0, drives, at_a_time):
        for each in floors(setting.worlds, part):
            for number in range(first, first + at_a_time):
                yield Case(f'{each.name} {number}', partial(run, setting.worlds, each.name, number))


def _in_building(folder: Path, name: str, number: int) -> Record:
    world = floor(name, folder).world
    laser = _FULL
    start = random_start(world, np.random.default_rng([2, number]))
    return search(
        fresh(_finder(folder, name, '', 1)), random_drive(world, start, number, laser=laser), _WAY_M
    )


@lru_cache(maxsize=1)
def _finder(
    folder: Path, name: str, laser: str, finer: int, driven: bool = False
) -> GlobalLocalization:
    """A search that is ready to begin in a world's map."""
    world = floor(name, folder).world
    kind = LASERS.get(laser, _FULL)
    shift = _SHIFT_M if finer > 1 else (0.0, 0.0)
    known = trials.driven_map(world, kind) if driven else trials.shifted_map(world, finer, shift)
    start = random_start(world, np.random.default_rng(0))
    return prepared(known, next(random_drive(world, start, 0, laser=kind)), seed=1)


def lasers(setting: Setting) -> Iterator[Case]:
    """Other lasers than the usual one, in all worlds."""
    for first in range(0, 20, 2):
        for each in floors(setting.worlds):
            for laser in LASERS:
                for number in range(first, first + 2):
                    run = partial(_with_laser, setting.worlds, each.name, laser, number)
                    yield Case(f'{laser}: {each.name} {number}', run)


def _with_laser(folder: Path, name: str, laser: str, number: int) -> Record:
    world = floor(name, folder).world
    start = random_start(world, np.random.default_rng([3, number]))
    drive = random_drive(world, start, number, laser=LASERS[laser])
    return search(fresh(_finder(folder, name, laser, 1)), drive, _WAY_M)


def fine(setting: Setting) -> Iterator[Case]:
    """The same worlds in maps with cells of half the size, and in another frame."""
    yield from _floor_by_floor(setting, _in_fine_map, 20, 2)


def _in_fine_map(folder: Path, name: str, number: int) -> Record:
    world = floor(name, folder).world
    drive = random_drive(world, random_start(world, np.random.default_rng([2, number])), number)
    return search(fresh(_finder(folder, name, '', 2)), drive, _WAY_M, shift_m=_SHIFT_M)


def driven(setting: Setting) -> Iterator[Case]:
    """Maps made on a drive of 400 m, at exact poses; other robots start where that one was."""
    yield from _floor_by_floor(setting, _in_driven_map, 20, 2)


def _in_driven_map(folder: Path, name: str, number: int) -> Record:
    world = floor(name, folder).world
    finder = fresh(_finder(folder, name, '', 1, driven=True))
    within = np.zeros(world.occupied.shape, dtype=np.bool_)
    cells = world.frame.cells_of(
        finder.places.frame.centres_of(finder.places.standing.astype(np.int64))
    )
    within[cells[:, 0], cells[:, 1]] = True
    start = random_start(world, np.random.default_rng([4, number]), within)
    return search(finder, random_drive(world, start, number, within), _WAY_M)


def twins(_: Setting) -> Iterator[Case]:
    """Places that look the same for ever: twin rooms, and a floor that is the same when turned."""
    for name, (world, within) in (
        ('twin rooms', trials.twin_rooms()),
        ('floor', trials.turned_floor()),
    ):
        for seed in range(20):
            yield Case(f'{name} {seed}', partial(_among_twins, world, within, seed))


def _among_twins(world: World, within: np.ndarray, seed: int) -> Record:
    known = trials.coarse_map(world)
    finder = GlobalLocalization(known.patch, known.topology, seed=seed)
    start = random_start(world, np.random.default_rng(seed), within)
    return trials.watch_twins(finder, random_drive(world, start, seed, within), _TWIN_WAY_M)


def foreign(setting: Setting) -> Iterator[Case]:
    """Robots in other buildings than that of the map, 20 m of way.

    Each map against buildings after it, and others.
    """
    names = ['lab', *sorted(each.name for each in floors(setting.worlds))]
    for distance in range(1, len(names)):
        for number, mapped in enumerate(names):
            driven_in = names[(number + distance * _COPRIME) % len(names)]
            yield Case(
                f'{mapped} <- {driven_in}', partial(_elsewhere, setting.worlds, mapped, driven_in)
            )


_COPRIME = 7  # to 25 worlds: all pairs come, and worlds of both kinds meet at once


def _elsewhere(folder: Path, mapped: str, driven_in: str) -> Record:
    world = floor(driven_in, folder).world
    known: Map = trials.lab_map() if mapped == 'lab' else _map_of(folder, mapped)
    start = random_start(world, np.random.default_rng([5, sum(map(ord, mapped + driven_in))]))
    finder = GlobalLocalization(known.patch, known.topology, seed=1)
    return trials.watch_foreign(finder, random_drive(world, start, 1), _FOREIGN_WAY_M)


@lru_cache(maxsize=1)
def _map_of(folder: Path, name: str) -> Map:
    return trials.shifted_map(floor(name, folder).world, 1, (0.0, 0.0))


def kidnapped(setting: Setting) -> Iterator[Case]:
    """Robots kidnapped after 150 s of exploration with SLAM at 0.5 m/s, elsewhere on the map."""
    for number, each in enumerate(floors(setting.worlds)):
        yield Case(each.name, partial(_carried_off, setting.worlds, each.name, number))


def _carried_off(folder: Path, name: str, seed: int) -> Record:
    there = floor(name, folder)
    options = Options(
        seed=seed, speed_m_s=0.5, localization='slam', time_limit_s=_LIMIT_S, kidnap_at_s=_CARRIED_S
    )
    report = explore(there.world, there.starts[0], options)[1]
    keys = ('detected_after_s', 'found_after_s', 'found_after_m', 'found_error_m', 'found_right')
    return {key: '' if report[key] is None else report[key] for key in keys}


def halves(setting: Setting) -> Iterator[Case]:
    """A real log: the map of its first half, started at 100 stamps of the second, 60 scans."""
    for number in range(100):
        yield Case(f'{number}', partial(trials.in_second_half, setting.log, number))


def foreign_log(setting: Setting) -> Iterator[Case]:
    """The log's robot in the maps of other buildings, and robots of other buildings in its map."""
    names = sorted(each.name for each in floors(setting.worlds))
    for name in names:
        yield Case(f'{name} <- log', partial(_log_elsewhere, setting, name))
    for name in names:
        yield Case(f'log <- {name}', partial(_in_log_map, setting, name))


def _log_elsewhere(setting: Setting, name: str) -> Record:
    known = _map_of(setting.worlds, name)
    samples = trials.samples_from(setting.log, sum(map(ord, name)))
    return trials.watch_foreign(
        GlobalLocalization(known.patch, known.topology, seed=1), samples, _FOREIGN_WAY_M
    )


def _in_log_map(setting: Setting, name: str) -> Record:
    world = floor(name, setting.worlds).world
    known = trials.first_half(setting.log)
    drive = random_drive(world, random_start(world, np.random.default_rng(6)), 6)
    return trials.watch_foreign(
        GlobalLocalization(known.patch, known.topology, seed=1), drive, _FOREIGN_WAY_M
    )


ROWS: dict[str, Callable[[Setting], Iterator[Case]]] = {
    row.__name__: row
    for row in (
        paper,
        lab,
        voronoi,
        kth,
        dungeon,
        twins,
        foreign,
        foreign_log,
        kidnapped,
        halves,
        lasers,
        fine,
        driven,
    )
}
