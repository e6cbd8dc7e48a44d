"""Robots switched on anywhere: the maps they have, their drives, how the search for them ends."""

import copy
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.baselines.voronoi import build_voronoi
from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.places.global_localizer import (
    GlobalLocalization,
    PoseHypothesis,
    Result,
    SearchState,
)
from thinmap_ros.core.places.likelihood import Judge
from thinmap_ros.core.places.place_database import calibrate, observe
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.evaluation.trajectory_errors import between_paths
from thinmap_ros.experiments.drives import Source, grid_of
from thinmap_ros.logs.reading import open_log, paired_scans
from thinmap_ros.pipeline import Pipeline
from thinmap_ros.sim.drives import DriveSample, random_drive, random_start, world_to_grid
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.world import World

LAB_START = (2.0, 2.0, -np.pi / 2.0)
_RIGHT_RAD = np.radians(10.0)
_MAPPED_WAY_M = 400.0

Record = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Map:
    """What a robot has of a world: grid and topological map."""

    patch: GridPatch
    topology: TopologicalMap


def map_of_patch(patch: GridPatch) -> Map:
    """A grid with the topological map of all of it."""
    return Map(patch, build(patch, None, TopologyConfig()))


@lru_cache(maxsize=1)
def lab_map() -> Map:
    """The map of the laboratory of the topological map paper, merged from its stops."""
    patch = grid_of(Source().samples('lab_stops')).known_area()
    return Map(patch, build(patch, LAB_START[:2], TopologyConfig()))


@lru_cache(maxsize=1)
def voronoi_lab_map() -> Map:
    """The same with the nodes of a Voronoi diagram."""
    return Map(lab_map().patch, build_voronoi(lab_map().patch))


def shifted_map(world: World, finer: int = 1, shift_m: tuple[float, float] = (0.0, 0.0)) -> Map:
    """A world itself as a map, in cells so many times finer, in a frame moved by this much."""
    patch = world_to_grid(world)
    cells = np.repeat(np.repeat(patch.cells, finer, axis=0), finer, axis=1)
    frame = patch.frame
    origin = (frame.origin_x + shift_m[0], frame.origin_y + shift_m[1])
    shifted = GridFrame(*origin, frame.resolution / finer)
    return map_of_patch(GridPatch(shifted, cells))


def driven_map(world: World, laser: LaserScannerConfig) -> Map:
    """The map of a long drive with a laser at exact poses, full of what the robot did not see."""
    samples = random_drive(world, random_start(world, np.random.default_rng(99)), 99, laser=laser)
    return map_of_patch(grid_of(sample for sample, _ in along(samples, _MAPPED_WAY_M)).known_area())


def prepared(known: Map, sample: DriveSample, seed: int) -> GlobalLocalization:
    """A localizer with its map prepared, and the laser known from the scan of a sample."""
    finder = GlobalLocalization(known.patch, known.topology, seed=seed)
    finder.step(sample.scan, sample.T_odom_base)
    finder.restart()
    return finder


def fresh(finder: GlobalLocalization) -> GlobalLocalization:
    """A copy: each drive is searched as if it were the only one."""
    return copy.deepcopy(finder)


def along(samples: Iterable[DriveSample], limit_m: float) -> Iterator[tuple[DriveSample, float]]:
    """Each sample and the distance travelled so far, up to limit_m."""
    way = 0.0
    last = None
    for sample in samples:
        way += 0.0 if last is None else float(np.hypot(*(sample.T_world_base - last)[:2]))
        last = sample.T_world_base
        yield sample, way
        if way > limit_m:
            return


def offset(found: PoseHypothesis, truth: Array) -> tuple[float, float]:
    """How far a hypothesis is from where the robot truly is (3,): m and rad."""
    off = found.T_map_base - truth
    return float(np.hypot(off[0], off[1])), abs(wrap(float(off[2])))


