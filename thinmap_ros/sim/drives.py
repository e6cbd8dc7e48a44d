"""Drives of a simulated robot on given or random paths: scans, odometry and ground truth."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.path_follower import PathFollower, PathFollowerConfig
from thinmap_ros.core.planning.wavefront import WavefrontConfig, plan
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, Mask, path_length, pose
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import RobotConfig
from thinmap_ros.sim.simulation import STEP_NS, SensorReadings, Simulation
from thinmap_ros.sim.world import World

MARGIN_M = 0.1  # minimum distance of planned paths from obstacles
_SPACING_M = 0.05


@dataclass(frozen=True)
class DriveConfig:
    """Speed of a drive, and when a path has been driven or is aborted."""

    speed_m_s: float = 0.5
    goal_tolerance_m: float = 0.3
    min_timeout_s: float = 60.0
    timeout_factor: float = 5.0  # times the duration at full speed, added to that
    min_goal_distance_m: float = 2.0  # of a random drive


@dataclass(frozen=True, eq=False)
class DriveSample:
    """Sample of a drive: scan, odometry pose (3,) and true pose (3,)."""

    scan: Scan
    T_odom_base: Array
    T_world_base: Array


def drive(
    simulation: Simulation, paths: Iterable[Array], config: DriveConfig
) -> Iterator[DriveSample]:
    """Yield the samples of a drive along paths (K, 2), m, world frame, one after the other.

    A path that takes much too long is aborted.
    """
    follower = PathFollower(PathFollowerConfig(max_speed_m_s=config.speed_m_s))
    yield from _samples(simulation, simulation.read_sensors())
    for path in paths:
        duration_s = config.timeout_factor * path_length(path) / config.speed_m_s
        for _ in range(round(1e9 / STEP_NS * (config.min_timeout_s + duration_s))):
            T = simulation.robot.T_world_base
            if np.hypot(*(path[-1] - T[:2])) < config.goal_tolerance_m:
                break
            moment = simulation.step(*follower.command(T, path, STEP_NS / 1e9))
            yield from _samples(simulation, moment)


def _samples(simulation: Simulation, moment: SensorReadings) -> Iterator[DriveSample]:
    for scan in moment.scans:
        yield DriveSample(scan, moment.T_odom_base, simulation.robot.T_world_base)


def world_to_grid(world: World) -> GridPatch:
    """Complete map of a world."""
    return GridPatch(world.frame, np.where(world.occupied != 0, np.int8(100), np.int8(0)))


def tour_paths(world: World, places: Array, radius_m: float) -> Iterator[Array]:
    """Paths (K, 2) from the start of a world to places (N, 2), in order, straight where possible.

    Raises InputError if a place is unreachable.
    """
    reach = WavefrontConfig(robot_radius_m=radius_m + MARGIN_M)
    patch = world_to_grid(world)
    at = world.start[:2]
    for place in places:
        path = _straight(at, place)
        if not _is_clear(world, path, reach.robot_radius_m):
            planned = plan(
                patch, (float(at[0]), float(at[1])), (float(place[0]), float(place[1])), reach
            )
            if planned is None:
                raise InputError(
                    f'{world.name}: tour: {place.tolist()}: no path from {at.tolist()}'
                )
            path = planned
        yield path
        at = place


def _straight(a: Array, b: Array) -> Array:
    """Points (K, 2) of a straight line, as dense as those of the planner."""
    count = 2 + math.ceil(float(np.hypot(*(b - a))) / _SPACING_M)
    return np.asarray(a + np.linspace(0.0, 1.0, count)[:, None] * (b - a))


def _is_clear(world: World, path: Array, radius_m: float) -> bool:
    """Whether a disc can move along points (K, 2) without collision."""
    cells = world.frame.cells_of(path)
    if (cells < 0).any() or (cells >= world.occupied.shape).any():
        return False
    return bool((world.distance_to_wall_m[cells[:, 0], cells[:, 1]] > radius_m).all())


def random_start(world: World, rng: np.random.Generator, within: Mask | None = None) -> Array:
    """A random collision-free pose (3,), anywhere in the world or in some of its cells (H, W)."""
    room = world.distance_to_wall_m > RobotConfig().radius_m + MARGIN_M
    cells = np.argwhere(room if within is None else room & within)
    at = world.frame.centres_of(cells[rng.integers(len(cells))][None])[0]
    return pose(float(at[0]), float(at[1]), float(rng.uniform(-np.pi, np.pi)))


def random_drive(
    world: World,
    start: Array,
    seed: int,
    within: Mask | None = None,
    laser: LaserScannerConfig | None = None,
) -> Iterator[DriveSample]:
    """Yield the samples of an endless drive from a start to random places.

    within (H, W): cells of the world for these places; None: all.
    """
    simulation = Simulation(world, start, RobotConfig(), laser or LaserScannerConfig(), seed)
    config = DriveConfig()
    paths = _random_paths(simulation, np.random.default_rng(seed), within, config)
    return drive(simulation, paths, config)


def _random_paths(
    simulation: Simulation,
    rng: np.random.Generator,
    within: Mask | None,
    config: DriveConfig,
) -> Iterator[Array]:
    """Paths (K, 2) from the robot to random reachable places."""
    world = simulation.world
    patch = world_to_grid(world)
    planner = WavefrontConfig(robot_radius_m=RobotConfig().radius_m + MARGIN_M)
    while True:
        T = simulation.robot.T_world_base
        goal = random_start(world, rng, within)
        if np.hypot(*(goal[:2] - T[:2])) < config.min_goal_distance_m:
            continue
        path = plan(patch, (float(T[0]), float(T[1])), (float(goal[0]), float(goal[1])), planner)
        if path is not None:
            yield path
