"""Scan-to-map matching: maximum a posteriori pose given point-to-wall distances and a motion prior.

The cost is a robust loss of the distance of each point to its nearest wall, plus that of the prior.
Its minimum near the prior is refined (`minimize`). If few points are inliers there, though the map
tells of enough of them, or if the prior is wider than the basin of convergence, the poses within
three sigmas of the prior are searched (`search`). The lower cost is used.

The distance of a point is measured along the wall's normal: a smooth wall has no information along
itself. If the normals of a cell's hits differ, as in a corner, both directions have information.
The Gauss-Newton matrix of the minimum is also the information of the match.
Source: Censi, "An ICP variant using a point-to-line metric", 2008, for the metric; Kohlbrecher et
al., "A flexible and scalable SLAM system with full 3D motion estimation", 2011, for the match with
a map.
"""

import heapq
import math
from dataclasses import dataclass, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.grid.tiles import NO_TILE
from thinmap_ros.core.se2 import BOUND_SIGMAS, Array, inverse, rotated_covariance
from thinmap_ros.core.slam.matching.local_map import (
    TILE_MASK,
    LocalMap,
    LocalMapView,
    cell_of,
    cells_to_wall,
    off_wall,
    slot_of,
)
from thinmap_ros.jit import inlined, kernel

SLIP_SIGMAS = 10.0  # scale of the prior's loss: beyond it, wheel slip is more likely than an error

FITS_SIGMAS = 2.0  # largest distance of an inlier from its wall

_HALF_WALL = 5.0  # extent of a wall to either side of a cell's hits, in cells

UNSEEN_COST = 0.5  # cost of a point in an unobserved cell, as a share of one in free space

_YOUNG_HITS = 1.0  # hits at which a wall has half its weight: moving people are hit once

_BEHIND = -0.1  # cosine to a wall's normal below which a beam comes from behind the wall

_ROUNDS = 20

_SETTLED = 1e-4  # m and rad: a smaller step ends the minimization

_MAX_DAMPING = 1e2


@inlined
def loss(squared: float, width: float) -> float:
    """Cauchy's loss of a squared error."""
    return 0.5 * width * width * math.log1p(squared / (width * width))


@inlined
def far_cost(lattice: LocalMapView, sigma: float, width: float) -> float:
    """Cost of a point in free space, out of reach of any wall."""
    off = lattice.reach * lattice.cell_m / sigma
    return loss(off * off, width)


@inlined
def by_prior(pose: Array, prior: Array, information: Array) -> tuple[Array, float, float]:
    """Gradient (3,), weight and cost at a pose (3,) of a prior (3,) with information (3, 3)."""
    off = pose - prior
    off[2] = math.atan2(math.sin(off[2]), math.cos(off[2]))
    pull = information @ off
    squared = float(off @ pull)
    weight = 1.0 / (1.0 + squared / (SLIP_SIGMAS * SLIP_SIGMAS))
    return weight * pull, weight, loss(squared, SLIP_SIGMAS)


@inlined
def _normal_matrix(cos2: float, sin2: float) -> tuple[float, float, float]:
    """Relative information (xx, xy, yy) of a wall: 1 along its normal, less along the wall."""
    length = math.sqrt(cos2 * cos2 + sin2 * sin2)
    along = ((1.0 - length) / (1.0 + length)) ** 2
    mean = 0.5 * (1.0 + along)
    half = 0.5 * (1.0 - along) / max(length, 1e-6)
    return mean + half * cos2, half * sin2, mean - half * cos2