def search(
    finder: GlobalLocalization,
    samples: Iterable[DriveSample],
    limit_m: float = np.inf,
    every: int = 1,
    steps: int = 10**9,
    right_m: float = 0.3,
    shift_m: tuple[float, float] = (0.0, 0.0),
) -> Record:
    """How the search ends for a robot that drives until it is sure, or steps or way are used up.

    shift_m: where the map's frame is, seen from the world's.
    """
    seconds = []
    count = 0
    result = None
    driven_m = 0.0
    for k, (sample, way) in enumerate(along(samples, limit_m)):
        if k % every:
            continue
        driven_m = way
        began = time.process_time()
        result = finder.step(sample.scan, sample.T_odom_base)
        seconds.append(time.process_time() - began)
        count += 1
        if result.pose is not None or count == steps:
            break
    record: Record = {
        'outcome': 'open',
        'way_m': round(driven_m, 2),
        'steps': count,
        'off_m': '',
        'off_deg': '',
    }
    if result is not None and result.pose is not None:
        off_m, off_rad = offset(result.pose, sample.T_world_base + (*shift_m, 0.0))
        good = off_m <= right_m and off_rad <= _RIGHT_RAD
        off = {'off_m': round(off_m, 3), 'off_deg': round(float(np.degrees(off_rad)), 2)}
        record |= {'outcome': 'right' if good else 'wrong', **off}
    return record | {'step_ms': round(1e3 * float(np.median(seconds)), 2)}


def watch_twins(
    finder: GlobalLocalization, samples: Iterable[DriveSample], limit_m: float
) -> Record:
    """Counts of steps of a robot that cannot tell places apart.

    How often it is sure, and how often the two likeliest places are equally likely.
    """
    results = [
        finder.step(sample.scan, sample.T_odom_base) for sample, _ in along(samples, limit_m)
    ]
    return {
        'steps': len(results),
        'sure': sum(result.state == SearchState.LOCALIZED for result in results),
        'equal': sum(_gap(result) < 0.1 for result in results),
    }


def _gap(result: Result) -> float:
    """By how much the likeliest is likelier than the next."""
    found = sorted((hypothesis.weight for hypothesis in result.hypotheses), reverse=True)
    weights = [*found, 0.0, 0.0]
    return weights[0] - weights[1]


def watch_foreign(
    finder: GlobalLocalization, samples: Iterable[DriveSample], limit_m: float
) -> Record:
    """Record of a robot in a building that is not in the map: distances until the result.

    The search continues after a result.
    """
    record: Record = {'said_m': '', 'sure_m': '', 'last': ''}
    for sample, way in along(samples, limit_m):
        state = finder.step(sample.scan, sample.T_odom_base).state
        for key, wanted in (('said_m', SearchState.NOT_IN_MAP), ('sure_m', SearchState.LOCALIZED)):
            if state == wanted and record[key] == '':
                record[key] = round(way, 2)
        record['last'] = state.name
    return record


def twin_rooms() -> tuple[World, NDArray[np.bool_]]:
    """Two equal rooms, doors shut, not a whole number of cells apart; the robot is in the first."""
    cells = np.ones((300, 700), dtype=np.uint8)
    for left in (20, 367):
        cells[20:270, left : left + 300] = 0
        cells[110:140, left + 60 : left + 110] = 1
        cells[210:270, left + 200 : left + 240] = 1
    within = np.zeros(cells.shape, dtype=np.bool_)
    within[25:265, 25:315] = True
    return World('twin rooms', cells, GridFrame(0.0, 0.0, 0.02), np.zeros(3)), within


def turned_floor() -> tuple[World, NDArray[np.bool_]]:
    """A floor that looks the same when it is turned by 180 degrees about its middle."""
    cells = np.zeros((440, 893), dtype=np.uint8)
    cells[:5] = cells[-5:] = 1
    cells[:, :5] = cells[:, -5:] = 1
    walls = (
        (100, 0, 105, 300),
        (250, 200, 255, 420),
        (0, 400, 180, 405),
        (300, 80, 340, 140),
        (30, 520, 60, 600),
    )
    for top, left, bottom, right in walls:
        cells[top:bottom, left:right] = 1
    cells |= cells[::-1, ::-1]
    world = World('turned floor', cells, GridFrame(-0.013, -0.027, 0.02), np.zeros(3))
    return world, np.ones(cells.shape, np.bool_)


