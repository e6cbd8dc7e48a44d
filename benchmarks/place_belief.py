"""What each constant of the belief of place is worth: halved and doubled, on kidnaps and starts."""

import math
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks.buildings import BuildingConfig, generate_building
from benchmarks.kidnapped.trials import along
from benchmarks.rows import Row
from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.slam import localizer as localizing
from thinmap_ros.core.slam import place_belief, track
from thinmap_ros.core.slam.graph import loop_closure, reckoned
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.matching import visibility
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import Estimate
from thinmap_ros.sim.drives import DriveSample, random_drive, random_start
from thinmap_ros.sim.world import World

# Where each constant is read: a module that imports it has a name of its own for it.
CONSTANTS: dict[str, tuple[ModuleType, ...]] = {
    'SURE': (place_belief, localizing),
    '_GIVEN': (place_belief,),
    '_LEAST_ODDS': (place_belief,),
    'INLIERS_PER_CONTRADICTION': (place_belief, track),
    'MOST_SEEN_THROUGH': (place_belief, visibility),
    '_OPENING_RADIUS_M': (place_belief,),
    '_OPENING_PATH_M': (place_belief,),
    'RETURNS': (reckoned, loop_closure),
    'CONTRARY_RATIO': (reckoned, loop_closure),
    '_FITS_HERE': (reckoned,),
    '_FITS_ELSEWHERE': (reckoned,),
    '_ALIGNED': (reckoned,),
    '_CAREFUL': (reckoned,),
    '_MOST_OF_A_LOOK': (reckoned,),
    '_LATE_M': (reckoned,),
    '_LOOK_M': (reckoned,),
    '_CONTRARY': (reckoned,),
    '_GROWN': (reckoned,),
    '_GROWN_PER_M': (reckoned,),
}
_FACTORS = (0.5, 2.0)

_AREA_M2 = 350.0
_WRONG_M = 0.5
_MAPPED_M = 60.0
_DRIVEN_M = 12.0  # less than recognition needs: what comes back is where dead reckoning has it
_START_M = 12.0
_COVERED_M = (3.0, 17.0)  # path with scans of another place, and then to the end
_KIDNAPS = ((3, 1), (5, 3))  # building and drive
_COVERED = (2, 11)  # buildings
_STARTS = (2,)
_OFF = {
    'right': (0.0, 0.0, 0.0),
    '1 m': (0.8, 0.6, 0.0),
    '20 degrees': (0.0, 0.0, 0.35),
    'half a turn': (0.0, 0.0, math.pi),
    'another room': (5.0, 3.0, 1.0),
}
_PERIOD_NS = SECOND_NS // 5


@dataclass(frozen=True, eq=False)
class _Moment:
    """A scan, the odometry (3,) at it, the true pose (3,), map frame, and the path to it, m."""

    scan: Scan
    T_odom_base: Array
    T_map_base: Array
    path_m: float


@dataclass(frozen=True, eq=False)
class _Case:
    """A localizer that is about to be wrong, and what it then sees; kind: for which sum."""

    kind: str
    localizer: Localizer
    moments: list[_Moment]


