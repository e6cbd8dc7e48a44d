"""Drives of a lost robot: scans and odometry of a simulated one that goes to random places."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.follower import Follower, FollowerConfig
from thinmap_ros.core.planning.wavefront import WavefrontConfig, plan
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, pose
from thinmap_ros.sim.lms200 import Lms200Config
from thinmap_ros.sim.pioneer import PioneerConfig
from thinmap_ros.sim.runner import STEP_NS, Simulation
from thinmap_ros.sim.world import World

_MARGIN_M = 0.1
_NEAREST_GOAL_M = 2.0
_SPEED_M_S = 0.5
_GIVE_UP_STEPS = 4000


@dataclass(frozen=True, eq=False)
class Look:
    """What the robot has at a scan: scan, odometry pose (3,), and where it truly is (3,)."""

    scan: Scan
    T_odom_base: Array
    T_world_base: Array


def random_start(world: World, rng: np.random.Generator, within: np.ndarray | None = None) -> Array:
    """A pose (3,) at which the robot fits, anywhere in the world or in some of its cells (H, W)."""
    room = world.wall_distance_m > PioneerConfig().radius_m + _MARGIN_M
    cells = np.argwhere(room if within is None else room & within)
    at = world.frame.centres_of(cells[rng.integers(len(cells))][None])[0]
    return pose(float(at[0]), float(at[1]), float(rng.uniform(-np.pi, np.pi)))


def random_drive(
    world: World, start: Array, seed: int, within: np.ndarray | None = None, laser: Lms200Config | None = None
) -> Iterator[Look]:
    """Look after look of a robot that drives from a start to random places, one after the other, without end.

    within (H, W): cells of the world in which these places lie; all, where it is not given.
    """
    rng = np.random.default_rng(seed)
    simulation = Simulation(world, start, PioneerConfig(), laser or Lms200Config(), seed)
    patch = GridPatch(world.frame, np.where(world.occupied != 0, np.int8(100), np.int8(0)))
    radius = PioneerConfig().radius_m + _MARGIN_M
    follower = Follower(FollowerConfig(max_speed_m_s=_SPEED_M_S))
    moment = simulation.sense()
    while True:
        way = _random_way(world, patch, simulation.robot.T_world_base, rng, radius, within)
        for _ in range(_GIVE_UP_STEPS):
            T = simulation.robot.T_world_base
            if moment.scan is not None:
                yield Look(moment.scan, moment.T_odom_base, T)
            if np.hypot(*(way[-1] - T[:2])) < 0.3:
                break
            moment = simulation.step(*follower.command(T, way, STEP_NS / 1e9))


def _random_way(
    world: World, patch: GridPatch, T: Array, rng: np.random.Generator, radius_m: float, within: np.ndarray | None
) -> Array:
    """Path (K, 2) to a random place that can be reached."""
    xy = (float(T[0]), float(T[1]))
    while True:
        goal = random_start(world, rng, within)
        if np.hypot(*(goal[:2] - T[:2])) < _NEAREST_GOAL_M:
            continue
        way = plan(patch, xy, (float(goal[0]), float(goal[1])), WavefrontConfig(robot_radius_m=radius_m))
        if way is not None:
            return way
