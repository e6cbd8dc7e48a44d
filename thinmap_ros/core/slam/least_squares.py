"""The sum of squares that a match minimises: distances of points from walls, and the motion.

In a direction that is degenerate, as along a corridor, isolated hits tell nothing beside the
motion (`degeneracy_metric`).
Source: Kohlbrecher et al., "A flexible and scalable SLAM system with full 3D motion estimation",
2011, for the smooth map; Zhang, Kaess and Singh, "On degeneracy of optimization-based state
estimation problems", 2016, for degenerate directions.
"""

import math

import numpy as np

from thinmap_ros.core.grid.tiles import NO_TILE, TILE
from thinmap_ros.core.jit import inlined, kernel
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.local_map import (
    Lattice,
    cell_distance,
    cell_of,
    interpolated,
    nearest_wall,
    normal_of,
    slot_of,
)

USUAL_LOSS = 1.0
FITS_SIGMAS = 3.0
SIGMAS = 3.0  # of the motion, beyond which wheels have slipped
RELIABLE_HITS = 3  # of a cell that is a wall for sure
_ROUNDS = 30
_SETTLED = 1e-4  # m and rad: a step that is smaller is the last
_MASK = TILE - 1


@inlined
def _prior_weight(squared: float) -> float:
    """Weight of a prior at a pose so many sigmas off, squared: wheels slip now and then."""
    return 1.0 / (1.0 + squared / (SIGMAS * SIGMAS))


@inlined
def loss(squared: float, width: float) -> float:
    """Cauchy's loss of a squared error."""
    return 0.5 * width * width * math.log1p(squared / (width * width))


@inlined
def tempered(cost: float, weight: float) -> float:
    """A sum of losses of points of a weight, by what it proves.

    Where much of a scan does not fit, as among people, its noise is not what it is taken to be, and
    differences prove less: the likelihood with the scale of the noise unknown.
    """
    return USUAL_LOSS * weight * math.log1p(cost / (USUAL_LOSS * weight))


@inlined
def is_seen(lattice: Lattice, row: int, col: int) -> bool:
    """Whether a beam has met a cell, or gone through it."""
    slot = slot_of(lattice, row, col)
    return slot != NO_TILE and lattice.pool[slot, row & _MASK, col & _MASK]['seen'] > 0


@inlined
def _add_outer(H: Array, w: float, jx: float, jy: float, jt: float) -> None:
    """Add w times the product of (jx, jy, jt) with itself to the upper half of H (3, 3)."""
    H[0, 0] += w * jx * jx
    H[0, 1] += w * jx * jy
    H[0, 2] += w * jx * jt
    H[1, 1] += w * jy * jy
    H[1, 2] += w * jy * jt
    H[2, 2] += w * jt * jt


@inlined
def _mirror(H: Array) -> None:
    """Fill the lower half of a symmetric matrix."""
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]


@inlined
def _of_prior(pose: Array, prior: Array, by_prior: Array) -> tuple[Array, Array, float]:
    """Information (3, 3) that the prior has left at a pose (3,), its pull (3,), and its cost."""
    turn = math.atan2(math.sin(pose[2] - prior[2]), math.cos(pose[2] - prior[2]))
    off = np.array([pose[0] - prior[0], pose[1] - prior[1], turn])
    pull = by_prior @ off
    squared = off @ pull
    w = _prior_weight(squared)
    return w * by_prior, w * pull, loss(squared, SIGMAS)


@inlined
def _is_isolated(lattice: Lattice, row: int, col: int) -> bool:
    """Whether the wall nearest to a cell was met once or twice, and has no normal."""
    slot, row, col = nearest_wall(lattice, row, col)
    if slot == NO_TILE:
        return False
    cell = lattice.pool[slot, row & _MASK, col & _MASK]
    return bool(cell['normal'] == 0 and cell['hits'] < RELIABLE_HITS)


@inlined
def _is_behind(lattice: Lattice, row: int, col: int, to_x: float, to_y: float) -> bool:
    """Whether the wall nearest to a cell was seen only from the other side than by a beam.

    to_x, to_y: back along the beam. The two faces of a wall are two walls.
    """
    slot, row, col = nearest_wall(lattice, row, col)
    if slot == NO_TILE:
        return False
    nx, ny = normal_of(int(lattice.pool[slot, row & _MASK, col & _MASK]['normal']))
    return nx * to_x + ny * to_y < 0.0


