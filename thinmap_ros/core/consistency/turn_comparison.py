"""Compares the turns of scans with those of the odometry, to find a mirrored laser.

A driver whose angle increment has the wrong sign exchanges left and right. The map is a perfect
mirror image then, and nothing within the scans contradicts it. Only the scans turn against the
odometry. The turn between two near scans is that with which most of their ranges agree. The
odometry's translation is applied to it, its turn is not.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.scan import MIN_HITS, Scan
from thinmap_ros.core.se2 import Array


@dataclass(frozen=True)
class TurnComparisonConfig:
    """Scans that are compared, and how.

    Two scans are compared with from min_turn_rad to max_turn_rad of odometry between them, within
    max_path_m: a right angle more would be ambiguous in a square room. step_rad: between turns that
    are tried, up to max_ratio times that of the odometry to either side; max_points: of a scan;
    tolerance_m: difference of ranges with half the score; min_share: of the points that have to
    be in view of both scans; min_lead: lead of the best turn over those in the other direction,
    without which it means nothing; ratio_sigma: standard deviation of the ratio of two turns, 0.10
    to 0.44 on the recordings of seven robots.
    """

    min_turn_rad: float = 0.15
    max_turn_rad: float = 0.5
    max_path_m: float = 0.5
    step_rad: float = 0.025
    max_ratio: float = 1.5
    max_points: int = 120
    tolerance_m: float = 0.1
    min_share: float = 0.3
    min_lead: float = 0.05
    ratio_sigma: float = 0.5


@dataclass(frozen=True)
class Turns:
    """Sums of turns that were compared, rad.

    odometry: without signs; scans: positive in the direction of the odometry, negative against it.
    squares: sum of the squared turns of the odometry; products: of both; fourth: sum of the fourth
    powers of the odometry's.
    """

    odometry: float = 0.0
    scans: float = 0.0
    squares: float = 0.0
    products: float = 0.0
    fourth: float = 0.0

    def added(self, odometry: float, scans: float) -> 'Turns':
        """The sums with two more turns."""
        return Turns(
            self.odometry + abs(odometry),
            self.scans + math.copysign(1.0, odometry) * scans,
            self.squares + odometry**2,
            self.products + odometry * scans,
            self.fourth + odometry**4,
        )

    def are_opposed(self, ratio_sigma: float) -> bool:
        """Whether the scans turn against the odometry, by three sigmas.

        Their ratio is nearer to -1, of a mirrored laser, than to 0, of unrelated turns.
        """
        if self.squares == 0.0:
            return False
        sigma = ratio_sigma * math.sqrt(self.fourth) / self.squares
        return self.products / self.squares + 3.0 * sigma < -0.5


class TurnComparison:
    """Sums up the turns of scans, found without odometry, and those of the odometry."""

    def __init__(self, config: TurnComparisonConfig | None = None) -> None:
        self._config = config or TurnComparisonConfig()
        self.turns = Turns()
        self._reference: tuple[Scan, Array] | None = None

    @property
    def are_opposed(self) -> bool:
        """Whether the scans turn against the odometry."""
        return self.turns.are_opposed(self._config.ratio_sigma)

    def add(self, scan: Scan, T_odom_base: Array) -> None:
        """Add a scan with the odometry pose (3,) at its stamp."""
        if np.count_nonzero(scan.hit) < MIN_HITS:
            self._reference = None
            return
        if self._reference is None:
            self._reference = (scan, T_odom_base)
            return
        reference, T_odom_reference = self._reference
        moved = se2.between(T_odom_reference, T_odom_base)
        turn = float(moved[2])
        is_near = math.hypot(moved[0], moved[1]) <= self._config.max_path_m
        if is_near and abs(turn) < self._config.min_turn_rad:
            return
        self._reference = (scan, T_odom_base)
        if is_near and abs(turn) <= self._config.max_turn_rad:
            found = self._turn(reference, scan, moved)
            if found is not None:
                self.turns = self.turns.added(turn, found)

    def _turn(self, reference: Scan, scan: Scan, moved: Array) -> float | None:
        """Turn (rad) from a reference to a scan; None if one in the other direction fits as well.

        moved (3,): motion by odometry in between, robot frame.
        """
        config = self._config
        count = math.ceil(config.max_ratio * abs(float(moved[2])) / config.step_rad)
        turns = config.step_rad * np.arange(-count, count + 1, dtype=np.float64)
        points = reference.points_base()
        points = points[:: -(-len(points) // config.max_points)] - moved[:2]
        score = _agreement(points, turns, scan, config)
        best = int(score.argmax())
        opposite = score[:count] if best > count else score[count + 1 :]
        if best == count or score[best] - opposite.max() < config.min_lead:
            return None
        return float(turns[best])


def _agreement(points: Array, turns: Array, scan: Scan, config: TurnComparisonConfig) -> Array:
    """Agreement (K,), 0 to 1, of points (N, 2) with the ranges of a scan for some turns (K,).

    points: in the robot frame of the scan but for its turn; 0 where too few are in view.
    """
    c = np.cos(turns)[:, None]
    s = np.sin(turns)[:, None]
    x = c * points[:, 0] + s * points[:, 1] - scan.T_base_laser[0]
    y = c * points[:, 1] - s * points[:, 0] - scan.T_base_laser[1]
    bearings = np.arctan2(y, x) - scan.T_base_laser[2] - scan.angle_min_rad
    step = scan.angle_increment_rad
    ahead = np.mod(math.copysign(1.0, step) * bearings, 2.0 * math.pi)
    beams: NDArray[np.int64] = np.rint(ahead / max(abs(step), 1e-6)).astype(np.int64)
    is_seen = beams < scan.ranges_m.size
    beams[~is_seen] = 0
    is_seen &= scan.hit[beams]
    off = np.where(is_seen, scan.ranges_m[beams] - np.hypot(x, y), 0.0)
    fits = is_seen / (1.0 + np.square(off / config.tolerance_m))
    seen = np.count_nonzero(is_seen, axis=1)
    return np.where(
        seen >= config.min_share * len(points), fits.sum(axis=1) / np.maximum(seen, 1), 0.0
    )
