"""A scan against the local map: the pose that distances to walls and the motion make most likely.

One sum of squares holds the distance of each point of the scan from the nearest wall, with a Cauchy
kernel, and the motion that is expected, with its covariance. It is minimised by the method of
Levenberg and Marquardt (`least_squares.py`). Where the scan does not fit then, or the motion is too
uncertain for the minimum that is nearest to be the right one, the poses within that uncertainty are
searched (`pose_search.py`), and the likelier one wins.
"""

import math
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import parameter
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.keyframes import inverse
from thinmap_ros.core.slam.least_squares import (
    FITS_SIGMAS,
    SIGMAS,
    contradicted,
    loss,
    minimised,
)
from thinmap_ros.core.slam.local_map import Lattice, LocalMap, LocalMapConfig
from thinmap_ros.core.slam.pose_search import UNSEEN, beam_cost, searched

FEWEST_POINTS = 10
_NEVER = 1e6  # sigmas of the motion beyond which wheels have slipped, where they have not
_UNDECIDED = 2.5  # costs of beams waver by so much along a corridor that says nothing
_SEARCHED_POINTS = 80
_CONTRADICTS = 0.1  # share of a scan that has to lie in the open, for wheels to have slipped


@dataclass(frozen=True)
class MatcherConfig(LocalMapConfig):
    """Parameters of scan matching."""

    match_sigma_m: float = parameter(
        0.05, 'uncertainty of a point on its wall (1 sigma), m', low=0.001, high=1.0
    )
    match_outlier_m: float = parameter(
        0.15, 'points this far from the nearest wall count half, m', low=0.001, high=1.0
    )
    match_least_fit: float = parameter(
        0.6,
        'share of the points near walls below which the surroundings are searched',
        low=0.0,
        high=1.0,
    )
    match_weight: float = parameter(
        1.0, 'what a point says beside the motion: points err together', low=0.001, high=1.0
    )
    slip_m: float = parameter(
        0.2, 'error of the motion where wheels have slipped, m', low=0.001, high=5.0
    )
    slip_rad: float = parameter(
        0.15, 'error of the motion where wheels have slipped, rad', low=0.001, high=3.0
    )


@dataclass(frozen=True, eq=False)
class Match:
    """A pose T_map_base (3,) with the information (3, 3), map frame, of scan and prior together.

    by_scan (3, 3): information of the scan alone; fit: share of the points within
    `match_outlier_m` of a wall; known: share within reach of one; contradicted: share that lies
    where others have seen that nothing is; cost: what was minimised.
    """

    T_map_base: Array
    information: Array
    by_scan: Array
    fit: float
    known: float
    contradicted: float
    cost: float


