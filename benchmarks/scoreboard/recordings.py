"""Drives that are recorded once and replayed with other odometry noise."""

import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.files.safe import atomic_write
from thinmap_ros.sim.drives import DriveSample
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import RobotConfig, WheelOdometry
from thinmap_ros.sim.simulation import STEP_NS, SensorReadings, Simulation, odometry_seed
from thinmap_ros.sim.world import World

_STEP_S = STEP_NS / 1e9


@dataclass(frozen=True, eq=False)
class Recording:
    """Scans of a simulated drive, and what is exact about it.

    stamps_ns (N,); ranges_m (N, B); T_world_base (N, 3): true pose at each scan; steps (M, 2):
    exact distance (m) and turn (rad) of each step of the simulation; fan (4,): first angle and
    increment (rad), least and largest range (m); T_base_laser (3,).
    """

    stamps_ns: NDArray[np.int64]
    ranges_m: NDArray[np.float32]
    T_world_base: Array
    steps: Array
    fan: Array
    T_base_laser: Array

    def replay(self, robot: RobotConfig, seed: int) -> Iterator[DriveSample]:
        """Yield each scan with its true pose and the odometry of a simulation with this seed."""
        odometry = WheelOdometry(robot, odometry_seed(seed))
        fan: tuple[float, float, float, float] = tuple(self.fan.tolist())
        driven = 0
        for k, stamp_ns in enumerate(self.stamps_ns.tolist()):
            for distance_m, turn_rad in self.steps[driven : stamp_ns // STEP_NS].tolist():
                odometry.add_step(distance_m, turn_rad)
            driven = stamp_ns // STEP_NS
            scan = Scan.create(stamp_ns, self.ranges_m[k], *fan, self.T_base_laser)
            yield DriveSample(scan, odometry.T_odom_base, self.T_world_base[k])

    def write(self, path: Path) -> None:
        """Write the recording as an .npz file, whole or not at all."""
        with atomic_write(path) as aside, aside.open('wb') as stream:
            np.savez_compressed(stream, **vars(self))


def read_recording(path: Path) -> Recording:
    """Read a recording. Raises InputError where it is missing or damaged."""
    try:
        with np.load(path) as content:
            return Recording(**{name: content[name] for name in content.files})
    except (OSError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f'{path}: expected a recorded drive: {error}') from error


class RecordedSimulation(Simulation):
    """A simulation that keeps its scans, the true poses at them, and the motion of each step."""

    def __init__(
        self, world: World, start: Array, robot: RobotConfig, laser: LaserScannerConfig, seed: int
    ) -> None:
        super().__init__(world, start, robot, laser, seed)
        self._scans: list[Scan] = []
        self._poses: list[Array] = []
        self._steps: list[tuple[float, float]] = []

    def read_sensors(self) -> SensorReadings:
        """Return what the sensors measure now, and keep a scan with its true pose."""
        moment = super().read_sensors()
        for scan in moment.scans:
            self._scans.append(scan)
            self._poses.append(self.robot.T_world_base)
        return moment

    def move(self, v: float, w: float) -> None:
        """Drive for one step, and keep its exact distance and turn."""
        super().move(v, w)
        self._steps.append((self.robot.v * _STEP_S, self.robot.w * _STEP_S))

    def recording(self) -> Recording:
        """Return what was recorded. Raises InputError where there was no scan."""
        if not self._scans:
            raise InputError(f'{self.world.name}: no scan to record')
        first = self._scans[0]
        fan = (
            first.angle_min_rad,
            first.angle_increment_rad,
            first.range_min_m,
            first.range_max_m,
        )
        return Recording(
            np.array([scan.stamp_ns for scan in self._scans], dtype=np.int64),
            np.array([scan.ranges_m for scan in self._scans], dtype=np.float32),
            np.array(self._poses),
            np.array(self._steps).reshape(-1, 2),
            np.array(fan),
            first.T_base_laser,
        )