@inlined
def _distance(
    lattice: Lattice, x: float, y: float, metric: tuple[float, float, float]
) -> tuple[float, float, float, float]:
    """Distance at (x, y), in cells, as it is, by a metric (xx, xy, yy), and slopes by that.

    Only isolated hits are measured by the metric.
    """
    d, by_x, by_y = interpolated(lattice, x, y)
    if abs(d) >= lattice.reach or not _is_isolated(lattice, cell_of(y), cell_of(x)):
        return abs(d), d, by_x, by_y
    xx, xy, yy = metric
    mx, my = xx * by_x + xy * by_y, xy * by_x + yy * by_y
    squared = by_x * by_x + by_y * by_y
    scale = math.sqrt(max((mx * by_x + my * by_y) / max(squared, 1e-9), 1e-6))
    return abs(d), scale * d, mx / scale, my / scale


@kernel
def evaluated(
    scan: Array,
    pose: Array,
    prior: Array,
    by_prior: Array,
    lattice: Lattice,
    sigma: float,
    width: float,
    metric: tuple[float, float, float],
) -> tuple[Array, Array, Array, tuple[float, float, float, float, float]]:
    """Normal equations at a pose, where distances from isolated hits are measured by a metric.

    Returns H (3, 3) and g (3,) of scan and prior, the part of H that is the prior's, and: the
    weights of all points, of known and of fitting ones, the cost, and what a point proves.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    cell_m, sigma_m = lattice.cell_m, sigma * lattice.cell_m
    total, known, fitting, cost = 1e-9, 0.0, 0.0, 0.0
    H, g = np.zeros((3, 3)), np.zeros(3)
    for i in range(len(scan)):
        px, py = cos * scan[i, 0] - sin * scan[i, 1], sin * scan[i, 0] + cos * scan[i, 1]
        x = (pose[0] + px) / cell_m - lattice.first_col
        y = (pose[1] + py) / cell_m - lattice.first_row
        off, d, by_x, by_y = _distance(lattice, x, y, metric)
        error = d / sigma
        weight = scan[i, 2]
        total += weight
        cost += weight * loss(error * error, width)
        if off >= lattice.reach:
            continue
        to_x, to_y = cos * scan[i, 3] - sin * scan[i, 4], sin * scan[i, 3] + cos * scan[i, 4]
        if _is_behind(lattice, cell_of(y), cell_of(x), to_x, to_y):
            continue
        known += weight
        if off < FITS_SIGMAS * sigma:
            fitting += weight
        w = weight / (1.0 + error * error / (width * width))
        jx, jy = by_x / sigma_m, by_y / sigma_m
        jt = -jx * py + jy * px
        g[0] -= w * jx * error
        g[1] -= w * jy * error
        g[2] -= w * jt * error
        _add_outer(H, w, jx, jy, jt)
    doubt = 1.0 / (1.0 + cost / (USUAL_LOSS * total))
    _mirror(H)
    of_prior, pull, by_motion = _of_prior(pose, prior, by_prior)
    return (
        doubt * H + of_prior,
        doubt * g - pull,
        of_prior,
        (total, known, fitting, tempered(cost, total) + by_motion, doubt),
    )


@kernel
def information(scan: Array, pose: Array, lattice: Lattice, sigma: float, width: float) -> Array:
    """Information (3, 3) of the points of a scan on its pose, by the normals of the walls.

    The slope of the distance is no measure of it: along a wall it wavers, and would tell a pose
    along a corridor that the scan does not know.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    cell_m = lattice.cell_m
    sigma_m = sigma * cell_m
    H = np.zeros((3, 3))
    for i in range(len(scan)):
        px, py = cos * scan[i, 0] - sin * scan[i, 1], sin * scan[i, 0] + cos * scan[i, 1]
        row = cell_of((pose[1] + py) / cell_m) - lattice.first_row
        col = cell_of((pose[0] + px) / cell_m) - lattice.first_col
        error = cell_distance(lattice, row, col) / sigma
        slot, row, col = nearest_wall(lattice, row, col)
        if slot == NO_TILE or error >= FITS_SIGMAS:
            continue
        nx, ny = normal_of(int(lattice.pool[slot, row & _MASK, col & _MASK]['normal']))
        to_x, to_y = cos * scan[i, 3] - sin * scan[i, 4], sin * scan[i, 3] + cos * scan[i, 4]
        if nx * to_x + ny * to_y < 0.0:
            continue
        w = scan[i, 2] / (1.0 + error * error / (width * width))
        jx, jy = nx / sigma_m, ny / sigma_m
        _add_outer(H, w, jx, jy, -jx * py + jy * px)
    _mirror(H)
    return H


