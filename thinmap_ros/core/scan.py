"""One revolution of a planar laser scanner."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array

# With a smaller share of valid beams, the space in front of the laser is unobserved.
MIN_VALID_BEAM_RATIO = 0.1
# Fewer hits do not show whether the laser works.
MIN_HITS = 10
# Maximum distance of a laser from the centre of its robot.
MAX_MOUNT_OFFSET_M = 100.0


@dataclass(frozen=True, eq=False)
class Scan:
    """Ranges of one scan, and the pose of the laser on the robot.

    stamp_ns: time of the scan; ranges_m (N,): raw, may hold inf, NaN and nonsense; beam i points to
    angle_min_rad + i * angle_increment_rad in the laser frame (a negative increment is a clockwise
    laser); T_base_laser (3,): the laser's pose on the robot; zero_is_no_return: whether this
    laser's driver publishes 0 for a beam without return; fault: why the ranges of the laser were
    replaced by invalid ones; warning: how the angles of its message contradict its beams. Use
    `Scan.create` to make one.

    Each range is one of `hit`, `no_return`, `below_range_min`, or invalid (`valid` is False).
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
    fault: str = ''
    warning: str = ''

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

        Raises InputError if the geometry is invalid: NaN angles, an increment of 0, an empty or
        negative range interval, a laser pose that is not finite or beyond MAX_MOUNT_OFFSET_M.
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
        """Beams that hit an obstacle: range_min <= range < range_max, (N,)."""
        return (
            (self.ranges_m >= self.range_min_m)
            & (self.ranges_m < self.range_max_m)
            & (self.ranges_m > 0.0)
        )

    @cached_property
    def no_return(self) -> NDArray[np.bool_]:
        """Beams without an obstacle in range: range >= range_max or +inf (REP 117), (N,)."""
        return self.ranges_m >= self.range_max_m

    @cached_property
    def below_range_min(self) -> NDArray[np.bool_]:
        """Beams that hit an obstacle closer than range_min: -inf (REP 117), (N,)."""
        return np.isneginf(self.ranges_m)

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Valid beams, (N,). Obstacles may hide behind the others (NaN, 0, below range_min).

        With zero_is_no_return a range of 0 is valid: the laser works, and nothing is near. It is
        still not `no_return`: a dark surface gives 0 as well, so the beam clears no cells.
        """
        valid = self.hit | self.no_return | self.below_range_min
        return valid | (self.ranges_m == 0.0) if self.zero_is_no_return else valid

    @cached_property
    def is_blind(self) -> bool:
        """Whether so few beams are valid that the laser must be covered or broken."""
        return int(np.count_nonzero(self.valid)) < MIN_VALID_BEAM_RATIO * self.ranges_m.size

    @property
    def blind_reason(self) -> str:
        """Why the scan observes nothing; '' for a scan that is not blind."""
        return (self.fault or 'too few valid beams') if self.is_blind else ''

    def blinded(self, fault: str) -> 'Scan':
        """The scan with invalid ranges only: the laser did not measure the given ones."""
        return replace(self, ranges_m=np.full_like(self.ranges_m, np.nan), fault=fault)

    def points_laser(self) -> Array:
        """End points of the hits, laser frame, (M, 2)."""
        ranges = self.ranges_m[self.hit]
        angles = self.angles_rad[self.hit]
        return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])

    def points_base(self) -> Array:
        """End points of the hits, robot frame, (M, 2)."""
        return se2.transform_points(self.T_base_laser, self.points_laser())


def is_most_missed(scan: Scan, missed: int) -> bool:
    """Whether a scan has no return from most of the surfaces in range: `missed` beams have none.

    Hits count for the scan: a surface that moves is hit by other beams.
    """
    fewest = max(MIN_HITS, MIN_VALID_BEAM_RATIO * scan.ranges_m.size)
    return bool(missed >= fewest and missed > np.count_nonzero(scan.hit))