@kernel
def evaluate(
    scan: Array, pose: Array, lattice: LocalMapView, sigma: float, width: float
) -> tuple[Array, Array, Array]:
    """Normal equations H (3, 3), g (3,) of a scan at a pose (3,), and sums (5,).

    scan (N, 5): x, y, weight, and the direction to the laser; sigma: noise of a point around its
    wall, m; width: of the loss, in sigmas. Sums: cost; weights of all points, of inliers, and of
    points that contradict the map; cost that walls with few hits leave out.
    """
    H = np.zeros((3, 3))
    g = np.zeros(3)
    sums = np.zeros(5)
    cos = math.cos(pose[2])
    sin = math.sin(pose[2])
    cell_m = lattice.cell_m
    scale = cell_m / sigma
    far = far_cost(lattice, sigma, width)
    for i in range(len(scan)):
        px = cos * scan[i, 0] - sin * scan[i, 1]
        py = sin * scan[i, 0] + cos * scan[i, 1]
        weight = scan[i, 2]
        sums[1] += weight
        x = (pose[0] + px) / cell_m - lattice.first_col
        y = (pose[1] + py) / cell_m - lattice.first_row
        is_seen, is_near, dx, dy, hits, wall = off_wall(lattice, x, y)
        if not is_near:
            sums[0] += weight * far * (1.0 if is_seen else UNSEEN_COST)
            sums[3] += weight * is_seen
            continue
        to_x = cos * scan[i, 3] - sin * scan[i, 4]
        to_y = sin * scan[i, 3] + cos * scan[i, 4]
        if wall['face_x'] * to_x + wall['face_y'] * to_y < _BEHIND:
            sums[0] += weight * far * UNSEEN_COST  # the other face is a separate wall
            continue
        w = weight * hits / (hits + _YOUNG_HITS)
        xx, xy, yy = _normal_matrix(wall['cos2'], wall['sin2'])
        ex = xx * dx + xy * dy
        ey = xy * dx + yy * dy
        squared = (dx * ex + dy * ey) * scale * scale
        sums[0] += w * loss(squared, width)
        sums[4] += (weight - w) * far * UNSEEN_COST
        is_beyond = dx * dx + dy * dy > _HALF_WALL * _HALF_WALL
        if squared < FITS_SIGMAS * FITS_SIGMAS and not is_beyond:
            sums[2] += weight
        elif squared > BOUND_SIGMAS * BOUND_SIGMAS or is_beyond:
            sums[3] += weight * is_seen
        w /= (1.0 + squared / (width * width)) * sigma * sigma
        ex = ex * cell_m
        ey = ey * cell_m
        g[0] -= w * ex
        g[1] -= w * ey
        g[2] -= w * (px * ey - py * ex)
        tx = -py * xx + px * xy
        ty = -py * xy + px * yy
        H[0, 0] += w * xx
        H[0, 1] += w * xy
        H[1, 1] += w * yy
        H[0, 2] += w * tx
        H[1, 2] += w * ty
        H[2, 2] += w * (px * ty - py * tx)
    H[1, 0] = H[0, 1]
    H[2, 0] = H[0, 2]
    H[2, 1] = H[1, 2]
    return H, g, sums


@kernel
def minimize(
    scan: Array,
    start: Array,
    prior: Array,
    information: Array,
    lattice: LocalMapView,
    sigma: float,
    width: float,
) -> tuple[Array, Array, Array, float]:
    """Nearest minimum to a start (3,), by the Levenberg-Marquardt method.

    prior (3,), information (3, 3): of the motion; sigma, width: as in `evaluate`. Returns the pose
    (3,), the information (3, 3) of the scan alone, the sums of `evaluate` with the cost of the
    prior, and the weight of the prior.
    """
    pose = start.copy()
    damping = 1e-4
    H, g, sums = evaluate(scan, pose, lattice, sigma, width)
    pull, weight, cost = by_prior(pose, prior, information)
    sums[0] += cost
    for _ in range(_ROUNDS):
        A = H + weight * information
        for i in range(3):
            A[i, i] *= 1.0 + damping
        step = np.linalg.solve(A, g - pull)
        tried = pose + step
        H_new, g_new, new = evaluate(scan, tried, lattice, sigma, width)
        pull_new, weight_new, cost = by_prior(tried, prior, information)
        new[0] += cost
        if new[0] < sums[0]:
            pose = tried
            H = H_new
            g = g_new
            sums = new
            pull = pull_new
            weight = weight_new
            damping = max(0.1 * damping, 1e-6)
        else:
            damping *= 10.0
        if np.abs(step).max() < _SETTLED or damping > _MAX_DAMPING:
            break
    sums[0] += sums[4]
    pose[2] = math.atan2(math.sin(pose[2]), math.cos(pose[2]))
    return pose, H, sums, weight


# Of the search.
_ROOT = 4.0  # half the size of a root node, in cells
_LEVELS = 2  # levels of nodes below the root
_DIAGONAL = 1.4  # largest translation within a node, per half of its size


