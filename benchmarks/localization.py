"""Global localization: how soon a robot that was switched on anywhere knows where it is, and how often it is wrong."""

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.table import Row, at_least, at_most
from benchmarks.timing import median_seconds
from benchmarks.worlds import floors
from thinmap_ros.adapters.world_files import read_world
from thinmap_ros.baselines.voronoi import build_voronoi
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.localization.calibration import NodeModel, random_pose
from thinmap_ros.core.localization.config import GlobalLocalizationConfig
from thinmap_ros.core.localization.global_localization import GlobalLocalization, Hypothesis, Result, State
from thinmap_ros.core.localization.judging import Judge
from thinmap_ros.core.localization.observation import observe
from thinmap_ros.core.localization.places import Places
from thinmap_ros.core.se2 import Array, pose, wrap
from thinmap_ros.core.topology.graph import Node, NodeKind, TopologicalMap
from thinmap_ros.core.topology.update import TopologyConfig, build
from thinmap_ros.sim.tours import Look, patch_of, random_drive, random_start
from thinmap_ros.sim.world import World
from thinmap_ros.tools.experiments.drives import Source
from thinmap_ros.tools.experiments.maps import grid_of

_LAB = Path(__file__).resolve().parent.parent / 'worlds' / 'lab.yaml'
_PAPER_START = (2.0, 2.0, -np.pi / 2.0)
_STEP_SCANS = 3  # a step of the laboratory's experiment: at 0.5 m/s and 5 Hz, up to 0.3 m
_RIGHT_M, _RIGHT_RAD = 0.3, np.radians(10.0)


@dataclass(frozen=True, eq=False)
class Map:
    """What the robot has of a world: grid and topological map."""

    patch: GridPatch
    topology: TopologicalMap


@dataclass
class Tally:
    """How drives ended, and how long each step took."""

    right: int = 0
    wrong: int = 0
    open: int = 0
    ways: list[float] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def rows(self, name: str, right: float, wrong: float) -> Iterator[Row]:
        """What is to be known of them; right, wrong: shares in percent that are wanted."""
        count = self.right + self.wrong + self.open
        yield Row(name, f'{count} drives')
        yield at_least('  right', 100.0 * self.right / count, right, '%')
        yield at_most('  wrong and sure', 100.0 * self.wrong / count, wrong, '%')
        for what, values in (('way', self.ways), ('steps', self.steps)):
            shares = ' '.join(f'{value:.3g}' for value in np.percentile(values, [50, 90, 97, 99]))
            yield Row(f'  {what} until sure: 50, 90, 97, 99 of 100', shares)
        yield Row('  a step, median', f'{1e3 * float(np.median(self.seconds)):.3g} ms')


def is_right(found: Hypothesis, truth: Array) -> bool:
    """Whether a hypothesis is where the robot truly is (3,)."""
    off = found.T_map_base - truth
    return float(np.hypot(off[0], off[1])) <= _RIGHT_M and abs(wrap(float(off[2]))) <= _RIGHT_RAD


def find(finder: GlobalLocalization, looks: Iterable[Look], tally: Tally, every: int, steps: int, way_m: float) -> None:
    """Let a lost robot drive until it is sure, or steps or way are used up."""
    finder.restart()
    way, last, count = 0.0, None, 0
    for k, look in enumerate(looks):
        way += 0.0 if last is None else float(np.hypot(*(look.T_world_base - last)[:2]))
        last = look.T_world_base
        if k % every:
            continue
        began = time.process_time()
        result = finder.step(look.scan, look.T_odom_base)
        tally.seconds.append(time.process_time() - began)
        count += 1
        if result.pose is not None or count == steps or way > way_m:
            break
    tally.ways.append(way)
    tally.steps.append(count)
    tally.open += result.pose is None
    good = result.pose is not None and is_right(result.pose, look.T_world_base)
    tally.right += good
    tally.wrong += result.pose is not None and not good


def map_of(world: World) -> Map:
    """The map that a world is itself."""
    patch = patch_of(world)
    return Map(patch, build(patch, None, TopologyConfig()))


