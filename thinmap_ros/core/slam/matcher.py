"""A scan against the local map: the pose that distances to walls and the motion make most likely.

One sum of squares holds the distance of each point of the scan from the nearest wall, with a Cauchy
kernel, and the motion that is expected, with its covariance. It is minimised by the method of
Levenberg and Marquardt. In the direction that walls leave open, as along a corridor, what beams met
now and then tells nothing beside the motion (`_open_metric`). Where the scan does not fit then, or
the motion is too uncertain for the minimum that is nearest to be the right one, the poses within
that uncertainty are searched, and the likelier one wins.
Source: Kohlbrecher et al., "A flexible and scalable SLAM system with full 3D motion estimation",
2011, for the smooth map; Zhang, Kaess and Singh, "On degeneracy of optimization-based state
estimation problems", 2016, for directions that are left open; Olson, "Real-time correlative scan
matching", 2009, for the search.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import parameter
from thinmap_ros.core.grid.tiles import NO_TILE, TILE
from thinmap_ros.core.jit import inlined, kernel
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.keyframes import inverse
from thinmap_ros.core.slam.local_map import (
    HERE,
    Lattice,
    LocalMap,
    LocalMapConfig,
    cell_distance,
    interpolated,
    nearest_wall,
    normal_of,
    slot_of,
)

_ROUNDS = 30
_USUAL_LOSS = 1.0
_FITS_SIGMAS = 3.0
_MASK = TILE - 1
_SETTLED = 1e-4  # m and rad: a step that is smaller is the last
_SIGMAS = 3.0  # a search goes as far as the motion is uncertain, so many sigmas
FEWEST_POINTS = 10
_NEVER = 1e6  # sigmas of the motion beyond which wheels have slipped, where they have not
_UNSEEN = 0.5  # cost of a point where nobody has looked yet, for one in the open
_UNDECIDED = 2.5  # costs of beams waver by so much along a corridor that says nothing
_SEARCHED_POINTS = 80
_OFTEN = 3  # hits of a cell that is no chance


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
        scan = self.weighted(points_base)
        information = inverse(covariance)
        match = self._refined(scan, lattice, prior, prior, information)
        fits = match.fit >= self.config.match_least_fit
        if fits and self._is_near(covariance):
            return match
        # Wheel slip is considered only where no pose that the motion allows explains the scan; then
        # the robot is rather where more of what it sees is known.
        slipped = _NEVER if fits else _SIGMAS
        unseen = _UNSEEN if fits else 1.0
        start = self._search(scan, lattice, prior, covariance, information, slipped, unseen)
        other = self._refined(scan, lattice, start, prior, information)
        here, there = (
            self._beam_cost(scan, laser, lattice, each, prior, information, slipped)
            for each in (match, other)
        )
        return other if there < here - (_UNDECIDED if fits else 0.0) else match

    def _is_near(self, covariance: Array) -> bool:
        """Whether points at a prior with covariance (3, 3) lie where their walls draw them."""
        sigma_m = math.sqrt(max(covariance[0, 0], covariance[1, 1]))
        return _SIGMAS * sigma_m <= self.config.match_outlier_m

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
        beams = _beam_cost(scan, laser, match.T_map_base, lattice, *self._noise)
        return beams + _loss(float(off @ information @ off), slipped)

    def weighted(self, points_base: Array) -> Array:
        """A scan as the kernels take it, (N, 3): x, y, weight.

        Points nearer to each other than a cell see the same piece of wall, and say it once.
        """
        gaps = np.hypot(*np.diff(points_base, axis=0).T)
        ends = np.concatenate([gaps[:1], gaps, gaps[-1:]])
        around = 0.5 * (ends[:-1] + ends[1:])
        weights = self.config.match_weight * np.minimum(around / self.config.match_cell_m, 1.0)
        return np.column_stack([points_base, weights])

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
        pose, posterior, by_scan, sums = _minimised(
            scan, start, prior, information, lattice, *self._noise
        )
        pose[2] = se2.wrap(float(pose[2]))
        total, known, fitting, cost, _ = sums
        contradicted = _contradicted(scan, pose, lattice, _FITS_SIGMAS * self._noise[0])
        return Match(
            pose, posterior, by_scan, fitting / total, known / total, contradicted / total, cost
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
        reach = _SIGMAS * np.sqrt(np.diag(covariance) + slip**2)
        steps = np.ceil(reach / [step_m, step_m, step_rad]).astype(np.int64)
        steps = np.minimum(steps, [20, 20, 60])
        sizes = np.array([step_m, step_rad])
        rest = (*self._noise, slipped, unseen)
        return _searched(sparse, prior, steps, sizes, information, lattice, *rest)


@inlined
def prior_weight(squared: float) -> float:
    """Weight of a prior at a pose so many sigmas off, squared: wheels slip now and then."""
    return 1.0 / (1.0 + squared / (_SIGMAS * _SIGMAS))


@inlined
def _loss(squared: float, width: float) -> float:
    """Cauchy's loss of a squared error."""
    return 0.5 * width * width * math.log1p(squared / (width * width))