@inlined
def _cost(
    scan: Array,
    pose: Array | tuple[float, float, float],
    lattice: LocalMapView,
    sigma: float,
    width: float,
    slack: float,
    most: float,
) -> float:
    """Cost of a scan at a pose, with wall distances reduced by a slack, in cells.

    scan (N, 4): x, y, weight, and the factor of the slack. Returns early when the cost exceeds
    `most`.
    """
    scale = lattice.cell_m / sigma
    far = far_cost(lattice, sigma, width)
    cos = math.cos(pose[2])
    sin = math.sin(pose[2])
    cost = 0.0
    for i in range(len(scan)):
        x = pose[0] + cos * scan[i, 0] - sin * scan[i, 1]
        y = pose[1] + sin * scan[i, 0] + cos * scan[i, 1]
        row = cell_of(y / lattice.cell_m) - lattice.first_row
        col = cell_of(x / lattice.cell_m) - lattice.first_col
        slot = slot_of(lattice, row, col)
        share = UNSEEN_COST
        away = np.inf
        if slot != NO_TILE:
            cell = lattice.pool[slot, row & TILE_MASK, col & TILE_MASK]
            share = 1.0 if cell['seen'] > 0 else UNSEEN_COST
            away = cells_to_wall(cell)
        nearest = (away - slack * scan[i, 3]) * scale
        if away == np.inf:
            cost += scan[i, 2] * share * far
        elif nearest > 0.0:
            cost += scan[i, 2] * loss(nearest * nearest, width)
        if cost >= most:
            break
    return cost


@inlined
def _least_by_prior(
    middle: tuple[float, float, float], half: tuple[float, float, float], information: Array
) -> float:
    """Lower bound of the prior's cost in a node: at the point nearest to the prior on each axis.

    middle: centre of the node relative to the prior; half: of its size. Numbers, not arrays: there
    are thousands of nodes, and an array would take longer than all that is done with it.
    """
    x = math.copysign(max(abs(middle[0]) - half[0], 0.0), middle[0])
    y = math.copysign(max(abs(middle[1]) - half[1], 0.0), middle[1])
    turn = math.copysign(max(abs(middle[2]) - half[2], 0.0), middle[2])
    squared = information[0, 0] * x * x + information[1, 1] * y * y
    squared += information[2, 2] * turn * turn + 2.0 * information[0, 1] * x * y
    squared += 2.0 * (information[0, 2] * x + information[1, 2] * y) * turn
    return loss(squared, SLIP_SIGMAS)


@kernel
def search(
    scan: Array,
    prior: Array,
    information: Array,
    half: Array,
    incumbent: Array,
    lattice: LocalMapView,
    sigma: float,
    width: float,
    most_nodes: int,
) -> Array:
    """Pose (3,) of lowest cost around a prior (3,), or the incumbent (3,) if none is lower.

    By branch and bound. The lower bound of a node follows from the distances to the nearest walls:
    a displacement changes a distance by at most its length. A point out of reach of any wall is
    assumed to stay out of reach.
    Source: Olson, "Real-time correlative scan matching", 2009; Hess et al., "Real-time loop closure
    in 2D LIDAR SLAM", 2016, for branch and bound.

    scan (N, 3): x, y, weight; half (3,): half of the search window, m, m, rad, rounded to whole
    root nodes; information (3, 3) of the prior; sigma, width: as in `evaluate`.
    """
    away = np.sqrt(scan[:, 0] ** 2 + scan[:, 1] ** 2)
    radius = max(np.median(away), 1.0)
    moving = np.empty((len(scan), 4))
    moving[:, :3] = scan
    for i in range(len(scan)):
        moving[i, 3] = _DIAGONAL + away[i] / radius
    size = np.array([1.0, 1.0, 1.0 / radius]) * _ROOT * lattice.cell_m
    best = incumbent.copy()
    _, _, cost = by_prior(best, prior, information)
    lowest = cost + _cost(moving, best, lattice, sigma, width, 0.0, np.inf)
    counts = [int(half[k] / (2.0 * size[k]) + 0.5) for k in range(3)]
    children = [
        (0, 2.0 * size[0] * i, 2.0 * size[1] * j, 2.0 * size[2] * m)
        for i in range(-counts[0], counts[0] + 1)
        for j in range(-counts[1], counts[1] + 1)
        for m in range(-counts[2], counts[2] + 1)
    ]
    spent = -len(children)
    heap = [(0.0, 0, 0.0, 0.0, 0.0) for _ in range(0)]
    while True:
        spent += len(children)
        for level, dx, dy, turn in children:
            share = 0.5**level if level < _LEVELS else 0.0  # a leaf is a single pose
            half_size = (share * size[0], share * size[1], share * size[2])
            pose = (prior[0] + dx, prior[1] + dy, prior[2] + turn)
            cost = _least_by_prior((dx, dy, turn), half_size, information)
            if cost < lowest:
                slack = _ROOT * share
                cost += _cost(moving, pose, lattice, sigma, width, slack, lowest - cost)
            if cost < lowest and level < _LEVELS:
                heapq.heappush(heap, (cost, level, dx, dy, turn))
            elif cost < lowest:
                lowest = cost
                best = np.array(pose)
        if len(heap) == 0 or spent > most_nodes:
            break
        bound, level, dx, dy, turn = heapq.heappop(heap)
        if bound >= lowest:
            break
        part = 0.5 ** (level + 1) * size
        children = [
            (level + 1, dx + a * part[0], dy + b * part[1], turn + c * part[2])
            for a in (-1, 1)
            for b in (-1, 1)
            for c in (-1, 1)
        ]
    return best


