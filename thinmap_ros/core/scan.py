"""One revolution of a planar laser scanner."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, config_or_default, parameter
from thinmap_ros.core.errors import ConfigError, InputError, one_line_reason, quoted, quoted_name
from thinmap_ros.core.se2 import SECOND_NS, Array, Mask

# With a smaller share of valid beams, the space in front of the laser is unobserved.
MIN_VALID_BEAM_RATIO = 0.1
# Fewer hits do not show whether the laser works.
MIN_HITS = 10
# Maximum distance of a laser from the centre of its robot.
MAX_MOUNT_OFFSET_M = 100.0
# A robot stands while one of its lasers is silent for so long: what it saw then is past.
SILENT_LASER_NS = SECOND_NS
# Range up to which a beam without return shows free space.
NO_RETURN_CLEAR_RANGE_M = 8.0
# Fault of the scans that are left out by max_tilt_rad: the laser works.
TILTED = 'robot tilted by more than max_tilt_rad'
# What the stamp of a scan is the time of.
AT_START = 'start'
AT_END = 'end'

# How far from the body that was found another range of it may be: noise, and a cable that hangs.
BODY_TOLERANCE_M = 0.1
# Pairs of bearings in the frame of a laser, deg: from the first one counter-clockwise to the other.
Sectors = tuple[tuple[float, float], ...]


def parse_sectors(text: str) -> Sectors:
    """Sectors of a text as "-180 -126, 126 180". Raises ConfigError where it is no such text."""
    sectors: list[tuple[float, float]] = []
    for part in filter(str.strip, text.split(',')):
        try:
            low, high = (float(word) for word in part.split())
        except ValueError:
            low = high = math.nan
        if not (abs(low) <= 360.0 and abs(high) <= 360.0):
            raise ConfigError(
                f'body_sectors = {quoted(text)}: expected pairs of bearings from -360 to 360 deg, '
                'as "-180 -126, 126 180"'
            )
        sectors.append((low, high))
    return tuple(sectors)


@dataclass(frozen=True)
class LaserConfig(Config):
    """Parameters of the laser, for everything that uses its scans."""

    max_range_m: float = parameter(
        30.0,
        'Usable range of the laser (m). Longer ranges are not matched, make no line and mark no '
        'obstacle; their beams clear cells up to here. Lower it for a laser that measures badly '
        'far away.',
        low=0.5,
        high=200.0,
    )
    zero_is_no_return: bool = parameter(
        False,
        'A range of 0 means no return, as for the LDS of the TurtleBot 3. false: the beam is '
        'invalid.',
    )
    scan_stamp: str = parameter(
        AT_START,
        'Beam whose time is the stamp of a scan. start: the first one, as sensor_msgs/LaserScan '
        'defines. end: the last one, as of drivers that stamp a scan when it is complete. It '
        'matters where the driver publishes time_increment.',
        choices=(AT_START, AT_END),
    )
    scan_delay_s: float = parameter(
        0.0,
        'Time by which the stamp of a scan is later than its measurement, by the clock of the '
        'odometry (s), as of drivers that stamp a scan when it is received. Negative: the '
        'odometry is late. What turns show beyond it is estimated and corrected, too.',
        low=-10.0,
        high=10.0,
    )
    max_tilt_rad: float = parameter(
        0.08,
        'Tilt of the robot, by the orientation of its odometry, above which scans are left '
        'out (rad): on a ramp they show the floor. 0.08 is above the noise of the odometry of a '
        'level robot and below a ramp of 1:12. Raise it where the orientation is noisier, lower it '
        'for a laser near the floor.',
        low=0.01,
        high=1.5,
    )
    body_sectors: str = parameter(
        '',
        "Sectors in which the laser sees the robot's own body, pairs of bearings in the frame of "
        'the laser (deg), as "-180 -126, 126 180": their beams are left out. Without them, a body '
        'is found after some turns, up to 0.7 m from the laser.',
    )
    min_range_m: float = parameter(
        0.0,
        'Nearer ranges are left out (m). For dust and parts of the robot around the laser; '
        'obstacles that near are not seen.',
        low=0.0,
        high=10.0,
    )

    def __post_init__(self) -> None:
        """Raise ConfigError where a parameter is invalid."""
        super().__post_init__()
        parse_sectors(self.body_sectors)


@dataclass(frozen=True, eq=False)
class NearbyRobot:
    """Another robot, as it was heard when a scan was made.

    T_own_base (3,): its pose in its own map; radius_m: within which it may be.
    """

    name: str
    T_own_base: Array
    radius_m: float


@dataclass(frozen=True, eq=False)
class Scan:
    """Ranges of one scan, and the pose of the laser on the robot.

    stamp_ns: time of the scan; ranges_m (N,): raw, may hold inf, NaN and nonsense; beam i points to
    angle_min_rad + i * angle_increment_rad in the laser frame (a negative increment is a clockwise
    laser); T_base_laser (3,): the laser's pose on the robot; zero_is_no_return: whether this
    laser's driver publishes 0 for a beam without return; max_range_m: usable range of the laser;
    max_tilt_rad: tilt of the robot above which the scan is left out.
    first_beam_s, beam_period_s: time of beam 0 since the stamp, and from each beam to the next (s),
    as the driver states them; scan_time_s: time of a whole scan; each 0 if unknown. drops_out: this
    laser often has no return from surfaces in range, so that a beam without return says nothing;
    fault: why the ranges of the laser were replaced by invalid ones; warning: how the angles of its
    message contradict its beams; odometry_silence_s: by how much the odometry was silent for longer
    than usual since the previous scan; None: unknown; frame: that of the laser, by which the lasers
    of a robot differ; is_mirrored: it hangs upside down, so that its bearings have the other sign
    in its own frame; body_m (360,): range at which the robot's own body was found at each degree
    from -180, NaN where there is none; delay_s: by how much the stamp is later than the
    measurement, by the clock of the odometry; T_odom_before (3,): odometry of the previous scan,
    where its delay has turned out to be another one; robots: others, whose places in the map may be
    known only later. Use `Scan.create` to make one.

    Each range is one of `hit`, a hit beyond the usable range, `no_return`, `below_range_min`, or
    invalid (`valid` is False).
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
    max_range_m: float = LaserConfig.max_range_m
    max_tilt_rad: float = LaserConfig.max_tilt_rad
    first_beam_s: float = 0.0
    beam_period_s: float = 0.0
    scan_time_s: float = 0.0
    drops_out: bool = False
    fault: str = ''
    warning: str = ''
    odometry_silence_s: float | None = None
    frame: str = ''
    is_mirrored: bool = False
    body_m: Array | None = None
    delay_s: float = 0.0
    T_odom_before: Array | None = None
    robots: tuple[NearbyRobot, ...] = ()

    @staticmethod
    def create(
        stamp_ns: int,
        ranges_m: ArrayLike,
        angle_min_rad: float,
        angle_increment_rad: float,
        range_min_m: float,
        range_max_m: float,
        T_base_laser: Array | None = None,
        laser: LaserConfig | None = None,
        time_increment_s: float = 0.0,
        scan_time_s: float = 0.0,
    ) -> 'Scan':
        """Make a scan, rounded to float32 as sensor_msgs/LaserScan is.

        Text log, bag and live agree bit for bit. laser: parameters; None: their defaults.
        time_increment_s, scan_time_s: time between two beams and of a scan, as in the message.

        Raises InputError if the geometry is invalid: NaN angles, an increment of 0, an empty or
        negative range interval, a laser pose that is not finite or beyond MAX_MOUNT_OFFSET_M.
        """
        try:
            ranges = np.asarray(ranges_m, dtype=np.float32).astype(np.float64)
            first, step, low, high = (
                float(np.float32(v))
                for v in (angle_min_rad, angle_increment_rad, range_min_m, range_max_m)
            )
            mount = np.asarray(np.zeros(3) if T_base_laser is None else T_base_laser, np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f'scan: {one_line_reason(error)}: expected numbers') from error
        try:
            _require_geometry(ranges, first, step, low, high)
            _require_mount(mount)
        except InputError as error:
            raise InputError(f'scan at {stamp_ns} ns: {error}') from error
        laser = config_or_default(laser, LaserConfig)
        if not np.isfinite([time_increment_s, scan_time_s]).all():
            time_increment_s = scan_time_s = 0.0
        is_at_end = laser.scan_stamp == AT_END
        ranges[(ranges > 0.0) & (ranges < laser.min_range_m)] = np.nan
        scan = Scan(
            int(stamp_ns),
            ranges,
            first,
            step,
            low,
            high,
            mount,
            laser.zero_is_no_return,
            laser.max_range_m,
            laser.max_tilt_rad,
            first_beam_s=-time_increment_s * (ranges.size - 1) if is_at_end else 0.0,
            beam_period_s=time_increment_s,
            scan_time_s=scan_time_s,
            delay_s=laser.scan_delay_s,
        )
        return scan.without_sectors(parse_sectors(laser.body_sectors))

    @cached_property
    def angles_rad(self) -> Array:
        """Bearing of each beam in the laser frame, (N,)."""
        beams = np.arange(self.ranges_m.size, dtype=np.float64)
        return self.angle_min_rad + self.angle_increment_rad * beams

    @property
    def odometry_ns(self) -> int:
        """Time of the scan by the clock of the odometry: its stamp less its delay, ns."""
        return delayed_ns(self.stamp_ns, self.delay_s)

    @property
    def end_ns(self) -> int:
        """Time of the last beam, or of the scan if that is later, as `odometry_ns`."""
        last_s = self.first_beam_s + self.beam_period_s * (self.ranges_m.size - 1)
        return self.odometry_ns + round(max(self.first_beam_s, last_s, 0.0) * SECOND_NS)

    @property
    def begin_ns(self) -> int:
        """Time of the first beam, or of the scan if that is earlier, as `odometry_ns`."""
        last_s = self.first_beam_s + self.beam_period_s * (self.ranges_m.size - 1)
        return self.odometry_ns + round(min(self.first_beam_s, last_s, 0.0) * SECOND_NS)

    @cached_property
    def returned(self) -> Mask:
        """Beams that hit an obstacle: range_min <= range < range_max, (N,)."""
        return (
            (self.ranges_m >= self.range_min_m)
            & (self.ranges_m < self.range_max_m)
            & (self.ranges_m > 0.0)
        )

    @cached_property
    def hit(self) -> Mask:
        """Beams that hit an obstacle within the usable range, (N,)."""
        return self.returned & (self.ranges_m < self.max_range_m)

    @cached_property
    def without_return(self) -> Mask:
        """Beams without return: range >= range_max or +inf (REP 117), (N,)."""
        return self.ranges_m >= self.range_max_m

    @cached_property
    def no_return(self) -> Mask:
        """Beams without return that show that there is no obstacle in range, (N,)."""
        return self.without_return & (not self.drops_out)

    @cached_property
    def below_range_min(self) -> Mask:
        """Beams that hit an obstacle closer than range_min: -inf (REP 117), (N,)."""
        return np.isneginf(self.ranges_m)

    @cached_property
    def valid(self) -> Mask:
        """Valid beams, (N,). Obstacles may hide behind the others (NaN, 0, below range_min).

        With zero_is_no_return a range of 0 is valid: the laser works, and nothing is near. It is
        still not `no_return`: a dark surface gives 0 as well, so the beam clears no cells.
        """
        valid = self.returned | self.no_return | self.below_range_min
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

    @property
    def degrees(self) -> NDArray[np.int64]:
        """Bearing of each beam in whole degrees since -180, 0 to 359, (N,)."""
        return (np.rint(np.degrees(self.angles_rad)).astype(np.int64) + 180) % 360

    def without_sectors(self, sectors: Sectors) -> 'Scan':
        """The scan with the beams invalid that point into some sectors."""
        if not sectors:
            return self
        bearings = np.degrees(self.angles_rad)
        widths = [high - low + 360.0 * (high < low) for low, high in sectors]
        left_out = [
            (bearings - low) % 360.0 <= width
            for (low, _), width in zip(sectors, widths, strict=True)
        ]
        return replace(self, ranges_m=np.where(np.any(left_out, axis=0), np.nan, self.ranges_m))

    def without_body(self, body_m: Array | None) -> 'Scan':
        """The scan with the beams invalid that end at the robot's body (360,), as `body_m`."""
        if body_m is None:
            return self
        at_body = np.abs(self.ranges_m - body_m[self.degrees]) < BODY_TOLERANCE_M
        return replace(self, ranges_m=np.where(at_body, np.nan, self.ranges_m), body_m=body_m)

    def without_places(self, T_map_base: Array, places: Array, radius_m: float) -> 'Scan':
        """The scan, made at a pose (3,), with the beams invalid that end near places (M, 2), m.

        Other robots are there: they are no evidence about the map. The beams beside these are
        invalid as well: their ranges may be mixed with those of walls behind.
        """
        hit = np.flatnonzero(self.hit)
        if not len(places) or not hit.size:
            return self
        T_map_laser = se2.compose(T_map_base, self.T_base_laser)
        angles = self.angles_rad[hit] + T_map_laser[2]
        directions = np.column_stack([np.cos(angles), np.sin(angles)])
        ends = T_map_laser[:2] + self.ranges_m[hit, None] * directions
        away = np.hypot(*(ends[:, None] - places[None]).transpose(2, 0, 1))
        cut = hit[(away < radius_m).any(axis=1)]
        if not cut.size:
            return self
        beams = np.concatenate([cut - 1, cut, cut + 1])
        ranges = self.ranges_m.copy()
        ranges[beams[(beams >= 0) & (beams < ranges.size)]] = np.nan
        return replace(self, ranges_m=ranges)

    def without_robots(self, T_map_base: Array, T_map_own: Mapping[str, Array]) -> 'Scan':
        """The scan, made at a pose (3,), without the other robots whose maps have a known place.

        T_map_own: that place (3,), by the name of the robot.
        """
        scan = self
        for robot in self.robots:
            T = T_map_own.get(robot.name)
            if T is not None:
                place = se2.compose(T, robot.T_own_base)[None, :2]
                scan = scan.without_places(T_map_base, place, robot.radius_m)
        return scan

    def points_laser(self) -> Array:
        """End points of the hits, laser frame, (M, 2)."""
        ranges = self.ranges_m[self.hit]
        angles = self.angles_rad[self.hit]
        return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])

    def points_base(self) -> Array:
        """End points of the hits, robot frame, (M, 2)."""
        return se2.transform_points(self.T_base_laser, self.points_laser())


