"""Drives of a simulated robot along given ways: scan, odometry and truth of each scan, from one seed."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.follower import Follower, FollowerConfig
from thinmap_ros.core.planning.wavefront import WavefrontConfig, plan
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.runner import STEP_NS, Simulation
from thinmap_ros.sim.world import World

MARGIN_M = 0.1  # between the body and what is solid, where ways are planned
_ARRIVED_M = 0.3
_SPACING_M = 0.05
_PATIENCE = 5.0  # times what a way takes at full speed
_LEAST_S = 60.0


@dataclass(frozen=True, eq=False)
class Look:
    """What the robot has at a scan: scan, odometry pose (3,), and where it truly is (3,)."""

    scan: Scan
    T_odom_base: Array
    T_world_base: Array


def drive(simulation: Simulation, ways: Iterable[Array], speed_m_s: float) -> Iterator[Look]:
    """Look after look of a robot that follows ways (K, 2), m, world frame, one after the other.

    A way that takes much too long is given up for the next.
    """
    follower = Follower(FollowerConfig(max_speed_m_s=speed_m_s))
    moment = simulation.sense()
    if moment.scan is not None:
        yield Look(moment.scan, moment.T_odom_base, simulation.robot.T_world_base)
    for way in ways:
        length_m = float(np.hypot(*np.diff(way, axis=0).T).sum())
        for _ in range(round(1e9 / STEP_NS * (_LEAST_S + _PATIENCE * length_m / speed_m_s))):
            T = simulation.robot.T_world_base
            if np.hypot(*(way[-1] - T[:2])) < _ARRIVED_M:
                break
            moment = simulation.step(*follower.command(T, way, STEP_NS / 1e9))
            if moment.scan is not None:
                yield Look(moment.scan, moment.T_odom_base, simulation.robot.T_world_base)


def ways_along(world: World, places: Array, radius_m: float) -> Iterator[Array]:
    """Ways (K, 2) from the start of a world to places (N, 2), one after the other: straight where there is room.

    Raises InputError where a place cannot be reached.
    """
    reach = WavefrontConfig(robot_radius_m=radius_m + MARGIN_M)
    patch = GridPatch(world.frame, np.where(world.occupied != 0, np.int8(100), np.int8(0)))
    at = world.start[:2]
    for place in places:
        way = _straight(at, place)
        if not _is_clear(world, way, reach.robot_radius_m):
            planned = plan(patch, (float(at[0]), float(at[1])), (float(place[0]), float(place[1])), reach)
            if planned is None:
                raise InputError(f'{world.name}: tour: {place.tolist()}: no way from {at.tolist()}')
            way = planned
        yield way
        at = place


def _straight(a: Array, b: Array) -> Array:
    """Points (K, 2) from one place to another, as dense as those that the planner gives."""
    count = 2 + math.ceil(float(np.hypot(*(b - a))) / _SPACING_M)
    return np.asarray(a + np.linspace(0.0, 1.0, count)[:, None] * (b - a))


def _is_clear(world: World, way: Array, radius_m: float) -> bool:
    """Whether a disc can go along points (K, 2)."""
    cells = world.frame.cells_of(way)
    if (cells < 0).any() or (cells >= world.occupied.shape).any():
        return False
    return bool((world.wall_distance_m[cells[:, 0], cells[:, 1]] > radius_m).all())