# What counts of each kind of case: scans drawn wrong, of kidnaps or of starts; and the path, m,
# until a robot is in its map, after its laser was covered or after a start that is right.
_COUNTED = {
    'kidnap': ('kidnaps', ''),
    'covered': ('', 'returned_m'),
    'right': ('starts', 'begun_m'),
    'start': ('starts', ''),
}
_TEXT = '{kidnaps} + {starts} wrong; {returned_m:.1f}, {begun_m:.1f} m'


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows: scans drawn wrong, kidnaps + starts; paths to return and to begin."""
    names = ['', *CONSTANTS]
    changes = [(name, factor) for name in names for factor in _FACTORS if name or factor < 1.0]
    if quick:
        changes = changes[:5]
    workers = min(2, os.cpu_count() or 1)
    with ProcessPoolExecutor(workers, get_context('forkserver')) as pool:
        for (name, factor), found in zip(changes, pool.map(_tried, changes), strict=True):
            yield Row(f'{name.strip("_")} x {factor}' if name else 'as it is', found)


def _tried(change: tuple[str, float]) -> str:
    """The outcome of all cases with a constant times a factor."""
    cases = _cases()
    found = {'kidnaps': 0, 'starts': 0, 'returned_m': 0.0, 'begun_m': 0.0, '': 0.0}
    with changed(*change):
        for case in cases:
            for name, value in zip(_COUNTED[case.kind], _wrong_and_way(case), strict=True):
                found[name] += value
    return _TEXT.format(**found)


@contextmanager
def changed(name: str, factor: float) -> Iterator[None]:
    """Multiply a constant of the belief, by its name, while it lasts; '' for none."""
    modules = CONSTANTS.get(name, ())
    before: Any = getattr(modules[0], name) if modules else None
    for module in modules:
        setattr(module, name, before * factor)
    try:
        yield
    finally:
        for module in modules:
            setattr(module, name, before)


def _wrong_and_way(case: _Case) -> tuple[int, float]:
    """Scans of a case that are drawn wrong, and the path, m, along which it was not in its map."""
    localizer = deepcopy(case.localizer)
    wrong = 0
    apart_m = case.moments[0].path_m if case.kind == 'right' else None
    way_m = 0.0
    for moment in case.moments:
        estimate = localizer.step(moment.scan, moment.T_odom_base)
        off = se2.between(estimate.T_map_base, moment.T_map_base)
        is_drawn = _is_drawn(estimate)
        wrong += int(is_drawn and math.hypot(off[0], off[1]) > _WRONG_M)
        if not is_drawn and apart_m is None:
            apart_m = moment.path_m
        if is_drawn and apart_m is not None:
            way_m += moment.path_m - apart_m
            apart_m = None
        if case.kind == 'start' and estimate.is_mapping_apart:
            break  # it is doubted
    if apart_m is not None:
        way_m += case.moments[-1].path_m - apart_m
    return wrong, way_m


def _is_drawn(estimate: Estimate) -> bool:
    return not (estimate.is_lost or estimate.is_contradicted)


@cache
def _cases() -> list[_Case]:
    """All cases, up to where constants matter."""
    return [*_kidnaps(), *_covered(), *_starts()]


def _kidnaps() -> Iterator[_Case]:
    """Robots that are put elsewhere."""
    for building, drive in _KIDNAPS:
        start = _mapped(building, 0.0)
        samples = _drive(_world(building), building, drive, _DRIVEN_M)
        yield _Case('kidnap', start.localizer, _moments(start.T_map_world, samples, start.last))


def _covered() -> Iterator[_Case]:
    """Robots whose laser is covered for a while, and shows what it would see elsewhere."""
    for building in _COVERED:
        start = _mapped(building, sum(_COVERED_M))
        others = _drive(_world(building), building, 1, 2.0 * _COVERED_M[0])
        yield _Case('covered', start.localizer, list(_with_others(start.rest, others)))


@dataclass(frozen=True, eq=False)
class _Start:
    """A localizer after its first drive, where that ended, and what comes next on it.

    T_map_world (3,): of the world in its map.
    """

    localizer: Localizer
    T_map_world: Array
    last: _Moment
    rest: list[_Moment]


def _mapped(building: int, rest_m: float) -> _Start:
    samples = _drive(_world(building), building, 0, _MAPPED_M + rest_m)
    T_map_world = se2.invert(samples[0].T_world_base)
    moments = _moments(T_map_world, samples)
    mapped = [moment for moment in moments if moment.path_m <= _MAPPED_M]
    localizer = Localizer()
    for moment in mapped:
        localizer.step(moment.scan, moment.T_odom_base)
    return _Start(localizer, T_map_world, mapped[-1], moments[len(mapped) :])


def _with_others(moments: list[_Moment], others: list[DriveSample]) -> Iterator[_Moment]:
    """The moments, the first of them with scans of another place."""
    for k, moment in enumerate(moments):
        is_covered = moment.path_m < moments[0].path_m + _COVERED_M[0]
        seen = others[k].scan if is_covered else moment.scan
        yield replace(moment, scan=replace(seen, stamp_ns=moment.scan.stamp_ns))


def _starts() -> Iterator[_Case]:
    """Robots in a session, whose start pose is given, right or wrong."""
    for building in _STARTS:
        start = _mapped(building, 0.0)
        session = start.localizer
        moments = _moments(start.T_map_world, _drive(_world(building), building, 1, _START_M))
        for name, off in _OFF.items():
            x, y, yaw = (moments[0].T_map_base + np.array(off)).tolist()
            config = LocalizerConfig(initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw)
            keyframes = session.saved_keyframes()
            localizer = Localizer.from_state(session.state(), config, keyframes=keyframes)
            yield _Case('right' if name == 'right' else 'start', localizer, moments)


@cache
def _world(seed: int) -> World:
    config = BuildingConfig(
        area_m2=_AREA_M2,
        hall_share=0.0,
        clutter=0.0,
        glass_share=0.0,
        wings=1,
        people_per_1000_m2=0.0,
        moving_doors=0.0,
    )
    return generate_building(seed, config).world


def _drive(world: World, building: int, drive: int, path_m: float) -> list[DriveSample]:
    start = random_start(world, np.random.default_rng([building, drive]))
    return [sample for sample, _ in along(random_drive(world, start, drive), path_m)]


def _moments(
    T_map_world: Array, samples: list[DriveSample], after: _Moment | None = None
) -> list[_Moment]:
    """The samples as moments; after: the last one, from which the robot was carried here."""
    stamp_ns = 0 if after is None else after.scan.stamp_ns
    T_odom = np.zeros(3) if after is None else after.T_odom_base
    path_m = 0.0 if after is None else after.path_m
    before = samples[0]
    found = []
    for sample in samples:
        T_odom = se2.compose(T_odom, se2.between(before.T_odom_base, sample.T_odom_base))
        path_m += math.dist(before.T_world_base[:2], sample.T_world_base[:2])
        before = sample
        stamp_ns += _PERIOD_NS
        scan = replace(sample.scan, stamp_ns=stamp_ns)
        found.append(_Moment(scan, T_odom, se2.compose(T_map_world, sample.T_world_base), path_m))
    return found
