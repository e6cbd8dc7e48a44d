"""Cost function of scan matching: point-to-wall distances and the motion prior.

The distance of a point is measured along the wall's normal: a smooth wall has no information along
itself. If the normals of a cell's hits differ, as in a corner, both directions have information.
The Gauss-Newton matrix of the minimum is also the information of the match.
Source: Censi, "An ICP variant using a point-to-line metric", 2008, for the metric; Kohlbrecher et
al., "A flexible and scalable SLAM system with full 3D motion estimation", 2011, for the match with
a map.
"""

import math

import numpy as np

from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.matching.local_map import LocalMapView, off_wall
from thinmap_ros.jit import inlined, kernel

SLIP_SIGMAS = 10.0  # scale of the prior's loss: beyond it, wheel slip is more likely than an error
FITS_SIGMAS = 2.0  # largest distance of an inlier from its wall
_OFF_SIGMAS = 3.0  # smallest distance of a point that contradicts the map
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
        elif squared > _OFF_SIGMAS * _OFF_SIGMAS or is_beyond:
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