@inlined
def _tempered(cost: float, weight: float) -> float:
    """A sum of losses of points of a weight, by what it proves.

    Where much of a scan does not fit, as among people, its noise is not what it is taken to be, and
    differences prove less: the likelihood with the scale of the noise unknown.
    """
    return _USUAL_LOSS * weight * math.log1p(cost / (_USUAL_LOSS * weight))


@inlined
def _cell_of(at: float) -> int:
    return int(math.floor(at))


@inlined
def _is_crossed(lattice: Lattice, x0: float, y0: float, x1: float, y1: float) -> bool:
    """Whether a beam from (x0, y0) to (x1, y1), in cells, crosses a wall well before its end."""
    length = math.hypot(x1 - x0, y1 - y0)
    for k in range(1, int(length) - lattice.reach):
        along = k / length
        row, col = _cell_of(y0 + along * (y1 - y0)), _cell_of(x0 + along * (x1 - x0))
        slot = slot_of(lattice, row, col)
        if slot != NO_TILE:
            cell = lattice.pool[slot, row & _MASK, col & _MASK]
            if cell['to_row'] == HERE and cell['to_col'] == HERE and cell['hits'] >= _OFTEN:
                return True
    return False


@inlined
def _is_seen(lattice: Lattice, row: int, col: int) -> bool:
    slot = slot_of(lattice, row, col)
    return slot != NO_TILE and lattice.pool[slot, row & _MASK, col & _MASK]['seen'] > 0


@inlined
def _end_cost(
    lattice: Lattice, row: int, col: int, sigma: float, width: float, unseen: float
) -> float:
    """Cost of a beam that ends in a cell.

    Where nobody has looked yet it costs less than in the open: ahead of a robot that moves there
    are such ends, and a pose farther back, where there are none, would seem the likelier.
    """
    error = cell_distance(lattice, row, col) / sigma
    cost = _loss(error * error, width)
    if error >= lattice.reach / sigma and not _is_seen(lattice, row, col):
        cost *= unseen
    return cost


@kernel
def _beam_cost(
    scan: Array, laser: Array, pose: Array, lattice: Lattice, sigma: float, width: float
) -> float:
    """Cost of the beams of a scan at a pose: their ends, and the walls that they would cross."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    cell_m, reach = lattice.cell_m, float(lattice.reach)
    x0 = (pose[0] + cos * laser[0] - sin * laser[1]) / cell_m - lattice.first_col
    y0 = (pose[1] + sin * laser[0] + cos * laser[1]) / cell_m - lattice.first_row
    gross = _loss((reach / sigma) ** 2, width)
    cost = 0.0
    for i in range(len(scan)):
        x1 = (pose[0] + cos * scan[i, 0] - sin * scan[i, 1]) / cell_m - lattice.first_col
        y1 = (pose[1] + sin * scan[i, 0] + cos * scan[i, 1]) / cell_m - lattice.first_row
        if _is_crossed(lattice, x0, y0, x1, y1):
            cost += scan[i, 2] * gross
        else:
            row, col = _cell_of(y1), _cell_of(x1)
            cost += scan[i, 2] * _end_cost(lattice, row, col, sigma, width, _UNSEEN)
    return _tempered(cost, scan[:, 2].sum())


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
    w = prior_weight(squared)
    return w * by_prior, w * pull, _loss(squared, _SIGMAS)


@inlined
def _is_chance(lattice: Lattice, row: int, col: int) -> bool:
    """Whether the wall nearest to a cell was hardly ever met, and has no direction."""
    slot, row, col = nearest_wall(lattice, row, col)
    if slot == NO_TILE:
        return False
    cell = lattice.pool[slot, row & _MASK, col & _MASK]
    return bool(cell['normal'] == 0 and cell['hits'] < _OFTEN)


@inlined
def _measured(
    d: float, by_x: float, by_y: float, metric: tuple[float, float, float]
) -> tuple[float, float, float]:
    """A distance and its slopes by a metric (xx, xy, yy)."""
    xx, xy, yy = metric
    mx, my = xx * by_x + xy * by_y, xy * by_x + yy * by_y
    squared = by_x * by_x + by_y * by_y
    scale = math.sqrt(max((mx * by_x + my * by_y) / max(squared, 1e-9), 1e-6))
    return scale * d, mx / scale, my / scale


@kernel
def _evaluated(
    scan: Array,
    pose: Array,
    prior: Array,
    by_prior: Array,
    lattice: Lattice,
    sigma: float,
    width: float,
    metric: tuple[float, float, float],
) -> tuple[Array, Array, Array, tuple[float, float, float, float, float]]:
    """Normal equations at a pose, where distances from chance hits are measured by a metric.

    Returns H (3, 3) and g (3,) of scan and prior, the part of H that is the prior's, and: the
    weights of all points, of known and of fitting ones, the cost, and what a point proves.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    cell_m = lattice.cell_m
    sigma_m = sigma * cell_m
    total, known, fitting, cost = 1e-9, 0.0, 0.0, 0.0
    H, g = np.zeros((3, 3)), np.zeros(3)
    far = lattice.reach / sigma
    for i in range(len(scan)):
        px, py = cos * scan[i, 0] - sin * scan[i, 1], sin * scan[i, 0] + cos * scan[i, 1]
        x = (pose[0] + px) / cell_m - lattice.first_col
        y = (pose[1] + py) / cell_m - lattice.first_row
        d, by_x, by_y = interpolated(lattice, x, y)
        off = abs(d) / sigma
        weight = scan[i, 2]
        total += weight
        if off < far:
            known += weight
            if off < _FITS_SIGMAS:
                fitting += weight
            if _is_chance(lattice, _cell_of(y), _cell_of(x)):
                d, by_x, by_y = _measured(d, by_x, by_y, metric)
        error = d / sigma
        cost += weight * _loss(error * error, width)
        if off >= far:
            continue
        w = weight / (1.0 + error * error / (width * width))
        jx, jy = by_x / sigma_m, by_y / sigma_m
        jt = -jx * py + jy * px
        g[0] -= w * jx * error
        g[1] -= w * jy * error
        g[2] -= w * jt * error
        _add_outer(H, w, jx, jy, jt)
    doubt = 1.0 / (1.0 + cost / (_USUAL_LOSS * total))
    _mirror(H)
    of_prior, pull, by_motion = _of_prior(pose, prior, by_prior)
    return (
        doubt * H + of_prior,
        doubt * g - pull,
        of_prior,
        (total, known, fitting, _tempered(cost, total) + by_motion, doubt),
    )


