"""One revolution of a planar laser scanner."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array


@dataclass(frozen=True, eq=False)
class Scan:
    """Ranges of one scan and where the laser sat on the robot when it was taken.

    stamp_ns: time of the scan; ranges_m (N,): raw, may hold inf, NaN and nonsense; beam i points to
    angle_min_rad + i * angle_increment_rad in the laser frame (a negative increment is a clockwise laser);
    T_base_laser (3,): the laser's pose on the robot. Make one with `Scan.create`.
    """

    stamp_ns: int
    ranges_m: Array
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    T_base_laser: Array

    @staticmethod
    def create(
        stamp_ns: int,
        ranges_m: ArrayLike,
        angle_min_rad: float,
        angle_increment_rad: float,
        range_min_m: float,
        range_max_m: float,
        T_base_laser: Array | None = None,
    ) -> 'Scan':
        """Make a scan, rounded to float32 as sensor_msgs/LaserScan is: text log, bag and live agree bit for bit.

        Raises InputError where the geometry is no geometry: NaN angles, beams without an angle between them, an empty
        or negative range interval.
        """
        ranges = np.asarray(ranges_m, dtype=np.float32).astype(np.float64)
        first, step, low, high = (
            float(np.float32(v)) for v in (angle_min_rad, angle_increment_rad, range_min_m, range_max_m)
        )
        if ranges.ndim != 1 or not np.isfinite([first, step, low]).all() or np.isnan(high):
            limits = f'angles {first}, {step}, range {low} to {high}'
            raise InputError(f'scan at {stamp_ns} ns: {limits}: expected finite numbers')
        if step == 0.0 and ranges.size > 1:
            raise InputError(f'scan at {stamp_ns} ns: {ranges.size} beams, increment 0: expected an angle between them')
        if not 0.0 <= low < high:
            raise InputError(f'scan at {stamp_ns} ns: range {low} to {high} m: expected 0 <= min < max')
        T_base_laser = np.zeros(3) if T_base_laser is None else np.asarray(T_base_laser, dtype=np.float64)
        return Scan(int(stamp_ns), ranges, first, step, low, high, T_base_laser)

    @cached_property
    def angles_rad(self) -> Array:
        """Bearing of each beam in the laser frame, (N,)."""
        return self.angle_min_rad + self.angle_increment_rad * np.arange(self.ranges_m.size, dtype=np.float64)

    @cached_property
    def hit(self) -> NDArray[np.bool_]:
        """Beams that met something: range_min <= range < range_max, (N,)."""
        return (self.ranges_m >= self.range_min_m) & (self.ranges_m < self.range_max_m) & (self.ranges_m > 0.0)

    @cached_property
    def no_return(self) -> NDArray[np.bool_]:
        """Beams that met nothing within the range: range >= range_max or +inf (REP 117), (N,)."""
        return self.ranges_m >= self.range_max_m

    def points_laser(self) -> Array:
        """End points of the beams that met something, laser frame, (M, 2)."""
        ranges, angles = self.ranges_m[self.hit], self.angles_rad[self.hit]
        return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])

    def points_base(self) -> Array:
        """End points of the beams that met something, robot frame, (M, 2)."""
        return se2.transform_points(self.T_base_laser, self.points_laser())