@inlined
def quadratic(A: Array, dx: float, dy: float, turn: float) -> float:
    """Square of (dx, dy, turn) in the metric of a symmetric A (3, 3)."""
    mixed = A[0, 1] * dx * dy + A[0, 2] * dx * turn + A[1, 2] * dy * turn
    square = A[0, 0] * dx * dx + A[1, 1] * dy * dy + A[2, 2] * turn * turn + 2.0 * mixed
    return float(square)


@inlined
def degeneracy_metric(walls: Array, by_prior: Array) -> tuple[float, float, float]:
    """Metric (xx, xy, yy) by which a point is off isolated hits.

    walls, by_prior: information (3, 3) of walls that have a normal, and of the motion. Far down
    a corridor beams meet the walls here and there, in a pattern that moves with the robot: matched,
    it says that the robot stays. So in the direction that walls tell worst such hits count by twice
    the share that walls have in what walls and motion tell: fully where the walls tell as much as
    the motion, not at all where they tell nothing. Across it they count fully.
    """
    turn = max(walls[2, 2] + by_prior[2, 2], 1e-12)
    xx = walls[0, 0] - walls[0, 2] * walls[0, 2] / turn
    xy = walls[0, 1] - walls[0, 2] * walls[1, 2] / turn
    yy = walls[1, 1] - walls[1, 2] * walls[1, 2] / turn
    least = 0.5 * (xx + yy) - math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    along = 0.5 * math.atan2(2.0 * xy, xx - yy) + 0.5 * math.pi
    ux, uy = math.cos(along), math.sin(along)
    least = max(least, 1e-12)
    less = 1.0 - min(1.0, 2.0 * least / (least + quadratic(by_prior, ux, uy, 0.0)))
    return 1.0 - less * ux * ux, -less * ux * uy, 1.0 - less * uy * uy


@kernel
def contradicted(scan: Array, pose: Array, lattice: Lattice, far: float) -> float:
    """Weight of the points in cells that were seen through, and are farther than far from walls."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    found = 0.0
    for i in range(len(scan)):
        x = pose[0] + cos * scan[i, 0] - sin * scan[i, 1]
        y = pose[1] + sin * scan[i, 0] + cos * scan[i, 1]
        row = cell_of(y / lattice.cell_m) - lattice.first_row
        col = cell_of(x / lattice.cell_m) - lattice.first_col
        if is_seen(lattice, row, col) and cell_distance(lattice, row, col) >= far:
            found += scan[i, 2]
    return found


@kernel
def minimised(
    scan: Array,
    start: Array,
    prior: Array,
    by_prior: Array,
    lattice: Lattice,
    sigma: float,
    width: float,
) -> tuple[Array, Array, Array, tuple[float, float, float, float, float]]:
    """Pose (3,), information (3, 3) of scan and prior, of the scan, and sums of `evaluated`."""
    pose = start.copy()
    walls = information(scan, prior, lattice, sigma, width)
    rest = (prior, by_prior, lattice, sigma, width, degeneracy_metric(walls, by_prior))
    H, g, of_prior, sums = evaluated(scan, pose, *rest)
    damping = 1e-3
    for _ in range(_ROUNDS):
        A = H.copy()
        for a in range(3):
            A[a, a] *= 1.0 + damping
        step = np.linalg.solve(A, g)
        tried = pose + step
        new = evaluated(scan, tried, *rest)
        if new[3][3] < sums[3]:
            pose = tried
            H, g, of_prior, sums = new
            damping = max(damping * 0.1, 1e-6)
        else:
            damping *= 10.0
        if np.abs(step).max() < _SETTLED or damping > 1e3:
            break
    by_scan = sums[4] * information(scan, pose, lattice, sigma, width)
    return pose, of_prior + by_scan, by_scan, sums
