"""Which robots are switched on where: the rows of docs/results/localization.md, case by case."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.kidnapped import trials
from benchmarks.kidnapped.trials import Map, Record, fresh, prepared, search
from benchmarks.rows import Case
from benchmarks.worlds import floor, floors
from thinmap_ros.closed_loop.robot import Options
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


def _in_the_lab(_: Setting, row: str, seeds: int, steps: int) -> Iterator[Case]:
    for seed in range(seeds):
        yield Case(f'{seed}', partial(_in_lab, seed, steps, row))


def _in_lab(seed: int, steps: int, row: str) -> Record:
    world = floor('lab').world
    known = trials.voronoi_lab_map() if row == 'voronoi' else trials.lab_map()
    if row == 'paper':
        start = pose(*trials.LAB_START)
    else:
        start = random_start(world, np.random.default_rng([1, seed]))
    finder = GlobalLocalization(known.patch, known.topology, seed=seed)
    return search(finder, random_drive(world, start, seed), every=_STEP_SCANS, steps=steps)


@dataclass(frozen=True)
class _Kind:
    """What the drives of a row have in common, beside the floors.

    stream: of the random starts; laser: a name of LASERS; finer: cells so many times smaller, in
    another frame; is_driven: in the map of a drive, as another robot that starts where that was.
    """

    stream: int
    laser: str = ''
    finer: int = 1
    is_driven: bool = False

    @property
    def shift_m(self) -> tuple[float, float]:
        """Where the frame of the map is, seen from that of the world."""
        return _SHIFT_M if self.finer > 1 else (0.0, 0.0)


def _in_buildings(
    setting: Setting, kinds: Sequence[_Kind], part: str = '', drives: int = 20, at_a_time: int = 2
) -> Iterator[Case]:
    """So many drives in each world, some at a time: a row that is cut off has been everywhere."""
    for first in range(0, drives, at_a_time):
        for each, kind in product(floors(setting.worlds, part), kinds):
            for number in range(first, first + at_a_time):
                head = f'{kind.laser}: ' if kind.laser else ''
                run = partial(_in_building, setting.worlds, each.name, number, kind)
                yield Case(f'{head}{each.name} {number}', run)


def _in_building(folder: Path, name: str, number: int, kind: _Kind) -> Record:
    world = floor(name, folder).world
    finder = fresh(_finder(folder, name, kind))
    within = _standing(finder, world) if kind.is_driven else None
    start = random_start(world, np.random.default_rng([kind.stream, number]), within)
    drive = random_drive(world, start, number, within, laser=LASERS.get(kind.laser, _FULL))
    return search(finder, drive, _WAY_M, shift_m=kind.shift_m)


@lru_cache(maxsize=1)
def _finder(folder: Path, name: str, kind: _Kind) -> GlobalLocalization:
    """A search that is ready to begin in a world's map."""
    world = floor(name, folder).world
    laser = LASERS.get(kind.laser, _FULL)
    if kind.is_driven:
        known = trials.driven_map(world, laser)
    else:
        known = trials.shifted_map(world, kind.finer, kind.shift_m)
    start = random_start(world, np.random.default_rng(0))
    return prepared(known, next(random_drive(world, start, 0, laser=laser)), seed=1)


def _standing(finder: GlobalLocalization, world: World) -> np.ndarray:
    """Cells (H, W) of a world where the robot of a search can stand."""
    within = np.zeros(world.occupied.shape, dtype=np.bool_)
    places = finder.places
    standing = places.frame.centres_of(places.standing.astype(np.int64))
    within[tuple(world.frame.cells_of(standing).T)] = True
    return within


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
    return trials.shifted_map(floor(name, folder).world)


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
    'paper': partial(_in_the_lab, row='paper', seeds=20, steps=11),
    'lab': partial(_in_the_lab, row='lab', seeds=500, steps=15),
    'voronoi': partial(_in_the_lab, row='voronoi', seeds=500, steps=15),
    'kth': partial(_in_buildings, kinds=[_Kind(2)], part='kth/', drives=100, at_a_time=5),
    'dungeon': partial(_in_buildings, kinds=[_Kind(2)], part='dungeon/', drives=100, at_a_time=5),
    'twins': twins,
    'foreign': foreign,
    'foreign_log': foreign_log,
    'kidnapped': kidnapped,
    'halves': halves,
    'lasers': partial(_in_buildings, kinds=[_Kind(3, laser) for laser in LASERS]),
    'fine': partial(_in_buildings, kinds=[_Kind(2, finer=2)]),
    'driven': partial(_in_buildings, kinds=[_Kind(4, is_driven=True)]),
}
