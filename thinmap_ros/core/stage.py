"""The chain from scans to the graph: its stages, how it starts, and what it estimates."""

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError, InputError, quoted
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import State

MAX_ODDS = 1e12  # higher ones are reported as this

# Values of the parameter `slam`.
SCAN_MATCHING = 'scan_matching'
EKF_TI = 'ekf_ti'
EKF_FULL = 'ekf_full'

# Values of the parameter `mode`, as in slam_toolbox.
MAPPING = 'mapping'
LOCALIZATION = 'localization'

MAX_TAG = 64  # characters

Input = TypeVar('Input', contravariant=True)
Output = TypeVar('Output', covariant=True)


def checked_tag(name: str, tag: str) -> str:
    """The tag of a storey, '' for none. Raises InputError with its name where it is none."""
    if len(tag) > MAX_TAG or not tag.isprintable() or tag != tag.strip():
        raise InputError(
            f'{name} = {quoted(tag)}: expected at most {MAX_TAG} printable characters, without '
            'blanks around them'
        )
    return tag


def are_two_storeys(tag: str, other: str) -> bool:
    """Whether the tags of two maps say that these show different storeys."""
    return bool(tag and other and tag != other)


@dataclass(frozen=True)
class Apart:
    """A piece of map that is apart: path length, m, and log odds of its most likely place."""

    path_m: float
    log_odds: float

    @property
    def odds(self) -> float:
        """Odds of the most likely place, at most MAX_ODDS; 0 without one."""
        return math.exp(min(self.log_odds, math.log(MAX_ODDS)))


@dataclass(frozen=True, eq=False)
class Join:
    """A piece of map that was apart and is joined with the published map.

    T (3,): where the frame in which it was made lies in the map; log_odds: of its place; path_m:
    length of its path; links: number of matches between both.
    """

    T: Array
    log_odds: float
    path_m: float
    links: int


@dataclass(frozen=True, eq=False)
class Correction:
    """Poses (N, 3) of the keyframes before and after the pose graph was optimized.

    join: the piece that was joined, if its place was recognized.
    """

    before: Array
    after: Array
    join: Join | None = None