def _step_times(folder: Path, quick: bool) -> Iterator[Row]:
    """5,000 samples against 10 observed nodes and the beams of a scan, in maps with few and many nodes."""
    floor = floors(folder, 'kth/50052749')[0]
    patch = map_of(floor.world).patch
    look = next(random_drive(floor.world, floor.starts[0], 0))
    rng = np.random.default_rng(0)
    for count, limit in ((30, 2.0), (120, 3.0), (2000, 5.0)):
        config = GlobalLocalizationConfig()
        free = patch.frame.centres_of(rng.permutation(np.argwhere(patch.free))[:count])
        nodes = [Node(k, NodeKind.BRANCH, x, y, 1.0) for k, (x, y) in enumerate(free.tolist(), 1)]
        places = Places.of(patch, TopologicalMap(nodes), config)
        judge = Judge(places, config, NodeModel(np.full(3, 0.5), np.full(3, 0.4), np.full(3, 20.0)))
        seen = replace(
            observe(look.scan, patch.frame.resolution, config),
            nodes=rng.normal(0.0, 2.0, (10, 2)), node_kinds=np.ones(10, dtype=np.int64),
        )
        samples = np.array([random_pose(places, rng) for _ in range(config.samples)])
        taken = 1e3 * median_seconds(partial(judge.log_likelihoods, samples, seen), 20 if quick else 200)
        yield at_most(f'5,000 samples, 10 observed nodes, {count} in the map', taken, limit, 'ms')
        yield Row('  what the map takes', f'{places.memory_bytes() / 1e6:.3g} MB', 'at most 50 MB')


def _lab_map() -> Map:
    """The laboratory's map, merged from its stops."""
    patch = grid_of(Source().looks('lab_stops')).patch()
    return Map(patch, build(patch, _PAPER_START[:2], TopologyConfig()))


def _laboratory(quick: bool) -> Iterator[Row]:
    world = World.from_patch(*read_world(_LAB))
    known = _lab_map()
    tally = Tally()
    for seed in range(5 if quick else 20):
        finder = GlobalLocalization(known.patch, known.topology, seed=seed)
        find(finder, random_drive(world, pose(*_PAPER_START), seed), tally, _STEP_SCANS, 11, np.inf)
    yield from tally.rows("lab, the paper's start, 11 steps", 100.0, 0.0)
    rng, tally = np.random.default_rng(0), Tally()
    for seed in range(40 if quick else 500):
        drive = random_drive(world, random_start(world, rng), seed)
        find(finder, drive, tally, _STEP_SCANS, 15, np.inf)
    yield from tally.rows('lab, random starts, 15 steps', 99.0, 0.0)


def _thinning_or_voronoi(quick: bool) -> Iterator[Row]:
    """The laboratory with the nodes of thinning, and of a Voronoi diagram, in the map; a scan's own are of thinning."""
    world = World.from_patch(*read_world(_LAB))
    known = _lab_map()
    for name, topology in (('thinning', known.topology), ('Voronoi', build_voronoi(known.patch))):
        rng, tally = np.random.default_rng(5), Tally()
        finder = GlobalLocalization(known.patch, topology, seed=5)
        for seed in range(20 if quick else 200):
            drive = random_drive(world, random_start(world, rng), 2000 + seed)
            find(finder, drive, tally, _STEP_SCANS, 15, np.inf)
        yield from tally.rows(f'lab, {len(topology.nodes)} nodes by {name}, 15 steps', 99.0, 0.0)


def _buildings(folder: Path, quick: bool) -> Iterator[Row]:
    for part, count in (('kth', 100), ('dungeon', 100)):
        tally = Tally()
        for floor in floors(folder, part)[:: 1 if part == 'kth' else 5 if quick else 1]:
            known, rng = map_of(floor.world), np.random.default_rng(1)
            finder = GlobalLocalization(known.patch, known.topology, seed=1)
            for seed in range(5 if quick else count):
                drive = random_drive(floor.world, random_start(floor.world, rng), seed)
                find(finder, drive, tally, 1, 10**9, 40.0)
        yield from tally.rows(f'{part}, random starts, 40 m', 97.0, 0.5)


def _ambiguous(quick: bool) -> Iterator[Row]:
    for name, world, within in (('twin rooms', *_twin_rooms()), ('turned floor', *_turned_floor())):
        known = _coarse_map(world)
        gaps, sure, asked = [], 0, 0
        for seed in range(3 if quick else 20):
            finder = GlobalLocalization(known.patch, known.topology, seed=seed)
            start = random_start(world, np.random.default_rng(seed), within)
            for look, result in _steps(finder, random_drive(world, start, seed, within), 30.0):
                weights = sorted((hypothesis.weight for hypothesis in result.hypotheses), reverse=True)
                gaps.append(weights[0] - (weights[1] if len(weights) > 1 else 0.0) if weights else 0.0)
                sure += result.state == State.LOCALIZED
                asked += look is not None
        yield at_most(f'{name}: steps at which it is sure', 100.0 * sure / asked, 0.0, '%')
        equal = 100.0 * float(np.mean(np.array(gaps) < 0.1))
        yield at_least(f'{name}: steps with weights within 0.1', equal, 95.0, '%')


