"""Drives through generated buildings: to parts that are near, one by one, and back to the start."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.buildings import Building, generate_building
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.wavefront import WavefrontConfig, plan
from thinmap_ros.core.se2 import Array, transform_points
from thinmap_ros.sim.drives import MARGIN_M, DriveConfig, DriveSample, drive, world_to_grid
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS, RobotConfig
from thinmap_ros.sim.simulation import Simulation
from thinmap_ros.sim.world import World

_SPEED_M_S = 0.7
_LENGTH_M = 250.0
_NEAR_M = 40.0  # a part that is so near may be the next
_DETOUR_M = 25.0  # maximum detour of paths
_CHOICES = 5  # the next is one of so many nearest that were not visited
_MAX_GOALS = 60
_PIECE_M = 16.0  # of a hall: what a laser of 8 m sees from its middle
_ODOMETRY = (
    'scale_sigma',
    'turn_scale_sigma',
    'drift_sigma_rad_m',
    'distance_noise',
    'turn_noise',
    'turn_noise_driving',
)


def samples(seed: int, robot: str, noise: float) -> Iterator[DriveSample]:
    """Yield the samples of a drive of some 250 m that ends at its start."""
    made = generate_building(seed)
    body = noisy(PRESETS[robot], noise)
    simulation = Simulation(made.world, _start(made, body), body, LaserScannerConfig(), seed)
    legs = paths(made, simulation.robot.T_world_base, body, seed)
    return drive(simulation, legs, DriveConfig(_SPEED_M_S))


def noisy(robot: RobotConfig, noise: float) -> RobotConfig:
    """A robot whose odometry errs so many times as much."""
    return replace(robot, **{name: noise * getattr(robot, name) for name in _ODOMETRY})


def paths(made: Building, start: Array, robot: RobotConfig, seed: int) -> Iterator[Array]:
    """Paths (K, 2), m, of a drive; each starts at the end of the previous one."""
    rng = np.random.default_rng(seed)
    patch = world_to_grid(made.world)
    goals = _goals(made)
    left = np.ones(len(goals), dtype=np.bool_)
    at = start[:2]
    driven = []
    length_m = 0.0
    for _ in range(_MAX_GOALS):
        away = np.where(left, np.hypot(*(goals - at).T), np.inf)
        nearest = np.argsort(away)[:_CHOICES]
        nearest = nearest[away[nearest] < _NEAR_M]
        if length_m > 0.5 * _LENGTH_M or not len(nearest):
            break
        chosen = int(rng.choice(nearest))
        left[chosen] = False
        path = _path(patch, at, goals[chosen], robot.radius_m)
        if path is not None:
            driven.append(path)
            at = path[-1]
            length_m += float(np.hypot(*np.diff(path, axis=0).T).sum())
            yield path
    # Home the way it came, but for the detours: known ground, and a loop where there is one.
    for path in reversed(driven):
        back = _path(patch, at, path[0], robot.radius_m)
        if back is not None:
            at = back[-1]
            yield back


def _goals(made: Building) -> Array:
    """Middle of each part, or of each piece of one that is wider than the laser (N, 2), m."""
    found = []
    for wing in made.wings:
        middles = [
            (x, y)
            for part in wing.plan.parts
            for x in _middles(part.x0, part.x1)
            for y in _middles(part.y0, part.y1)
        ]
        found.append(transform_points(wing.T_world_wing, np.array(middles)))
    return np.concatenate(found)


def _middles(low: float, high: float) -> Array:
    """Middles of equal pieces, of _PIECE_M at the most, of an interval."""
    ends = np.linspace(low, high, 1 + math.ceil((high - low) / _PIECE_M))
    return np.asarray(0.5 * (ends[1:] + ends[:-1]))


def _path(patch: GridPatch, a: Array, b: Array, radius_m: float) -> Array | None:
    """A path from a to b in the part of the map around both, or None."""
    frame = patch.frame
    ends = np.stack([a, b])
    low = frame.cells_of(ends.min(axis=0)[None] - _DETOUR_M)[0].clip(0)
    high = frame.cells_of(ends.max(axis=0)[None] + _DETOUR_M)[0] + 1
    resolution = frame.resolution
    corner = GridFrame(
        frame.origin_x + resolution * low[1], frame.origin_y + resolution * low[0], resolution
    )
    near = GridPatch(corner, patch.cells[low[0] : high[0], low[1] : high[1]])
    config = WavefrontConfig(robot_radius_m=radius_m + MARGIN_M)
    return plan(near, (float(a[0]), float(a[1])), (float(b[0]), float(b[1])), config)


def _start(made: Building, robot: RobotConfig) -> Array:
    """The building's start, or the nearest place where a robot of this size fits."""
    world: World = made.world
    if world.is_clear(float(world.start[0]), float(world.start[1]), robot.radius_m + MARGIN_M):
        return world.start
    room = world.frame.centres_of(np.argwhere(world.distance_to_wall_m > robot.radius_m + MARGIN_M))
    place = room[np.argmin(np.hypot(*(room - world.start[:2]).T))]
    return np.array([place[0], place[1], world.start[2]])
