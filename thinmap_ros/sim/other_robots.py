"""Several robots in one world: each sees the others with its laser, and touches them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.moving_obstacles import range_to_disc
from thinmap_ros.sim.robot import DifferentialDriveRobot, RobotConfig
from thinmap_ros.sim.simulation import Simulation
from thinmap_ros.sim.world import World

MAX_ROBOTS = 9
START_SPACING_M = 0.8
_RINGS = 3
_DIRECTIONS = 16
_LINE_STEP_M = 0.05


@dataclass(frozen=True, eq=False)
class SharedWorld(World):
    """A world as one robot meets it: the other robots are obstacles, discs of their radius."""

    others: list[DifferentialDriveRobot] = field(default_factory=list)

    @staticmethod
    def of(world: World) -> 'SharedWorld':
        """The same world, for one robot; the others are added when they exist."""
        return SharedWorld(
            world.name, world.occupied, world.frame, world.start, world.glass, world.moving
        )

    def moving_ranges(
        self, seconds: float, T_world_laser: Array, angles: Array, reach_m: float
    ) -> Array | None:
        """As that of World, with the other robots."""
        nearest = super().moving_ranges(seconds, T_world_laser, angles, reach_m)
        beams = np.column_stack([np.cos(angles), np.sin(angles)])
        for robot in self.others:
            away = robot.T_world_base[:2] - T_world_laser[:2]
            radius_m = robot.config.radius_m
            if math.hypot(*away) < reach_m + radius_m:
                ranges = range_to_disc(away, radius_m, beams)
                nearest = ranges if nearest is None else np.minimum(nearest, ranges)
        return nearest

    def is_clear(self, x: float, y: float, radius_m: float) -> bool:
        """Whether a disc with its centre in the world touches no obstacle and no other robot."""
        return super().is_clear(x, y, radius_m) and all(
            math.dist((x, y), robot.T_world_base[:2]) >= radius_m + robot.config.radius_m
            for robot in self.others
        )


def simulations_in(
    world: World,
    starts: Sequence[Array],
    robot: RobotConfig,
    laser: LaserScannerConfig,
    seed: int,
) -> list[Simulation]:
    """A simulation for each robot, from its start (3,), in one world.

    seed: of the first robot; each further one has the next.
    Raises InputError where a robot does not fit, in the world or beside those before it.
    """
    simulations: list[Simulation] = []
    worlds: list[SharedWorld] = []
    for number, start in enumerate(starts):
        own_world = SharedWorld.of(world)
        own_world.others.extend(other.robot for other in simulations)
        simulation = Simulation(own_world, start, robot, laser, seed + number)
        for other_world in worlds:
            other_world.others.append(simulation.robot)
        worlds.append(own_world)
        simulations.append(simulation)
    return simulations


def starts_in(
    world: World, start: Array, listed: Array, count: int, radius_m: float
) -> list[Array]:
    """Poses (3,) of robots of a radius: the first of a list (N, 3), or side by side.

    start (3,): of the robot that starts first side by side.
    Raises InputError where the list is shorter and there is no room at the start.
    """
    if len(listed) >= count > 1:
        return list(listed[:count])
    return starts_side_by_side(world, start, count, radius_m)


def starts_side_by_side(world: World, start: Array, count: int, radius_m: float) -> list[Array]:
    """Poses (3,) of robots of a radius around a start (3,), which is the first of them.

    They are START_SPACING_M apart, and nothing is between them and the start. Raises InputError
    where there is no room.
    """
    starts = [start]
    for ring in range(1, _RINGS + 1):
        for k in range(_DIRECTIONS):
            if len(starts) == count:
                return starts
            bearing = float(start[2]) + 0.5 * math.pi + 2.0 * math.pi * k / _DIRECTIONS
            step = ring * START_SPACING_M
            x = float(start[0]) + step * math.cos(bearing)
            y = float(start[1]) + step * math.sin(bearing)
            is_apart = all(
                math.dist((x, y), other[:2]) > START_SPACING_M - 1e-6 for other in starts
            )
            if is_apart and _is_clear_line(world, start, (x, y), radius_m):
                starts.append(se2.pose(x, y, float(start[2])))
    if len(starts) < count:
        raise InputError(
            f'{world.name}: start {start[:2].tolist()}: expected room for {count} robots '
            f'{START_SPACING_M} m apart, found room for {len(starts)}'
        )
    return starts


def _is_clear_line(world: World, start: Array, end: tuple[float, float], radius_m: float) -> bool:
    steps = math.ceil(math.dist(start[:2], end) / _LINE_STEP_M)
    x = np.linspace(float(start[0]), end[0], steps + 1).tolist()
    y = np.linspace(float(start[1]), end[1], steps + 1).tolist()
    return all(world.is_clear(*at, radius_m) for at in zip(x, y, strict=True))