MIN_POINTS = 10  # of a scan that is matched

_NODES = 1000  # of a search, at the most
_TURNED_NODES = 20_000  # of one of all headings

# Of convergence: within three sigmas of a prior that is narrower, no pose is searched.
_BASIN_M = 0.3
_BASIN_RAD = 0.15


def _reach(covariance: Array) -> Array:
    """Largest error (3,) of a pose with a covariance (3, 3), m, m, rad."""
    return BOUND_SIGMAS * np.sqrt(np.diag(covariance))


@dataclass(frozen=True)
class MatchingConfig(Config):
    """Parameters of scan matching.

    Besides the parameters: wheel_slip (m, m, rad), standard deviations of a pose after wheels have
    slipped: how far is searched then; poses are searched within three sigmas of the prior and
    max_search (m, m, rad) to either side, with search_points points.
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
    max_search: tuple[float, float, float] = (3.0, 3.0, 1.5)
    search_points: int = 90

    def is_wide(self, covariance: Array) -> bool:
        """Whether a prior with this covariance (3, 3) reaches beyond the basin of convergence."""
        reach = _reach(covariance)
        return bool(reach[:2].max() > _BASIN_M or reach[2] > _BASIN_RAD)


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
        is_turned: bool = False,
    ) -> Match:
        """Match a scan with a local map, given a prior (3,) with covariance (3, 3), in its frame.

        points (N, 5): surface points, robot frame; T_base_laser (3,): pose of the laser; is_turned:
        the robot may have turned by any angle that the prior does not know.
        """
        scan = weighted_points(points, T_base_laser, local_map.config.resolution_m)
        information = inverse(covariance)
        match = self._refined(scan, local_map, prior, prior, information)
        # Points outside of the map fit nowhere, and do not say that the pose is wrong.
        told = (match.inlier_ratio + match.contradiction_ratio) * len(points)
        fits_badly = match.inlier_ratio < self.config.min_inlier_ratio and told >= MIN_POINTS
        if not fits_badly and not self.config.is_wide(covariance):
            return match
        if fits_badly:  # wheels may have slipped
            covariance = covariance + np.diag(np.square(self.config.wheel_slip))
        half = self.searched(covariance)
        nodes = _NODES
        if is_turned:
            half[2] = math.pi
            nodes = _TURNED_NODES
        start = search(
            _thinned(scan, self.config.search_points),
            prior,
            information,
            half,
            match.pose,
            local_map.lattice,
            *self._noise,
            nodes,
        )
        other = self._refined(scan, local_map, start, prior, information)
        return other if other.cost < match.cost else match

    def searched(self, covariance: Array) -> Array:
        """Half of the window (3,) that is searched around a prior with a covariance (3, 3)."""
        return np.minimum(_reach(covariance), self.config.max_search)

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
