"""A scan against the local map: the pose that distances to walls and the motion make most likely.

One sum of squares holds the distance of each point of the scan from the nearest wall, with a Cauchy
kernel, and the motion that is expected, with its covariance. It is minimised by the method of
Levenberg and Marquardt. Where the scan does not fit then, the poses within the uncertainty of the
motion are searched, and the lower sum wins.
Source: Kohlbrecher et al., "A flexible and scalable SLAM system with full 3D motion estimation",
2011, for the smooth map; Olson, "Real-time correlative scan matching", 2009, for the search.
"""

import math
from dataclasses import dataclass
from typing import Any

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
    LocalMap,
    LocalMapConfig,
    cell_distance,
    interpolated,
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
_SEARCHED_POINTS = 80


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
        scan = self.weighted(points_base)
        information = inverse(covariance)
        match = self._refined(scan, local_map, prior, prior, information)
        if match.fit >= self.config.match_least_fit:
            return match
        start = self._search(scan, local_map, prior, covariance, information)
        other = self._refined(scan, local_map, start, prior, information)
        return min(
            match,
            other,
            key=lambda each: self._beam_cost(scan, laser, local_map, each, prior, information),
        )

    def _beam_cost(
        self,
        scan: Array,
        laser: Array,
        local_map: LocalMap,
        match: Match,
        prior: Array,
        information: Array,
    ) -> float:
        """Cost of a match (beams and motion), to be compared with that of another one."""
        off = se2.off(match.T_map_base, prior)
        config = self.config
        beams = _beam_cost(
            scan,
            laser,
            match.T_map_base,
            *local_map.lattice,
            config.match_sigma_m,
            config.match_outlier_m,
        )
        return beams + _loss(float(off @ information @ off), _SIGMAS)

    def weighted(self, points_base: Array) -> Array:
        """A scan as the kernels take it, (N, 3): x, y, weight.

        Points nearer to each other than a cell see the same piece of wall, and say it once.
        """
        gaps = np.hypot(*np.diff(points_base, axis=0).T)
        ends = np.concatenate([gaps[:1], gaps, gaps[-1:]])
        around = 0.5 * (ends[:-1] + ends[1:])
        weights = self.config.match_weight * np.minimum(around / self.config.match_cell_m, 1.0)
        return np.column_stack([points_base, weights])

    def _refined(
        self, scan: Array, local_map: LocalMap, start: Array, prior: Array, information: Array
    ) -> Match:
        config = self.config
        pose, posterior, slopes, sums = _minimised(
            scan,
            start,
            prior,
            information,
            *local_map.lattice,
            config.match_sigma_m,
            config.match_outlier_m,
        )
        pose[2] = se2.wrap(float(pose[2]))
        total, known, fitting, cost, doubt = sums
        lattice = local_map.lattice
        by_scan = doubt * _information(
            scan, pose, *lattice, config.match_sigma_m, config.match_outlier_m
        )
        by_prior = posterior - slopes
        posterior = by_prior + by_scan
        total = max(total, 1e-9)
        contradicted = _contradicted(
            scan,
            pose,
            *local_map.lattice,
            _FITS_SIGMAS * config.match_sigma_m / config.match_cell_m,
        )
        return Match(
            pose, posterior, by_scan, fitting / total, known / total, contradicted / total, cost
        )

    def _search(
        self,
        scan: Array,
        local_map: LocalMap,
        prior: Array,
        covariance: Array,
        information: Array,
    ) -> Array:
        """The pose (3,) within the uncertainty of a prior at which the sum is lowest."""
        step_m = 2.0 * self.config.match_cell_m
        sparse = np.ascontiguousarray(scan[:: max(1, len(scan) // _SEARCHED_POINTS)])
        sparse[:, 2] *= len(scan) / len(sparse)
        far = float(np.median(np.hypot(sparse[:, 0], sparse[:, 1])))
        step_rad = min(step_m / max(far, 1.0), 0.1)
        slip = np.array([self.config.slip_m, self.config.slip_m, self.config.slip_rad])
        reach_ = _SIGMAS * np.sqrt(np.diag(covariance) + slip**2)
        steps = np.ceil(reach_ / [step_m, step_m, step_rad]).astype(np.int64)
        steps = np.minimum(steps, [20, 20, 60])
        return _searched(
            sparse,
            prior,
            steps,
            np.array([step_m, step_rad]),
            information,
            *local_map.lattice,
            self.config.match_sigma_m,
            self.config.match_outlier_m,
        )


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


@kernel
def _beam_cost(
    scan: Array,
    laser: Array,
    pose: Array,
    pool: NDArray[Any],
    directory: NDArray[np.int32],
    first: NDArray[np.int64],
    cell_m: float,
    reach: int,
    sigma: float,
    outlier: float,
) -> float:
    """Cost of the beams of a scan at a pose: their ends, and the walls that they would cross.

    An end where nobody has looked yet costs half as much as one in the open.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x0 = (pose[0] + cos * laser[0] - sin * laser[1]) / cell_m - first[1]
    y0 = (pose[1] + sin * laser[0] + cos * laser[1]) / cell_m - first[0]
    width = outlier / sigma
    gross = _loss((reach * cell_m / sigma) ** 2, width)
    cost = 0.0
    for i in range(len(scan)):
        x1 = (pose[0] + cos * scan[i, 0] - sin * scan[i, 1]) / cell_m - first[1]
        y1 = (pose[1] + sin * scan[i, 0] + cos * scan[i, 1]) / cell_m - first[0]
        length = math.hypot(x1 - x0, y1 - y0)
        steps = int(length)
        crossed = False
        for k in range(1, steps - reach):
            along = k / length
            row = int(math.floor(y0 + along * (y1 - y0)))
            col = int(math.floor(x0 + along * (x1 - x0)))
            slot = slot_of(directory, row, col)
            if slot == NO_TILE:
                continue
            cell = pool[slot, row & _MASK, col & _MASK]
            if cell['to_row'] == HERE and cell['to_col'] == HERE and cell['hits'] >= 3:
                crossed = True
                break
        if crossed:
            cost += scan[i, 2] * gross
            continue
        row, col = int(math.floor(y1)), int(math.floor(x1))
        d = cell_distance(pool, directory, row, col, float(reach))
        if d < reach:
            error = d * cell_m / sigma
            cost += scan[i, 2] * _loss(error * error, width)
            continue
        slot = slot_of(directory, row, col)
        unseen = slot == NO_TILE or pool[slot, row & _MASK, col & _MASK]['seen'] == 0
        cost += scan[i, 2] * gross * (0.5 if unseen else 1.0)
    return _tempered(cost, scan[:, 2].sum())


@kernel
def _evaluated(
    scan: Array,
    pose: Array,
    prior: Array,
    by_prior: Array,
    pool: NDArray[Any],
    directory: NDArray[np.int32],
    first: NDArray[np.int64],
    cell_m: float,
    reach: int,
    sigma: float,
    outlier: float,
    H: Array,
    H_scan: Array,
    g: Array,
) -> tuple[float, float, float, float, float]:
    """Normal equations at a pose.

    Returns the weights of all points, of known and of fitting ones, the cost, and what a point
    proves.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    total, known, fitting, cost = 0.0, 0.0, 0.0, 0.0
    H_scan[:] = 0.0
    g[:] = 0.0
    width = outlier / sigma
    far = float(reach)
    j = np.empty(3)
    for i in range(len(scan)):
        px = cos * scan[i, 0] - sin * scan[i, 1]
        py = sin * scan[i, 0] + cos * scan[i, 1]
        x = (pose[0] + px) / cell_m - first[1]
        y = (pose[1] + py) / cell_m - first[0]
        d, by_x, by_y = interpolated(pool, directory, x, y, far)
        weight = scan[i, 2]
        total += weight
        error = d * cell_m / sigma
        cost += weight * _loss(error * error, width)
        if d >= far:
            continue
        known += weight
        if error < _FITS_SIGMAS:
            fitting += weight
        w = weight / (1.0 + error * error / (width * width))
        j[0], j[1] = by_x / sigma, by_y / sigma
        j[2] = (-by_x * py + by_y * px) / sigma
        for a in range(3):
            g[a] -= w * j[a] * error
            for b in range(a + 1):
                H_scan[a, b] += w * j[a] * j[b]
    H_scan[0, 1], H_scan[0, 2], H_scan[1, 2] = H_scan[1, 0], H_scan[2, 0], H_scan[2, 1]
    doubt = 1.0 / (1.0 + cost / (_USUAL_LOSS * total))
    cost = _tempered(cost, total)
    for a in range(3):
        g[a] *= doubt
        for b in range(3):
            H_scan[a, b] *= doubt
    turn = math.atan2(math.sin(pose[2] - prior[2]), math.cos(pose[2] - prior[2]))
    off = np.array([pose[0] - prior[0], pose[1] - prior[1], turn])
    pull = by_prior @ off
    squared = off @ pull
    w = prior_weight(squared)
    cost += _loss(squared, _SIGMAS)
    for a in range(3):
        g[a] -= w * pull[a]
        for b in range(3):
            H[a, b] = H_scan[a, b] + w * by_prior[a, b]
    return total, known, fitting, cost, doubt


@kernel
def _information(
    scan: Array,
    pose: Array,
    pool: NDArray[Any],
    directory: NDArray[np.int32],
    first: NDArray[np.int64],
    cell_m: float,
    reach: int,
    sigma: float,
    outlier: float,
) -> Array:
    """Information (3, 3) that the points of a scan hold on its pose, by the normals of the walls.

    The slope of the distance is no measure of it: along a wall it wavers with the means of the
    cells, and would tell a pose along a corridor that the scan does not know.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    H = np.zeros((3, 3))
    j = np.empty(3)
    for i in range(len(scan)):
        px = cos * scan[i, 0] - sin * scan[i, 1]
        py = sin * scan[i, 0] + cos * scan[i, 1]
        x, y = (pose[0] + px) / cell_m - first[1], (pose[1] + py) / cell_m - first[0]
        row, col = int(math.floor(y)), int(math.floor(x))
        d = cell_distance(pool, directory, row, col, float(reach)) * cell_m
        if d >= _FITS_SIGMAS * sigma:
            continue
        slot = slot_of(directory, row, col)
        cell = pool[slot, row & _MASK, col & _MASK]
        row, col = row + int(cell['to_row']) - HERE, col + int(cell['to_col']) - HERE
        nx, ny = normal_of(pool, directory, row, col)
        if nx == 0.0 and ny == 0.0:
            continue
        w = scan[i, 2] / (sigma * sigma) / (1.0 + d * d / (outlier * outlier))
        j[0], j[1], j[2] = nx, ny, -nx * py + ny * px
        for a in range(3):
            for b in range(3):
                H[a, b] += w * j[a] * j[b]
    return H


@kernel
def _contradicted(
    scan: Array,
    pose: Array,
    pool: NDArray[Any],
    directory: NDArray[np.int32],
    first: NDArray[np.int64],
    cell_m: float,
    reach: int,
    far: float,
) -> float:
    """Weight of the points in cells that were seen through, and are farther than far from walls."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    found = 0.0
    for i in range(len(scan)):
        x = (pose[0] + cos * scan[i, 0] - sin * scan[i, 1]) / cell_m - first[1]
        y = (pose[1] + sin * scan[i, 0] + cos * scan[i, 1]) / cell_m - first[0]
        row, col = int(math.floor(y)), int(math.floor(x))
        slot = slot_of(directory, row, col)
        if slot == NO_TILE or pool[slot, row & _MASK, col & _MASK]['seen'] == 0:
            continue
        if cell_distance(pool, directory, row, col, float(reach)) >= far:
            found += scan[i, 2]
    return found


@kernel
def _minimised(
    scan: Array,
    start: Array,
    prior: Array,
    by_prior: Array,
    pool: NDArray[Any],
    directory: NDArray[np.int32],
    first: NDArray[np.int64],
    cell_m: float,
    reach: int,
    sigma: float,
    outlier: float,
) -> tuple[Array, Array, Array, tuple[float, float, float, float, float]]:
    """Pose (3,), information (3, 3) of all, of the scan, and what `_evaluated` returns."""
    pose = start.copy()
    H, H_scan, g = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    H_new, H_scan_new, g_new = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    sums = _evaluated(
        scan,
        pose,
        prior,
        by_prior,
        pool,
        directory,
        first,
        cell_m,
        reach,
        sigma,
        outlier,
        H,
        H_scan,
        g,
    )
    damping = 1e-3
    for _ in range(_ROUNDS):
        A = H.copy()
        for a in range(3):
            A[a, a] *= 1.0 + damping
        step = np.linalg.solve(A, g)
        tried = pose + step
        new = _evaluated(
            scan,
            tried,
            prior,
            by_prior,
            pool,
            directory,
            first,
            cell_m,
            reach,
            sigma,
            outlier,
            H_new,
            H_scan_new,
            g_new,
        )
        if new[3] < sums[3]:
            pose, sums = tried, new
            H[:], H_scan[:], g[:] = H_new, H_scan_new, g_new
            damping = max(damping * 0.1, 1e-6)
        else:
            damping *= 10.0
        if np.abs(step).max() < _SETTLED or damping > 1e3:
            break
    return pose, H, H_scan, sums


@kernel
def _searched(
    scan: Array,
    prior: Array,
    steps: NDArray[np.int64],
    sizes: Array,
    by_prior: Array,
    pool: NDArray[Any],
    directory: NDArray[np.int32],
    first: NDArray[np.int64],
    cell_m: float,
    reach: int,
    sigma: float,
    outlier: float,
) -> Array:
    """The pose (3,) of a lattice round a prior with the lowest sum."""
    # Cost of every cell in sight, once.
    lookup = int(np.hypot(scan[:, 0], scan[:, 1]).max() / cell_m) + 4
    stride = int(round(sizes[0] / cell_m))
    rim_r, rim_c = stride * steps[1], stride * steps[0]
    rows, cols = 2 * (lookup + rim_r) + 1, 2 * (lookup + rim_c) + 1
    middle_row = int(math.floor(prior[1] / cell_m)) - first[0]
    middle_col = int(math.floor(prior[0] / cell_m)) - first[1]
    width = outlier / sigma
    costs = np.full((rows, cols), np.float32(-1.0))
    best = prior.copy()
    n = len(scan)
    usual = _USUAL_LOSS * scan[:, 2].sum()
    lowest = 700.0 * usual
    at_row, at_col = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    for k in range(-steps[2], steps[2] + 1):
        turn = k * sizes[1]
        cos, sin = math.cos(prior[2] + turn), math.sin(prior[2] + turn)
        for i in range(n):
            x = prior[0] + cos * scan[i, 0] - sin * scan[i, 1]
            y = prior[1] + sin * scan[i, 0] + cos * scan[i, 1]
            at_row[i] = int(math.floor(y / cell_m)) - first[0] - middle_row + lookup + rim_r
            at_col[i] = int(math.floor(x / cell_m)) - first[1] - middle_col + lookup + rim_c
        for a in range(-steps[1], steps[1] + 1):
            for b in range(-steps[0], steps[0] + 1):
                dx, dy = b * sizes[0], a * sizes[0]
                squared = (
                    by_prior[0, 0] * dx * dx
                    + by_prior[1, 1] * dy * dy
                    + by_prior[2, 2] * turn * turn
                    + 2.0
                    * (
                        by_prior[0, 1] * dx * dy
                        + by_prior[0, 2] * dx * turn
                        + by_prior[1, 2] * dy * turn
                    )
                )
                by_motion = _loss(squared, _SIGMAS)
                if by_motion >= lowest:
                    continue
                most = usual * math.expm1((lowest - by_motion) / usual)
                cost = 0.0
                for i in range(n):
                    r, c = at_row[i] + stride * a, at_col[i] + stride * b
                    value = costs[r, c]
                    if value < 0.0:
                        d = cell_distance(
                            pool,
                            directory,
                            r - lookup - rim_r + middle_row,
                            c - lookup - rim_c + middle_col,
                            float(reach),
                        )
                        error = d * cell_m / sigma
                        value = np.float32(_loss(error * error, width))
                        costs[r, c] = value
                    cost += scan[i, 2] * value
                    if cost >= most:
                        break
                if cost < most:
                    lowest = by_motion + usual * math.log1p(cost / usual)
                    best[0], best[1], best[2] = prior[0] + dx, prior[1] + dy, prior[2] + turn
    return best