def delayed_ns(stamp_ns: int, delay_s: float) -> int:
    """Time of what was stamped with a delay, ns."""
    return stamp_ns - round(delay_s * SECOND_NS)


def _require_geometry(ranges: Array, first: float, step: float, low: float, high: float) -> None:
    """Raise InputError unless beams (N,) have a first angle, an increment and range limits."""
    if ranges.ndim != 1 or not np.isfinite([first, step, low]).all() or np.isnan(high):
        limits = f'angles {first}, {step}, range {low} to {high}'
        raise InputError(f'{limits}: expected finite numbers')
    if step == 0.0 and ranges.size > 1:
        raise InputError(f'{ranges.size} beams, increment 0: expected an angle between them')
    if not 0.0 <= low < high:
        raise InputError(f'range {low} to {high} m: expected 0 <= min < max')


def _require_mount(T_base_laser: Array) -> None:
    """Raise InputError unless the pose of a laser (3,) is one on a robot."""
    is_pose = T_base_laser.shape == (3,) and se2.is_finite(T_base_laser)
    if is_pose and np.abs(T_base_laser[:2]).max() <= MAX_MOUNT_OFFSET_M:
        return
    mount = ', '.join(f'{value:g}' for value in T_base_laser.ravel())
    raise InputError(
        f'laser mounted at {mount}: expected three finite numbers, at most {MAX_MOUNT_OFFSET_M:g} m'
    )