class Destination(Enum):
    """Where a scan belongs.

    MAP: in the map, at its pose. OPEN: there, if it turns out that the robot is not lost. APART: in
    a piece of map whose place is unknown. NOWHERE: it shows nothing, or nobody knows where.
    """

    MAP = 0
    OPEN = 1
    APART = 2
    NOWHERE = 3


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of one localizer step: the estimated pose after a scan.

    T_map_base (3,) with covariance (3, 3); T_map_odom (3,).

    observed_lines, matched_lines: lines of this scan, and how many of them match features (both 0
    while the robot stands still). n_features, n_local_features: features in the map, and in the
    local area. inlier_ratio: share of the scan points in known space that fit the map.
    is_lost: the place in the map is unknown; pose and covariance are those of dead reckoning.
    apart: the piece of map that the robot is in; None if that is the published map.
    is_contradicted: scans contradict the map, and whether the robot is lost is not yet decided.
    blind_reason: why the laser does not confirm the pose, which follows the odometry; '': it does.
    odometry_discontinuity: description of an odometry jump since the previous scan; '': none.
    mount_fault: why the pose of the laser on the robot must be wrong, by so much that the robot
    must not drive; '': it need not be.
    correction: keyframe poses before and after, if this step closed a loop; T_map_base is then the
    corrected pose. scan_information: information (3, 3) of the scan alone, map frame; None: no
    match that fits has set the pose.
    """

    T_map_base: Array
    covariance: Array
    T_map_odom: Array
    observed_lines: int = 0
    matched_lines: int = 0
    n_features: int = 0
    n_local_features: int = 0
    inlier_ratio: float = 0.0
    is_lost: bool = False
    apart: Apart | None = None
    is_contradicted: bool = False
    blind_reason: str = ''
    odometry_discontinuity: str = ''
    mount_fault: str = ''
    correction: Correction | None = None
    scan_information: Array | None = None

    @property
    def is_mapping_apart(self) -> bool:
        """Whether the robot is lost, and maps a piece of its own until its place is known."""
        return self.apart is not None

    @property
    def destination(self) -> Destination:
        """Where the scan belongs: a blind or misaligned laser shows nothing."""
        if self.blind_reason or self.mount_fault:
            return Destination.NOWHERE
        if self.is_mapping_apart:
            return Destination.APART
        if self.is_lost:
            return Destination.NOWHERE
        return Destination.OPEN if self.is_contradicted else Destination.MAP


class Stage(Protocol[Input, Output]):
    """A part of the chain, in one process with the others or in a node of its own."""

    def step(self, given: Input, /) -> Output | None:
        """Process the output of the stage before; None: nothing that the next stage needs."""

    def state(self) -> State:
        """The state as arrays by name."""

    def restore(self, state: State) -> None:
        """Continue from a state. Raises InputError, and changes nothing, if it is invalid."""

    def reset(self) -> None:
        """Begin again with an empty map."""


class Trajectory(NamedTuple):
    """A correction: the scans of these stamps (M,) were made at poses (M, 3).

    since_ns: stamp of the first scan whose pose is already correct.
    """

    stamps_ns: NDArray[np.int64]
    poses: Array
    since_ns: int


@dataclass(frozen=True, eq=False)
class LocalizedScan:
    """A scan, the pose T_map_base (3,) at which it was made, and where it belongs.

    trajectory: the correction that the pose follows, if it is new with this scan.
    """

    scan: Scan
    T_map_base: Array
    destination: Destination
    trajectory: Trajectory | None = None


def slam_parameter(default: str) -> Any:
    """Declare the field `slam`, which has another default in the configuration of each localizer.

    It lists all values: `StartConfig` checks which of them belong to a configuration.
    """
    return parameter(
        default,
        'scan_matching: scan matching with a pose graph; ekf_ti: EKF-SLAM/TI on odometry and line '
        'features alone; ekf_full: the same with all features in the state.',
        choices=(SCAN_MATCHING, EKF_TI, EKF_FULL),
    )


@dataclass(frozen=True)
class StartConfig(Config):
    """Parameters that all localizers have: which one it is, where it starts, whether it maps.

    of_slam: the values of `slam` that a configuration is for. Raises ConfigError for another one.
    has_start: whether the start pose is given, also one that is exactly 0, 0, 0.
    """

    of_slam: ClassVar[tuple[str, ...]] = (SCAN_MATCHING, EKF_TI, EKF_FULL)

    slam: str = slam_parameter(SCAN_MATCHING)
    initial_x_m: float = parameter(
        0.0,
        'Initial x position in the map (m). A start at 0, 0, 0 in a loaded map is taken as '
        'unknown: scan matching maps once scans fit there along 6 m of path.',
        low=-se2.MAX_COORDINATE_M,
        high=se2.MAX_COORDINATE_M,
    )
    initial_y_m: float = parameter(
        0.0,
        'Initial y position in the map (m).',
        low=-se2.MAX_COORDINATE_M,
        high=se2.MAX_COORDINATE_M,
    )
    initial_yaw_rad: float = parameter(0.0, 'Initial heading in the map (rad).')
    mode: str = parameter(
        MAPPING,
        'mapping: scans extend and change the map. localization: the map is given (a session, '
        'map_file_name or topic map) and does not change.',
        choices=(MAPPING, LOCALIZATION),
    )

    has_start: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.slam not in self.of_slam:
            raise ConfigError(
                f'slam = {quoted(self.slam)}: {type(self).__name__} expected '
                f'{" or ".join(self.of_slam)}'
            )

    @property
    def is_start_given(self) -> bool:
        """Whether a start pose is given: parameters alone cannot tell 0, 0, 0 from none."""
        start = (self.initial_x_m, self.initial_y_m, self.initial_yaw_rad)
        return self.has_start or start != (0.0, 0.0, 0.0)

    @property
    def is_mapping(self) -> bool:
        """Whether scans change the map."""
        return self.mode == MAPPING


def config_at(config: StartConfig, T_map_base: Array) -> StartConfig:
    """The configuration with a start pose (3,) that is given."""
    x, y, yaw = T_map_base.tolist()
    return replace(config, initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw, has_start=True)
