"""Scan-to-map matching: maximum a posteriori pose given point-to-wall distances and a motion prior.

The cost is a robust loss of the distance of each point to its nearest wall, plus that of the prior.
Its minimum near the prior is refined (`matching_cost.py`). If few points are inliers there, or if
the prior is wider than the basin of convergence, the poses within three sigmas of the prior are
searched (`correlative_search.py`). The lower cost is used.
"""

from dataclasses import dataclass, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.se2 import Array, inverse, rotated_covariance
from thinmap_ros.core.slam.matching.correlative_search import search
from thinmap_ros.core.slam.matching.local_map import LocalMap
from thinmap_ros.core.slam.matching.matching_cost import minimize

MIN_POINTS = 10


@dataclass(frozen=True)
class MatchingConfig(Config):
    """Parameters of scan matching.

    Besides the parameters: wheel_slip (m, m, rad), standard deviations of a pose after wheels have
    slipped: how far is searched then; poses are searched within search_sigmas of the prior and
    max_search (m, m, rad) to either side, with search_points points and at most search_nodes nodes;
    basin (m, rad) of convergence, compared with these sigmas of the prior.
    """

    noise_m: float = parameter(
        0.05,
        'Standard deviation of a scan point around its wall (m): by rough walls, cells of the map '
        'and the bend of a sweep more than by laser_range_noise_m. Raise it for a noisy laser or '
        'rough walls, lower it to trust scans more than odometry.',
        low=0.001,
        high=1.0,
    )
    kernel_scale_m: float = parameter(
        0.15,
        'Distance from its wall at which a point has half its weight (m). Raise it if the robot '
        'loses its pose in fast turns, lower it where many points belong to people.',
        low=0.001,
        high=1.0,
    )
    min_inlier_ratio: float = parameter(
        0.6,
        'Ratio of inliers below which poses around the prediction are searched. Raise it to search '
        'more often, lower it in crowds.',
        low=0.0,
        high=1.0,
    )
    wheel_slip: tuple[float, float, float] = (0.2, 0.2, 0.15)
    search_sigmas: float = 3.0
    max_search: tuple[float, float, float] = (3.0, 3.0, 1.5)
    search_points: int = 90
    search_nodes: int = 1000
    basin: tuple[float, float] = (0.3, 0.15)

    def is_wide(self, covariance: Array) -> bool:
        """Whether a prior with this covariance (3, 3) reaches beyond the basin of convergence."""
        reach = self.search_sigmas * np.sqrt(np.diag(covariance))
        return bool(reach[:2].max() > self.basin[0] or reach[2] > self.basin[1])


@dataclass(frozen=True, eq=False)
class Match:
    """Posterior pose (3,) with covariance (3, 3), frame of the local map, of scan and prior.

    scan_information (3, 3): of the scan alone; inlier_ratio: of points on walls;
    contradiction_ratio: of points in cells observed to be free; cost: the minimum; prior_weight:
    robust weight of the prior, below 1 if the pose is an outlier to it.
    """

    pose: Array
    covariance: Array
    scan_information: Array
    inlier_ratio: float
    contradiction_ratio: float
    cost: float
    prior_weight: float

    def seen_from(self, T_map_frame: Array) -> 'Match':
        """The match in another frame, whose pose in the frame of the local map is given (3,)."""
        yaw = -float(T_map_frame[2])
        return replace(
            self,
            pose=se2.between(T_map_frame, self.pose),
            covariance=rotated_covariance(self.covariance, yaw),
            scan_information=rotated_covariance(self.scan_information, yaw),
        )


class Matcher:
    """Matches scans with a local map."""

    def __init__(self, config: MatchingConfig | None = None) -> None:
        self.config = config or MatchingConfig()

    def match(
        self,
        points: Array,
        T_base_laser: Array,
        local_map: LocalMap,
        prior: Array,
        covariance: Array,
    ) -> Match:
        """Match a scan with a local map, given a prior (3,) with covariance (3, 3), in its frame.

        points (N, 5): surface points, robot frame; T_base_laser (3,): pose of the laser.
        """
        scan = weighted_points(points, T_base_laser, local_map.config.resolution_m)
        information = inverse(covariance)
        match = self._refined(scan, local_map, prior, prior, information)
        reach = self.config.search_sigmas * np.sqrt(np.diag(covariance))
        fits_badly = match.inlier_ratio < self.config.min_inlier_ratio
        if not fits_badly and not self.config.is_wide(covariance):
            return match
        if fits_badly:  # wheels may have slipped
            reach = self.config.search_sigmas * np.sqrt(
                np.diag(covariance) + np.square(self.config.wheel_slip)
            )
        start = search(
            _thinned(scan, self.config.search_points),
            prior,
            information,
            np.minimum(reach, self.config.max_search),
            match.pose,
            local_map.lattice,
            *self._noise,
            self.config.search_nodes,
        )
        other = self._refined(scan, local_map, start, prior, information)
        return other if other.cost < match.cost else match

    @property
    def _noise(self) -> tuple[float, float]:
        """Standard deviation of a point around its wall, m, and the width of the loss, sigmas."""
        config = self.config
        return config.noise_m, config.kernel_scale_m / config.noise_m

    def _refined(
        self, scan: Array, local_map: LocalMap, start: Array, prior: Array, information: Array
    ) -> Match:
        pose, summed_information, sums, weight = minimize(
            scan, start, prior, information, local_map.lattice, *self._noise
        )
        scan_information = semidefinite(summed_information)
        cost, total, fitting, in_the_open, _ = sums.tolist()
        covariance = np.linalg.inv(scan_information + weight * information)
        return Match(
            pose,
            np.asarray(covariance),
            scan_information,
            fitting / max(total, 1e-9),
            in_the_open / max(total, 1e-9),
            cost,
            weight,
        )


def weighted_points(points: Array, T_base_laser: Array, resolution_m: float) -> Array:
    """Points (N, 5) of a scan for the kernels: x, y, weight, and unit direction (2) to the laser.

    points (N, 5): surface points, robot frame. Points closer together than one cell are redundant
    and share their weight.
    """
    weights = np.minimum(points[:, 4] / resolution_m, 1.0)
    back = T_base_laser[:2] - points[:, :2]
    back /= np.maximum(np.hypot(back[:, 0], back[:, 1]), 1e-6)[:, None]
    return np.column_stack([points[:, :2], weights, back])


def _thinned(scan: Array, count: int) -> Array:
    """Subsample of a scan (M, 3) with the total weight of all its points."""
    sparse = np.ascontiguousarray(scan[:: max(1, len(scan) // count), :3])
    sparse[:, 2] *= len(scan) / len(sparse)
    return sparse


def semidefinite(information: Array) -> Array:
    """Information (3, 3) without negative eigenvalues.

    They are rounding errors of a scan that knows nothing in one direction. Added to the information
    of a prior that knows nothing either, they would make a negative variance.
    """
    values, directions = np.linalg.eigh(information)
    if values[0] >= 0.0:
        return information
    return np.asarray((directions * np.maximum(values, 0.0)) @ directions.T)
