"""Simulated planar laser scanner, with range noise and mixed pixels."""

import math
import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError, quoted
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.scan import MAX_MOUNT_OFFSET_M, Scan
from thinmap_ros.core.se2 import Array, Mask
from thinmap_ros.jit import kernel
from thinmap_ros.sim.world import World

_INTO_CELL = 1e-6
_DEPTH_EDGE_M = 0.3  # between neighbouring beams: less is one surface seen at a slant
_NAME = re.compile(r'[a-z][a-z0-9_]*')  # a part of a topic and of a frame
_EXPECTED = 'expected "NAME x,y,yaw; NAME x,y,yaw" (m, m, rad), each name once, as front and rear'


@dataclass(frozen=True, eq=False)
class LaserMount:
    """A laser on its robot: topic and frame of its scans, and its pose (3,)."""

    topic: str
    frame: str
    T_base_laser: Array


@dataclass(frozen=True)
class LaserScannerConfig(Config):
    """A planar laser scanner; the defaults are those of an LMS200 in its 8 m mode."""

    beams: int = parameter(181, 'Number of beams of a scan.', low=2, high=10_000)
    field_of_view_deg: float = parameter(
        180.0, 'Angle between the first and the last beam (deg).', low=0.0, high=360.0
    )
    range_min_m: float = parameter(0.05, 'Smallest range (m).', low=0.0, high=10.0)
    range_max_m: float = parameter(
        8.0,
        'Largest range (m). What nodes use of it is max_range_m.',
        low=0.1,
        high=200.0,
    )
    scan_rate_hz: float = parameter(5.0, 'Scans per second.', low=0.1, high=20.0)
    range_noise_m: float = parameter(
        0.01,
        'True standard deviation of a range (m). What nodes assume is laser_range_noise_m, at '
        'least as much.',
        low=0.0,
        high=1.0,
    )
    range_resolution_m: float = parameter(0.001, 'Resolution of a range (m).', low=0.0, high=0.1)
    mixed_pixel_ratio: float = parameter(
        0.3, 'Ratio of depth edges with a range in between (mixed pixel).', low=0.0, high=1.0
    )
    laser_x_m: float = parameter(
        0.0, 'Position of the laser ahead of the robot centre (m).', low=-2.0, high=2.0
    )
    lasers: str = parameter(
        '',
        'Name and pose of each of several lasers on the robot, as "front x,y,yaw; rear x,y,yaw" '
        '(m, m, rad). Their topics are front/scan and rear/scan, their frames front_laser and '
        'rear_laser. Empty: one laser, at laser_x_m.',
    )
    min_incidence_deg: float = 10.0  # beams side by side on a wall at this angle are no depth edge

    def __post_init__(self) -> None:
        super().__post_init__()
        self.mounts()

    def mounts(self) -> list[LaserMount]:
        """Each laser on the robot. Raises ConfigError where `lasers` names none, or one twice."""
        if not self.lasers:
            return [LaserMount('scan', 'laser', np.array([self.laser_x_m, 0.0, 0.0]))]
        mounts = [_mount(text) for text in self.lasers.split(';')]
        found = {mount.frame: mount for mount in mounts if mount is not None}
        if len(found) < len(mounts):
            raise ConfigError(f'lasers = {quoted(self.lasers)}: {_EXPECTED}')
        return list(found.values())


def _mount(text: str) -> LaserMount | None:
    """A laser as "NAME x,y,yaw"; None where the text is none."""
    name, _, pose = text.strip().partition(' ')
    try:
        x, y, yaw = (float(number) for number in pose.split(','))
    except ValueError:
        return None
    is_pose = math.hypot(x, y) <= MAX_MOUNT_OFFSET_M and math.isfinite(yaw)
    if not (_NAME.fullmatch(name) and is_pose):
        return None
    return LaserMount(f'{name}/scan', f'{name}_laser', se2.pose(x, y, yaw))


