"""One revolution of a planar laser scanner."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array

# Of a laser with fewer beams than this that say anything, nobody can tell what is in front of it.
MIN_VALID_BEAM_RATIO = 0.1
# No laser is mounted farther from the middle of its robot.
MAX_MOUNT_OFFSET_M = 100.0


@dataclass(frozen=True, eq=False)
class Scan:
    """Ranges of one scan and where the laser sat on the robot when it was taken.

    stamp_ns: time of the scan; ranges_m (N,): raw, may hold inf, NaN and nonsense; beam i points to
    angle_min_rad + i * angle_increment_rad in the laser frame (a negative increment is a clockwise
    laser); T_base_laser (3,): the laser's pose on the robot; zero_is_no_return: whether this
    laser's driver publishes 0 for a beam that met nothing. Make one with `Scan.create`.

    What a range says: `hit`, `no_return`, `too_near`, or nothing (`valid` is False).
    Source: REP 117, with range_max as a finite value for "no return", which many drivers publish.
    """

    stamp_ns: int
    ranges_m: Array
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    T_base_laser: Array
    zero_is_no_return: bool = False

    @staticmethod
    def create(
        stamp_ns: int,
        ranges_m: ArrayLike,
        angle_min_rad: float,
        angle_increment_rad: float,
        range_min_m: float,
        range_max_m: float,
        T_base_laser: Array | None = None,
        zero_is_no_return: bool = False,
    ) -> 'Scan':
        """Make a scan, rounded to float32 as sensor_msgs/LaserScan is.

        Text log, bag and live agree bit for bit.

        Raises InputError where the geometry is no geometry: NaN angles, beams without an angle
        between them, an empty or negative range interval, a mount that is not finite or farther
        than FARTHEST_MOUNT_M.
        """
        ranges = np.asarray(ranges_m, dtype=np.float32).astype(np.float64)
        first, step, low, high = (
            float(np.float32(v))
            for v in (angle_min_rad, angle_increment_rad, range_min_m, range_max_m)
        )
        if ranges.ndim != 1 or not np.isfinite([first, step, low]).all() or np.isnan(high):
            limits = f'angles {first}, {step}, range {low} to {high}'
            raise InputError(f'scan at {stamp_ns} ns: {limits}: expected finite numbers')
        if step == 0.0 and ranges.size > 1:
            raise InputError(
                f'scan at {stamp_ns} ns: {ranges.size} beams, increment 0: '
                'expected an angle between them'
            )
        if not 0.0 <= low < high:
            raise InputError(
                f'scan at {stamp_ns} ns: range {low} to {high} m: expected 0 <= min < max'
            )
        T_base_laser = (
            np.zeros(3) if T_base_laser is None else np.asarray(T_base_laser, dtype=np.float64)
        )
        if not (
            se2.is_finite(T_base_laser) and np.abs(T_base_laser[:2]).max() <= MAX_MOUNT_OFFSET_M
        ):
            mount = ', '.join(f'{value:g}' for value in T_base_laser.tolist())
            raise InputError(
                f'scan at {stamp_ns} ns: laser mounted at {mount}: '
                f'expected finite numbers, at most {MAX_MOUNT_OFFSET_M:g} m'
            )
        return Scan(int(stamp_ns), ranges, first, step, low, high, T_base_laser, zero_is_no_return)

    @cached_property
    def angles_rad(self) -> Array:
        """Bearing of each beam in the laser frame, (N,)."""
        beams = np.arange(self.ranges_m.size, dtype=np.float64)
        return self.angle_min_rad + self.angle_increment_rad * beams

    @cached_property
    def hit(self) -> NDArray[np.bool_]:
        """Beams that met something: range_min <= range < range_max, (N,)."""
        return (
            (self.ranges_m >= self.range_min_m)
            & (self.ranges_m < self.range_max_m)
            & (self.ranges_m > 0.0)
        )

    @cached_property
    def no_return(self) -> NDArray[np.bool_]:
        """Beams that met nothing within the range: range >= range_max or +inf (REP 117), (N,)."""
        return self.ranges_m >= self.range_max_m

    @cached_property
    def below_range_min(self) -> NDArray[np.bool_]:
        """Beams that met something nearer than can be measured: -inf (REP 117), (N,)."""
        return np.isneginf(self.ranges_m)

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Beams that say something, (N,). The others (NaN, 0, below range_min) may hide anything.

        With zero_is_no_return a range of 0 is valid: the laser works, and nothing is near. It is
        not `no_return` all the same: a dark thing gives 0 as well, so no cell of a map is freed.
        """
        valid = self.hit | self.no_return | self.below_range_min
        return valid | (self.ranges_m == 0.0) if self.zero_is_no_return else valid

    @cached_property
    def is_blind(self) -> bool:
        """Whether so few beams are valid that the laser may as well be covered or broken."""
        return int(np.count_nonzero(self.valid)) < MIN_VALID_BEAM_RATIO * self.ranges_m.size

    def points_laser(self) -> Array:
        """End points of the beams that met something, laser frame, (M, 2)."""
        ranges = self.ranges_m[self.hit]
        angles = self.angles_rad[self.hit]
        return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])

    def points_base(self) -> Array:
        """End points of the beams that met something, robot frame, (M, 2)."""
        return se2.transform_points(self.T_base_laser, self.points_laser())