def _elsewhere(folder: Path, quick: bool) -> Iterator[Row]:
    known = {floor.name: floor for floor in floors(folder)}
    names = sorted(known)
    rng = np.random.default_rng(2)
    said = said_at_last = sure = 0
    count = 8 if quick else 100
    for seed in range(count):
        mapped, driven = (known[name] for name in rng.choice(names, 2, replace=False))
        the_map = map_of(mapped.world)
        finder = GlobalLocalization(the_map.patch, the_map.topology, seed=seed)
        drive = random_drive(driven.world, random_start(driven.world, rng), seed)
        states = [result.state for _, result in _steps(finder, drive, 20.0)]
        said += State.NOT_IN_MAP in states
        said_at_last += states[-1] == State.NOT_IN_MAP
        sure += State.LOCALIZED in states
    yield at_least('another building: not in this map, within 20 m', 100.0 * said / count, 95.0, '%')
    yield Row('another building: not in this map, after 20 m', f'{100.0 * said_at_last / count:.4g} %')
    yield at_most('another building: sure at any time', 100.0 * sure / count, 0.0, '%')


def _steps(finder: GlobalLocalization, looks: Iterable[Look], way_m: float) -> Iterator[tuple[Look, Result]]:
    """Each look of so much way, and what came of it."""
    way, last = 0.0, None
    for look in looks:
        way += 0.0 if last is None else float(np.hypot(*(look.T_world_base - last)[:2]))
        last = look.T_world_base
        if way > way_m:
            return
        yield look, finder.step(look.scan, look.T_odom_base)


def _coarse_map(world: World) -> Map:
    """The map of a finer world in cells of 10 cm."""
    k = round(0.1 / world.frame.resolution)
    rows, cols = (size // k * k for size in world.occupied.shape)
    cells = world.occupied[:rows, :cols].reshape(rows // k, k, cols // k, k).max(axis=(1, 3))
    frame = GridFrame(world.frame.origin_x, world.frame.origin_y, 0.1)
    patch = GridPatch(frame, np.where(cells != 0, np.int8(100), np.int8(0)))
    return Map(patch, build(patch, None, TopologyConfig()))


def _twin_rooms() -> tuple[World, NDArray[np.bool_]]:
    """Two rooms that are the same, doors shut, a number of cells apart that is not whole; the robot is in the first."""
    cells = np.ones((300, 700), dtype=np.uint8)
    for left in (20, 367):
        cells[20:270, left : left + 300] = 0
        cells[110:140, left + 60 : left + 110] = 1
        cells[210:270, left + 200 : left + 240] = 1
    within = np.zeros(cells.shape, dtype=np.bool_)
    within[25:265, 25:315] = True
    return World('twin rooms', cells, GridFrame(0.0, 0.0, 0.02), np.zeros(3)), within


def _turned_floor() -> tuple[World, NDArray[np.bool_]]:
    """A floor that looks the same when it is turned by 180 degrees about its middle."""
    cells = np.zeros((440, 893), dtype=np.uint8)
    cells[:5] = cells[-5:] = 1
    cells[:, :5] = cells[:, -5:] = 1
    walls = ((100, 0, 105, 300), (250, 200, 255, 420), (0, 400, 180, 405), (300, 80, 340, 140), (30, 520, 60, 600))
    for top, left, bottom, right in walls:
        cells[top:bottom, left:right] = 1
    cells |= cells[::-1, ::-1]
    return World('turned floor', cells, GridFrame(-0.013, -0.027, 0.02), np.zeros(3)), np.ones(cells.shape, np.bool_)


def run(folder: Path, quick: bool) -> Iterator[Row]:
    """All of it; quick: fewer starts and worlds."""
    yield from _step_times(folder, quick)
    yield from _laboratory(quick)
    yield from _thinning_or_voronoi(quick)
    yield from _ambiguous(quick)
    yield from _elsewhere(folder, quick)
    yield from _buildings(folder, quick)
