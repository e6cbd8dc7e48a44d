"""One session continued on several days over one floor, on which furniture moves each night."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.buildings import BuildingConfig, generate_building
from benchmarks.kidnapped.trials import along
from benchmarks.rows import Row, at_most
from benchmarks.worlds import floor
from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import SavedKeyframes
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.files import sessions
from thinmap_ros.sim.drives import DriveSample, random_drive, random_start
from thinmap_ros.sim.world import World

_DAYS = 3
_GROWTH = 1.2  # of the keyframes after all days
_WAY_M = 400.0
_WAY_QUICK_M = 120.0
_EVERY = 2  # scans, 0.1 m apart
_DAY_NS = 10**14  # between the stamps of two days
_AREA_M2 = 15.0  # of the floor with a piece of furniture
_GAP_M = 0.6  # between furniture and walls
_EDGES_M = (0.4, 1.0)
_START = LocalizerConfig(initial_x_m=1e-9, initial_y_m=0.0, initial_yaw_rad=0.0)


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows with all keyframes, and with those that a session keeps."""
    if quick:
        config = BuildingConfig(area_m2=350.0, people_per_1000_m2=0.0, moving_doors=0.0)
        world = generate_building(9, config).world
    else:
        world = floor('kth/50052751', worlds).world
    way_m = _WAY_QUICK_M if quick else _WAY_M
    start = random_start(world, np.random.default_rng(1))
    days = [_drive(furnished(world, start, day), start, day, way_m) for day in range(_DAYS)]
    found = {name: list(_days(days, name == 'all')) for name in ('all', 'kept')}
    for day in range(_DAYS):
        for name, after in found.items():
            yield Row(f'day {day + 1}, {name}: keyframes', f'{after[day].keyframes}')
            yield Row('  edges between visits', f'{after[day].edges}')
            yield Row('  keyframes, root mean square error', f'{after[day].map_m:.3f} m')
            yield Row('  live, root mean square error', f'{after[day].live_m:.3f} m')
    kept = found['kept']
    growth = kept[-1].keyframes / found['all'][0].keyframes
    yield at_most('keyframes of the last day by those of the first', growth, _GROWTH)


def furnished(world: World, start: Array, day: int) -> World:
    """The world with boxes at places of that day, apart from walls and the start (3,)."""
    rng = np.random.default_rng(day)
    cells = world.occupied.copy()
    metre = 1.0 / world.frame.resolution
    free = np.argwhere(world.distance_to_wall_m > _GAP_M + 0.5 * _EDGES_M[1])
    area_m2 = np.count_nonzero(world.occupied == 0) / metre**2
    for row, col in free[rng.integers(len(free), size=round(area_m2 / _AREA_M2))].tolist():
        half = np.round(0.5 * metre * rng.uniform(*_EDGES_M, 2)).astype(int).tolist()
        at = world.frame.centres_of(np.array([[row, col]]))[0]
        if np.hypot(*(at - start[:2])) > 2.0:
            cells[row - half[0] : row + half[0], col - half[1] : col + half[1]] = 1
    return replace(world, occupied=cells)


def _drive(world: World, start: Array, day: int, way_m: float) -> list[DriveSample]:
    samples = along(random_drive(world, start, day), way_m)
    return [
        replace(sample, scan=replace(sample.scan, stamp_ns=sample.scan.stamp_ns + day * _DAY_NS))
        for k, (sample, _) in enumerate(samples)
        if k % _EVERY == 0
    ]


@dataclass(frozen=True)
class _Day:
    """A session at the end of a day, and its errors, m: of keyframes, and of the poses live."""

    keyframes: int
    edges: int
    map_m: float
    live_m: float


def _days(days: list[list[DriveSample]], has_all: bool) -> Iterator[_Day]:
    """The session after each day; has_all: with all keyframes."""
    T_world_map = days[0][0].T_world_base
    truths: dict[bytes, Array] = {}  # by the pose of the keyframe in the saved session
    with TemporaryDirectory() as folder:
        stem = str(Path(folder) / 'floor')
        localizer = Localizer(_START)
        for samples in days:
            places = {sample.scan.stamp_ns: sample.T_world_base for sample in samples}
            for frame in localizer.keyframes:
                places[frame.scan.stamp_ns] = truths[frame.T_map_base.tobytes()]
            live = []
            for sample in samples:
                estimate = localizer.step(sample.scan, sample.T_odom_base)
                live.append((estimate.T_map_base, sample.T_world_base))
            frames = localizer.keyframes
            truths = {f.T_map_base.tobytes(): places[f.scan.stamp_ns] for f in frames}
            sessions.save_localizer(stem, localizer)
            if has_all:
                sessions.KEYFRAMES.save(stem, _all_of(localizer))
            saved = sessions.KEYFRAMES.load(stem)
            kept = [(f.T_map_base, truths[f.T_map_base.tobytes()]) for f in saved.frames]
            errors = [_error_m(T_world_map, pairs) for pairs in (kept, live)]
            yield _Day(len(saved.frames), len(saved.edges), *errors)
            continued = sessions.load_localizer(stem, _START)
            assert isinstance(continued, Localizer)
            localizer = continued


def _all_of(localizer: Localizer) -> SavedKeyframes:
    keyframes = localizer.saved_keyframes()
    assert keyframes is not None
    return keyframes


def _error_m(T_world_map: Array, pairs: list[tuple[Array, Array]]) -> float:
    """Of poses in the map against the true ones in the world, root mean square."""
    off = [se2.compose(T_world_map, T) - truth for T, truth in pairs]
    return float(np.sqrt(np.mean(np.square(np.array(off)[:, :2]).sum(axis=1))))