@kernel
def _information(scan: Array, pose: Array, lattice: Lattice, sigma: float, width: float) -> Array:
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
        row = _cell_of((pose[1] + py) / cell_m) - lattice.first_row
        col = _cell_of((pose[0] + px) / cell_m) - lattice.first_col
        error = cell_distance(lattice, row, col) / sigma
        slot, row, col = nearest_wall(lattice, row, col)
        if slot == NO_TILE or error >= _FITS_SIGMAS:
            continue
        nx, ny = normal_of(int(lattice.pool[slot, row & _MASK, col & _MASK]['normal']))
        w = scan[i, 2] / (1.0 + error * error / (width * width))
        jx, jy = nx / sigma_m, ny / sigma_m
        _add_outer(H, w, jx, jy, -jx * py + jy * px)
    _mirror(H)
    return H


@inlined
def _quadratic(A: Array, dx: float, dy: float, turn: float) -> float:
    """Square of (dx, dy, turn) in the metric of a symmetric A (3, 3)."""
    mixed = A[0, 1] * dx * dy + A[0, 2] * dx * turn + A[1, 2] * dy * turn
    square = A[0, 0] * dx * dx + A[1, 1] * dy * dy + A[2, 2] * turn * turn + 2.0 * mixed
    return float(square)


@inlined
def _open_metric(walls: Array, by_prior: Array) -> tuple[float, float, float]:
    """Metric (xx, xy, yy) by which a point is off what beams met once or twice.

    walls, by_prior: information (3, 3) of walls that have a direction, and of the motion. Far down
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
    less = 1.0 - min(1.0, 2.0 * least / (least + _quadratic(by_prior, ux, uy, 0.0)))
    return 1.0 - less * ux * ux, -less * ux * uy, 1.0 - less * uy * uy


@kernel
def _contradicted(scan: Array, pose: Array, lattice: Lattice, far: float) -> float:
    """Weight of the points in cells that were seen through, and are farther than far from walls."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    found = 0.0
    for i in range(len(scan)):
        x = pose[0] + cos * scan[i, 0] - sin * scan[i, 1]
        y = pose[1] + sin * scan[i, 0] + cos * scan[i, 1]
        row = _cell_of(y / lattice.cell_m) - lattice.first_row
        col = _cell_of(x / lattice.cell_m) - lattice.first_col
        if _is_seen(lattice, row, col) and cell_distance(lattice, row, col) >= far:
            found += scan[i, 2]
    return found


