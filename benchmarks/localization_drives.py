"""Drives of a lost robot: scans and odometry of a simulated one that goes to random places."""

from collections.abc import Iterator

import numpy as np

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.wavefront import WavefrontConfig, plan
from thinmap_ros.core.se2 import Array, pose
from thinmap_ros.sim.lms200 import Lms200Config
from thinmap_ros.sim.pioneer import PioneerConfig
from thinmap_ros.sim.runner import Simulation
from thinmap_ros.sim.tours import MARGIN_M, Look, drive
from thinmap_ros.sim.world import World

_NEAREST_GOAL_M = 2.0
_SPEED_M_S = 0.5


def random_start(world: World, rng: np.random.Generator, within: np.ndarray | None = None) -> Array:
    """A pose (3,) at which the robot fits, anywhere in the world or in some of its cells (H, W)."""
    room = world.wall_distance_m > PioneerConfig().radius_m + MARGIN_M
    cells = np.argwhere(room if within is None else room & within)
    at = world.frame.centres_of(cells[rng.integers(len(cells))][None])[0]
    return pose(float(at[0]), float(at[1]), float(rng.uniform(-np.pi, np.pi)))


def random_drive(
    world: World, start: Array, seed: int, within: np.ndarray | None = None, laser: Lms200Config | None = None
) -> Iterator[Look]:
    """Look after look of a robot that drives from a start to random places, one after the other, without end.

    within (H, W): cells of the world in which these places lie; all, where it is not given.
    """
    simulation = Simulation(world, start, PioneerConfig(), laser or Lms200Config(), seed)
    return drive(simulation, _random_ways(simulation, np.random.default_rng(seed), within), _SPEED_M_S)


def _random_ways(simulation: Simulation, rng: np.random.Generator, within: np.ndarray | None) -> Iterator[Array]:
    """Paths (K, 2) from where the robot is to random places that can be reached."""
    world = simulation.world
    patch = GridPatch(world.frame, np.where(world.occupied != 0, np.int8(100), np.int8(0)))
    config = WavefrontConfig(robot_radius_m=PioneerConfig().radius_m + MARGIN_M)
    while True:
        T, goal = simulation.robot.T_world_base, random_start(world, rng, within)
        if np.hypot(*(goal[:2] - T[:2])) < _NEAREST_GOAL_M:
            continue
        way = plan(patch, (float(T[0]), float(T[1])), (float(goal[0]), float(goal[1])), config)
        if way is not None:
            yield way
