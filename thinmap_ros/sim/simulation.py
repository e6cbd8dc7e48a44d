"""Simulation of a robot with its lasers in a world, in fixed time steps."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig
from thinmap_ros.sim.robot import DifferentialDriveRobot, RobotConfig
from thinmap_ros.sim.world import World

STEP_NS = 50_000_000


@dataclass(frozen=True, eq=False)
class SensorReadings:
    """Sensor readings after a step: odometry at stamp_ns, and a scan of each laser that is due."""

    stamp_ns: int
    T_odom_base: Array
    scans: tuple[Scan, ...]


class Simulation:
    """Steps of 50 ms: odometry at 20 Hz, and scans at the rate of the lasers.

    Several lasers begin one after the other within a period, as they are not synchronized. The seed
    determines all noise.

    start (3,): initial pose of the robot in the world; its odometry is zero there. Raises
    InputError if it does not fit.
    """

    def __init__(
        self, world: World, start: Array, robot: RobotConfig, laser: LaserScannerConfig, seed: int
    ) -> None:
        _check_fits(world, start, robot)
        self.world = world
        mounts = laser.mounts()
        seeds = _seeds(seed, len(mounts))
        self.robot = DifferentialDriveRobot(robot, world, start, seeds[0])
        self.lasers = [
            LaserScanner(laser, own_seed, mount)
            for own_seed, mount in zip(seeds[1:], mounts, strict=True)
        ]
        self._scan_period_ns = round(1e9 / laser.scan_rate_hz)
        self._next_scan_ns = [self._scan_period_ns * k // len(mounts) for k in range(len(mounts))]
        self.stamp_ns = 0

    def teleport(self, T_world_base: Array) -> None:
        """Teleport the robot to a pose (3,); its odometry does not change.

        Raises InputError if it does not fit.
        """
        _check_fits(self.world, T_world_base, self.robot.config)
        self.robot.T_world_base = np.array(T_world_base, dtype=np.float64)
        self.robot.v = 0.0
        self.robot.w = 0.0

    def read_sensors(self) -> SensorReadings:
        """Return the present sensor readings; each scan is returned once."""
        scans = []
        for k, laser in enumerate(self.lasers):
            if self.stamp_ns >= self._next_scan_ns[k]:
                scans.append(laser.scan(self.world, self.robot.T_world_base, self.stamp_ns))
                self._next_scan_ns[k] += self._scan_period_ns
        return SensorReadings(self.stamp_ns, self.robot.T_odom_base, tuple(scans))

    def step(self, v: float, w: float) -> SensorReadings:
        """Drive for one step, as `move`; returns the sensor readings after it."""
        self.move(v, w)
        return self.read_sensors()

    def move(self, v: float, w: float) -> None:
        """Drive for one step with a commanded speed (m/s) and turn rate (rad/s)."""
        self.robot.step(v, w, STEP_NS / 1e9)
        self.stamp_ns += STEP_NS


def odometry_seed(seed: int) -> int:
    """Seed of the wheel odometry in a simulation with a seed."""
    return _seeds(seed, 0)[0]


def _seeds(seed: int, lasers: int) -> list[int]:
    """Independent seeds of the wheel odometry and of each laser."""
    return [int(word) for word in np.random.SeedSequence(seed).generate_state(1 + lasers)]


def _check_fits(world: World, T_world_base: Array, robot: RobotConfig) -> None:
    if not world.is_clear(float(T_world_base[0]), float(T_world_base[1]), robot.radius_m):
        raise InputError(
            f'{world.name}: start {T_world_base[:2].tolist()}: expected a place where a robot of '
            f'{robot.radius_m} m radius touches nothing'
        )
