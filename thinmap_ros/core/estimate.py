"""Result of one localizer step."""

import math
from dataclasses import dataclass
from enum import Enum

from thinmap_ros.core.se2 import Array

MAX_ODDS = 1e12  # higher ones are reported as this


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


class Placement(Enum):
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
    """Estimated pose after a scan.

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
    def placement(self) -> Placement:
        """Where the scan belongs: a blind or misaligned laser shows nothing."""
        if self.blind_reason or self.mount_fault:
            return Placement.NOWHERE
        if self.is_mapping_apart:
            return Placement.APART
        if self.is_lost:
            return Placement.NOWHERE
        return Placement.OPEN if self.is_contradicted else Placement.MAP