def coarse_map(world: World) -> Map:
    """The map of a finer world in cells of 10 cm."""
    k = round(0.1 / world.frame.resolution)
    rows, cols = (size // k * k for size in world.occupied.shape)
    cells = world.occupied[:rows, :cols].reshape(rows // k, k, cols // k, k).max(axis=(1, 3))
    frame = replace(world.frame, resolution=0.1)
    return map_of_patch(GridPatch(frame, np.where(cells != 0, np.int8(100), np.int8(0))))


SCANS = 60
_STARTS = 100
_RIGHT_M = 0.5
_EVERY = 10  # scan that is looked at to tell whether a place is in the map
# Shares of the beams
_SHOWN = 0.7
_AGREES = 0.8


@dataclass(frozen=True, eq=False)
class _Halves:
    """Looks of the whole log with poses in the frame of the map of the first half, and that map."""

    samples: list[DriveSample]
    half: int
    known: Map


def first_half(log: Path) -> Map:
    """The map of the first half of a log."""
    return _halves(log).known


def samples_from(log: Path, seed: int) -> Iterator[DriveSample]:
    """Looks of a log from a random one of its first three quarters on."""
    samples = _halves(log).samples
    yield from samples[int(np.random.default_rng(seed).integers(3 * len(samples) // 4)) :]


def in_second_half(log: Path, number: int) -> Record:
    """A robot switched on at one of 100 stamps of the second half, with the map of the first."""
    halves = _halves(log)
    begin = int(np.linspace(halves.half, len(halves.samples) - SCANS - 1, _STARTS)[number])
    samples = halves.samples[begin : begin + SCANS]
    shown, agrees = _in_map(_finder(log), samples)
    record = search(fresh(_finder(log)), samples, steps=SCANS, right_m=_RIGHT_M)
    return record | {'shown': round(shown, 3), 'agrees': round(agrees, 3)}


@lru_cache(maxsize=1)
def _finder(log: Path) -> GlobalLocalization:
    return prepared(_halves(log).known, _halves(log).samples[0], seed=1)


def _in_map(finder: GlobalLocalization, samples: list[DriveSample]) -> tuple[float, float]:
    """Of how many beams the map tells, from true poses, and with how many of these it agrees."""
    asked = 0.0
    agreed = 0.0
    beams = 0
    model = calibrate(finder.places, samples[0].scan, finder.config, np.random.default_rng(0))
    judge = Judge(finder.places, finder.config, model)
    for sample in samples[: SCANS // 2 : _EVERY // 2]:
        seen = observe(sample.scan, finder.places.frame.resolution, finder.config)
        counts, silent = judge.explained(judge.refined(sample.T_world_base[None], seen), seen)
        beams += len(seen.ranges_m)
        asked += len(seen.ranges_m) - float(silent[0])
        agreed += float(counts[0])
    return asked / beams, agreed / max(asked, 1.0)


def is_in_map(record: dict[str, str]) -> bool:
    """Whether the map shows the place where a robot was switched on, as it was then."""
    return float(record['shown']) >= _SHOWN and float(record['agrees']) >= _AGREES


@lru_cache(maxsize=1)
def _halves(log: Path) -> _Halves:
    pairs = list(paired_scans(open_log(log)))
    half = len(pairs) // 2
    pipeline = Pipeline()
    for scan, T_odom_base in pairs[:half]:
        pipeline.step(scan, T_odom_base)
    known = Map(pipeline.grid.known_area(), copy.deepcopy(pipeline.topology.map))
    first = pipeline.localizer.optimized_trajectory()
    for scan, T_odom_base in pairs[half:]:
        pipeline.step(scan, T_odom_base)
    whole = pipeline.localizer.optimized_trajectory()
    T_first_whole = between_paths(whole[:half], first)
    poses = [se2.compose(T_first_whole, T) for T in whole]
    return _Halves(
        [DriveSample(*pair, T) for pair, T in zip(pairs, poses, strict=True)], half, known
    )