def with_newest(scans: tuple[Scan, ...], scan: Scan) -> tuple[Scan, ...]:
    """The newest scan of each laser, after the next one of a laser; a silent laser has none."""
    others = (
        each
        for each in scans
        if each.frame != scan.frame and abs(each.stamp_ns - scan.stamp_ns) <= SILENT_LASER_NS
    )
    return (*others, scan)


SURE_REACH = 0.9  # of range_max: a farther surface may have gone out of range


def is_most_missed(scan: Scan, missed: int) -> bool:
    """Whether a scan has no return from most of the surfaces in range: `missed` beams have none.

    Hits count for the scan: a surface that moves is hit by other beams.
    """
    fewest = max(MIN_HITS, MIN_VALID_BEAM_RATIO * scan.ranges_m.size)
    return bool(missed >= fewest and missed > np.count_nonzero(scan.hit))


def few_beams_reason(scan: Scan) -> str:
    """Why no scan with these beams confirms a pose, wherever the robot is; '' where one may.

    A beam without return is valid: there is no wall in its direction.
    """
    valid = int(np.count_nonzero(scan.valid))
    if scan.is_blind or valid >= MIN_HITS:
        return ''
    return f'{valid} valid beams of {scan.ranges_m.size}: expected at least {MIN_HITS}'


def laser_names(frames: Collection[str], form: str = '{}: ') -> dict[str, str]:
    """How a text on a laser begins, by its frame; form: with the frame, if there are several."""
    several = len(frames) > 1
    return {frame: form.format(quoted_name(frame)) if several else '' for frame in frames}


def of_lasers(texts: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """Texts by kind on all lasers, from those on each, by its frame."""
    names = laser_names(texts.keys())
    return {
        names[frame] + kind: names[frame] + text
        for frame, own in texts.items()
        for kind, text in own.items()
    }