@kernel
def _minimised(
    scan: Array,
    start: Array,
    prior: Array,
    by_prior: Array,
    lattice: Lattice,
    sigma: float,
    width: float,
) -> tuple[Array, Array, Array, tuple[float, float, float, float, float]]:
    """Pose (3,), information (3, 3) of scan and prior, of the scan, and sums of `_evaluated`."""
    pose = start.copy()
    walls = _information(scan, prior, lattice, sigma, width)
    rest = (prior, by_prior, lattice, sigma, width, _open_metric(walls, by_prior))
    H, g, of_prior, sums = _evaluated(scan, pose, *rest)
    damping = 1e-3
    for _ in range(_ROUNDS):
        A = H.copy()
        for a in range(3):
            A[a, a] *= 1.0 + damping
        step = np.linalg.solve(A, g)
        tried = pose + step
        new = _evaluated(scan, tried, *rest)
        if new[3][3] < sums[3]:
            pose = tried
            H, g, of_prior, sums = new
            damping = max(damping * 0.1, 1e-6)
        else:
            damping *= 10.0
        if np.abs(step).max() < _SETTLED or damping > 1e3:
            break
    by_scan = sums[4] * _information(scan, pose, lattice, sigma, width)
    return pose, of_prior + by_scan, by_scan, sums


@inlined
def _outwards(n: int) -> int:
    """0, 1, -1, 2, -2 and so on."""
    return (n + 1) // 2 if n % 2 else -(n // 2)


@inlined
def _note_cells(
    scan: Array,
    prior: Array,
    turn: float,
    lattice: Lattice,
    corner_row: int,
    corner_col: int,
    at: NDArray[np.int64],
) -> None:
    """Put the cells (N, 2) of a scan that is turned at a prior into `at`, counted from a corner."""
    cell_m = lattice.cell_m
    cos, sin = math.cos(prior[2] + turn), math.sin(prior[2] + turn)
    for i in range(len(scan)):
        x = prior[0] + cos * scan[i, 0] - sin * scan[i, 1]
        y = prior[1] + sin * scan[i, 0] + cos * scan[i, 1]
        at[i, 0] = _cell_of(y / cell_m) - lattice.first_row - corner_row
        at[i, 1] = _cell_of(x / cell_m) - lattice.first_col - corner_col


@kernel
def _searched(
    scan: Array,
    prior: Array,
    steps: NDArray[np.int64],
    sizes: Array,
    by_prior: Array,
    lattice: Lattice,
    sigma: float,
    width: float,
    slipped: float,
    unseen: float,
) -> Array:
    """The pose (3,) of a lattice round a prior with the lowest sum."""
    cell_m = lattice.cell_m
    stride = int(round(sizes[0] / cell_m))
    # Cost of every cell in sight, once it is asked for.
    rim = int(np.hypot(scan[:, 0], scan[:, 1]).max() / cell_m) + 4 + stride * steps[:2].max()
    corner_row = _cell_of(prior[1] / cell_m) - lattice.first_row - rim
    corner_col = _cell_of(prior[0] / cell_m) - lattice.first_col - rim
    costs = np.full((2 * rim + 1, 2 * rim + 1), np.float32(-1.0))
    best = prior.copy()
    usual = _USUAL_LOSS * scan[:, 2].sum()
    lowest = 700.0 * usual
    at = np.empty((len(scan), 2), dtype=np.int64)
    # From the prior outwards: a low sum that is found early spares the most of the others.
    for k in range(2 * steps[2] + 1):
        turn = _outwards(k) * sizes[1]
        _note_cells(scan, prior, turn, lattice, corner_row, corner_col, at)
        for i in range(2 * steps[1] + 1):
            for j in range(2 * steps[0] + 1):
                a, b = _outwards(i), _outwards(j)
                dx, dy = b * sizes[0], a * sizes[0]
                by_motion = _loss(_quadratic(by_prior, dx, dy, turn), slipped)
                if by_motion >= lowest:
                    continue
                most = usual * math.expm1((lowest - by_motion) / usual)
                cost = 0.0
                for p in range(len(scan)):
                    r, c = at[p, 0] + stride * a, at[p, 1] + stride * b
                    if costs[r, c] < 0.0:
                        row, col = r + corner_row, c + corner_col
                        end = _end_cost(lattice, row, col, sigma, width, unseen)
                        costs[r, c] = np.float32(end)
                    cost += scan[p, 2] * costs[r, c]
                    if cost >= most:
                        break
                if cost < most:
                    lowest = by_motion + usual * math.log1p(cost / usual)
                    best[0], best[1], best[2] = prior[0] + dx, prior[1] + dy, prior[2] + turn
    return best
