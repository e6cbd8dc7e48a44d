"""The drives behind the experiments: simulated from a seed, or read from a recorded bag."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thinmap_ros.closed_loop.loop import make_loop, no_progress
from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.strategy import Decision
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_tour, read_world
from thinmap_ros.logs import decode
from thinmap_ros.logs.log import OdometryEvent
from thinmap_ros.logs.readers.bag import Bag, BagLog
from thinmap_ros.sim.coverage import robot_observable_cells
from thinmap_ros.sim.drives import DriveConfig, DriveSample, drive, random_drive, tour_paths
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import Simulation
from thinmap_ros.sim.world import World, inside_of

TRUTH_TOPIC = '/ground_truth'


@dataclass(frozen=True)
class _Setup:
    """Speed and length of the simulated drives.

    speed_m_s: of all three papers. scans_per_stop: in each direction. lost_steps: of a lost robot.
    scans_per_lost_step: at 0.5 m/s and 5 Hz, up to 0.3 m.
    """

    speed_m_s: float
    scans_per_stop: int
    lost_steps: int
    scans_per_lost_step: int
    exploration_limit_s: float


SETUP = _Setup(
    speed_m_s=0.2,
    scans_per_stop=4,
    lost_steps=15,
    scans_per_lost_step=3,
    exploration_limit_s=1000.0,
)


def world_of(name: str) -> World:
    """One of the papers' worlds."""
    return World.from_patch(*read_world(package_data.world_path(name)))


def tour_of(name: str) -> Array:
    """Places (N, 2) of a world's tour."""
    return read_tour(package_data.world_path(name))


@dataclass(frozen=True)
class Recipe:
    """A drive: its world, the robot, how it goes in words, and what makes it from a seed.

    localized: a recording's poses are those of the localizer, else the true ones.
    """

    world: str
    robot: str
    how: str
    samples: Callable[['Recipe', int], Iterator[DriveSample]]
    localized: bool = False


def _tour(recipe: Recipe, seed: int) -> Iterator[DriveSample]:
    world = world_of(recipe.world)
    robot = PRESETS[recipe.robot]
    simulation = Simulation(world, world.start, robot, LaserScannerConfig(), seed)
    paths = tour_paths(world, tour_of(recipe.world), robot.radius_m)
    return drive(simulation, paths, DriveConfig(SETUP.speed_m_s))


def _stops(recipe: Recipe, seed: int) -> Iterator[DriveSample]:
    """Put down by hand at each stop, looking two ways: the papers' robot had no odometry either."""
    world = world_of(recipe.world)
    laser = LaserScanner(LaserScannerConfig(), seed)
    stamp_ns = 0
    for x, y in tour_of(recipe.world):
        for heading in (0.0, np.pi):
            for _ in range(SETUP.scans_per_stop):
                T = se2.pose(float(x), float(y), heading)
                yield DriveSample(laser.scan(world, T, stamp_ns), T, T)
                stamp_ns += 200_000_000


def _lost(recipe: Recipe, seed: int) -> Iterator[DriveSample]:
    """From the paper's place to random ones, for as long as the localization lasts."""
    world = world_of(recipe.world)
    samples = random_drive(world, world.start, seed)
    return (next(samples) for _ in range(1 + SETUP.lost_steps * SETUP.scans_per_lost_step))


def _exploration(recipe: Recipe, seed: int) -> Iterator[DriveSample]:
    world = world_of(recipe.world)
    options = Options('paper', seed=seed, robot=recipe.robot, speed_m_s=SETUP.speed_m_s)
    loop = make_loop(world, [world.start], options)
    (robot,) = loop.robots
    samples = []

    def watch(decision: Decision, T_map_base: Array) -> None:
        moment = robot.moment
        T_world_base = robot.simulation.robot.T_world_base
        samples.append(DriveSample(moment.scans[0], moment.T_odom_base, T_world_base))

    robot.watch = watch
    goal = robot_observable_cells(
        world, world.start, PRESETS[recipe.robot], LaserScannerConfig().range_max_m
    )
    loop.run(goal, SETUP.exploration_limit_s, no_progress)
    return iter(samples)