class Matcher:
    """Finds the pose at which a scan fits a local map."""

    def __init__(self, config: MatcherConfig | None = None) -> None:
        self.config = config or MatcherConfig()

    def match(
        self,
        points_base: Array,
        T_base_laser: Array,
        local_map: LocalMap,
        prior: Array,
        covariance: Array,
    ) -> Match:
        """Pose near a prior (3,) with covariance (3, 3), map frame, that points (N, 2) fit best.

        points_base: in the order of the beams, robot frame; T_base_laser (3,): where the laser is.
        """
        laser = np.ascontiguousarray(T_base_laser[:2])
        lattice = local_map.lattice
        scan = self.weighted(points_base, laser)
        information = inverse(covariance)
        match = self._refined(scan, lattice, prior, prior, information)
        # What lies where nobody has looked yet contradicts nothing: it is new ground, and no slip.
        new_ground = match.contradicted < _CONTRADICTS and match.fit >= 0.5 * match.known
        fits = match.fit >= self.config.match_least_fit or new_ground
        if fits and self._is_near(covariance):
            return match
        # Wheel slip is considered only where no pose that the motion allows explains the scan; then
        # the robot is rather where more of what it sees is known.
        slipped = _NEVER if fits else SIGMAS
        unseen = UNSEEN if fits else 1.0
        start = self._search(scan, lattice, prior, covariance, information, slipped, unseen)
        other = self._refined(scan, lattice, start, prior, information)
        here, there = (
            self._beam_cost(scan, laser, lattice, each, prior, information, slipped)
            for each in (match, other)
        )
        return other if there < here - (_UNDECIDED if fits else 0.0) else match

    def _is_near(self, covariance: Array) -> bool:
        """Whether points at a prior with covariance (3, 3) lie where their walls draw them.

        Where the heading is no better known than after a slip, they do not.
        """
        config = self.config
        sigma_m = math.sqrt(max(covariance[0, 0], covariance[1, 1]))
        sigma_rad = math.sqrt(covariance[2, 2])
        return SIGMAS * sigma_m <= config.match_outlier_m and sigma_rad <= config.slip_rad

    def _beam_cost(
        self,
        scan: Array,
        laser: Array,
        lattice: Lattice,
        match: Match,
        prior: Array,
        information: Array,
        slipped: float,
    ) -> float:
        """Cost of a match (beams and motion), to be compared with that of another one."""
        off = se2.off(match.T_map_base, prior)
        beams = beam_cost(scan, laser, match.T_map_base, lattice, *self._noise)
        return beams + loss(float(off @ information @ off), slipped)

    def weighted(self, points_base: Array, laser: Array) -> Array:
        """A scan as the kernels take it, (N, 5): x, y, weight, and back to the laser.

        Points nearer to each other than a cell see the same piece of wall, and say it once.
        """
        gaps = np.hypot(*np.diff(points_base, axis=0).T)
        ends = np.concatenate([gaps[:1], gaps, gaps[-1:]])
        around = 0.5 * (ends[:-1] + ends[1:])
        weights = self.config.match_weight * np.minimum(around / self.config.match_cell_m, 1.0)
        return np.column_stack([points_base, weights, laser - points_base])

    @property
    def _noise(self) -> tuple[float, float]:
        """Standard deviation, in cells, of a point on its wall, and how many count it half."""
        config = self.config
        return (
            config.match_sigma_m / config.match_cell_m,
            config.match_outlier_m / config.match_sigma_m,
        )

    def _refined(
        self, scan: Array, lattice: Lattice, start: Array, prior: Array, information: Array
    ) -> Match:
        pose, posterior, by_scan, sums = minimised(
            scan, start, prior, information, lattice, *self._noise
        )
        pose[2] = se2.wrap(float(pose[2]))
        total, known, fitting, cost, _ = sums
        through = contradicted(scan, pose, lattice, FITS_SIGMAS * self._noise[0])
        return Match(
            pose, posterior, by_scan, fitting / total, known / total, through / total, cost
        )

    def _search(
        self,
        scan: Array,
        lattice: Lattice,
        prior: Array,
        covariance: Array,
        information: Array,
        slipped: float,
        unseen: float,
    ) -> Array:
        """The pose (3,) within the uncertainty of a prior at which the sum is lowest.

        slipped: so many sigmas off the prior, wheels have slipped as likely as not; unseen: cost of
        a point where nobody has looked yet, for one in the open.
        """
        step_m = 2.0 * self.config.match_cell_m
        sparse = np.ascontiguousarray(scan[:: max(1, len(scan) // _SEARCHED_POINTS)])
        sparse[:, 2] *= len(scan) / len(sparse)
        far = float(np.median(np.hypot(sparse[:, 0], sparse[:, 1])))
        step_rad = min(step_m / max(far, 1.0), 0.1)
        slip = np.array([self.config.slip_m, self.config.slip_m, self.config.slip_rad])
        reach = SIGMAS * np.sqrt(np.diag(covariance) + slip**2)
        steps = np.ceil(reach / [step_m, step_m, step_rad]).astype(np.int64)
        steps = np.minimum(steps, [20, 20, 60])
        sizes = np.array([step_m, step_rad])
        rest = (*self._noise, slipped, unseen)
        return searched(sparse, prior, steps, sizes, information, lattice, *rest)