class LaserScanner:
    """Simulates scans of a world; a beam without a hit in range is +inf (REP 117)."""

    def __init__(
        self, config: LaserScannerConfig, seed: int, mount: LaserMount | None = None
    ) -> None:
        """mount: of one of several lasers; None: of the first."""
        self.config = config
        self.mount = mount or config.mounts()[0]
        full_circle = config.field_of_view_deg >= 360.0
        intervals = config.beams if full_circle else config.beams - 1
        self._increment = math.radians(config.field_of_view_deg) / intervals
        self._angle_min = -math.radians(config.field_of_view_deg) / 2.0
        self._turns = self._increment * np.arange(config.beams)
        self._rng = np.random.default_rng(seed)

    def scan(self, world: World, T_world_base: Array, stamp_ns: int) -> Scan:
        """Scan from a robot pose (3,) in the world."""
        exact = self._exact(world, se2.compose(T_world_base, self.mount.T_base_laser), stamp_ns)
        ranges = self._mix(exact) + self._rng.normal(0.0, self.config.range_noise_m, exact.size)
        if self.config.range_resolution_m > 0.0:
            ranges = (
                np.round(ranges / self.config.range_resolution_m) * self.config.range_resolution_m
            )
        ranges[~(ranges < self.config.range_max_m)] = np.inf
        scan = Scan.create(
            stamp_ns,
            ranges,
            self._angle_min,
            self._increment,
            self.config.range_min_m,
            self.config.range_max_m,
            self.mount.T_base_laser,
        )
        return replace(scan, frame=self.mount.frame)

    def _exact(self, world: World, T_world_laser: Array, stamp_ns: int) -> Array:
        frame = world.frame
        x = (T_world_laser[0] - frame.origin_x) / frame.resolution
        y = (T_world_laser[1] - frame.origin_y) / frame.resolution
        angles = T_world_laser[2] + self._angle_min + self._turns
        reach_m = self.config.range_max_m
        cells = cast_rays(world.occupied, x, y, angles, reach_m / frame.resolution)
        if world.glass is not None:
            cells[_meets(world.glass, x, y, angles, cells)] = np.inf
        ranges = cells * frame.resolution
        nearer = world.moving_ranges(stamp_ns / 1e9, T_world_laser, angles, reach_m)
        return ranges if nearer is None else np.minimum(ranges, nearer)

    def _mix(self, ranges: Array) -> Array:
        """Add mixed pixels: at a depth edge a beam covers both surfaces, with a range in between.

        A random one of the two beams beside an edge is affected: with always the same one, the
        points of left and right walls would be shifted to the same side.
        """
        edges = _edges(
            ranges,
            _DEPTH_EDGE_M,
            self._increment / math.sin(math.radians(self.config.min_incidence_deg)),
        )
        mixed = edges[self._rng.random(ranges.size - 1)[edges] < self.config.mixed_pixel_ratio]
        share = self._rng.random(mixed.size)
        side = self._rng.integers(0, 2, mixed.size)
        nearer = np.minimum(ranges[mixed], ranges[mixed + 1])
        farther = np.maximum(ranges[mixed], ranges[mixed + 1])
        result = ranges.copy()
        result[mixed + side] = nearer + share * (farther - nearer)
        return result


def _meets(special: Mask, x: float, y: float, angles: Array, cells: Array) -> Mask:
    """Whether beams from (x, y) with lengths (N,), cells, end in a special cell."""
    inside = np.where(np.isfinite(cells), cells, 0.0) + _INTO_CELL
    cols = np.floor(x + inside * np.cos(angles)).astype(np.int64)
    rows = np.floor(y + inside * np.sin(angles)).astype(np.int64)
    there: Mask = (rows >= 0) & (rows < special.shape[0]) & (cols >= 0) & (cols < special.shape[1])
    there &= np.isfinite(cells)
    there[there] = special[rows[there], cols[there]]
    return there


@kernel
def _edges(ranges: Array, edge_m: float, along_a_wall: float) -> NDArray[np.int64]:
    """Beams at depth edges: the next range differs by more than edge_m and along_a_wall."""
    found = np.empty(ranges.size, dtype=np.int64)
    count = 0
    for i in range(ranges.size - 1):
        nearer = min(ranges[i], ranges[i + 1])
        farther = max(ranges[i], ranges[i + 1])
        if math.isfinite(farther) and farther - nearer > max(edge_m, nearer * along_a_wall):
            found[count] = i
            count += 1
    return found[:count].copy()