RECIPES = {
    'lab_stops': Recipe(
        'lab', '2dx', 'put down by hand at twelve stops, four scans to either side at each', _stops
    ),
    'lab_lost': Recipe('lab', '2dx', 'from (2 m, 2 m, 270 deg) to random places at 0.5 m/s', _lost),
    'dead_end': Recipe('dead_end', '2dx', 'along the tour of the world at 0.2 m/s', _tour),
    'joined_hallways': Recipe(
        'joined_hallways', '2dx', 'along the tour of the world at 0.2 m/s', _tour
    ),
    'room_10x10': Recipe(
        'room_10x10', '2dx', 'explored by position probability at up to 0.2 m/s', _exploration
    ),
    'office': Recipe(
        'office', '3at', 'along the tour of the world at 0.2 m/s', _tour, localized=True
    ),
    'floor_40x10': Recipe(
        'floor_40x10', '3at', 'along the tour of the world at 0.2 m/s', _tour, localized=True
    ),
    'floor_70x10': Recipe(
        'floor_70x10', '3at', 'along the tour of the world at 0.2 m/s', _tour, localized=True
    ),
}


@dataclass(frozen=True)
class Source:
    """Where drives come from: a seed, or a folder of bags.

    quick: experiments are made small, as for a test.
    """

    seed: int = 0
    bags: Path | None = None
    quick: bool = False

    def samples(self, name: str) -> Iterator[DriveSample]:
        """A drive by its name in RECIPES."""
        if self.bags is None:
            recipe = RECIPES[name]
            return recipe.samples(recipe, self.seed)
        return samples_of_bag(self.bags / f'{name}.mcap')


def samples_of_bag(path: Path) -> Iterator[DriveSample]:
    """The drive that a bag holds.

    Raises InputError where a scan has no odometry or ground truth of its stamp.
    """
    bag = Bag(path)
    truth = {}
    for message in bag.messages({TRUTH_TOPIC}):
        decoded = bag.decode(message)
        truth[decode.stamp_ns(decoded)] = decode.pose(decoded.pose)
    T_odom_base: dict[int, Array] = {}
    for event in BagLog(path).events():
        if isinstance(event, OdometryEvent):
            T_odom_base[event.stamp_ns] = event.T_odom_base
            continue
        stamp_ns = event.scan.stamp_ns
        if stamp_ns not in T_odom_base or stamp_ns not in truth:
            raise InputError(
                f'{path}: scan at {stamp_ns} ns: expected /odom and {TRUTH_TOPIC} of the same stamp'
            )
        yield DriveSample(event.scan, T_odom_base[stamp_ns], truth[stamp_ns])


CELL_M = PAPER_GRID.resolution_m


def grid_of(samples: Iterable[DriveSample]) -> OccupancyGrid:
    """Grid of scans at their true poses."""
    grid = OccupancyGrid(PAPER_GRID)
    for sample in samples:
        grid.add_scan(sample.scan, sample.T_world_base)
    return grid


def patch_at_rest(name: str) -> GridPatch:
    """The map of a world as it is: what the start is joined with is free, 0.1 m a cell."""
    return patch_of_world(world_of(name))


def patch_of_world(world: World) -> GridPatch:
    """0.1 m cells: free where wholly so and joined to the start, unknown outside, else occupied."""
    low = np.floor(np.array([world.frame.origin_x, world.frame.origin_y]) / CELL_M - 1e-6)
    rows, cols = world.occupied.shape
    cells = np.floor(world.frame.centres_of(np.array([[rows - 1, cols - 1]]))[0] / CELL_M) - low + 1
    frame = GridFrame(float(low[0]) * CELL_M, float(low[1]) * CELL_M, CELL_M)
    states = np.full((int(cells[1]), int(cells[0])), -1, dtype=np.int8)
    free = frame.cells_of(world.frame.centres_of(np.argwhere(inside_of(world))))
    solid = frame.cells_of(world.frame.centres_of(np.argwhere(world.occupied)))
    states[free[:, 0], free[:, 1]] = 0
    states[solid[:, 0], solid[:, 1]] = 100
    return GridPatch(frame, states)
