"""A scan against the map of points: laser odometry that sharpens the prediction.

Gauss-Newton on the distances of the scan's points from the surfaces that the map's points make near
them, with Cauchy weights, and the odometry as a prior: where the walls leave a direction open, as
along a corridor, the odometry decides.
Source: Censi, "An ICP variant using a point-to-line metric", 2008; the search after Olson,
"Real-time correlative scan matching", 2009.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.grid.tiles import NO_TILE, TILE
from thinmap_ros.core.jit import inlined, kernel
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.point_map import (
    CENTRE_X,
    CENTRE_Y,
    DENSE_M,
    LOOSE,
    MEAN_X,
    MEAN_Y,
    NORMAL_X,
    NORMAL_Y,
    SEEN,
    UNFORMED,
    PointMap,
    gaps,
    slot_of,
)

_SHIFT, _MASK = TILE.bit_length() - 1, TILE - 1
_ROUNDS = 20
_WIDE_ROUNDS = 3  # rounds in which far neighbours and larger errors still count
# Share of points that fit below which it is asked whether near neighbours alone do better.
_PLAIN_FIT = 0.95
_OF_A_POINT = 0.25  # what a point says, as points err together, in terms of a log-likelihood
_SLIPS = 3.0  # sigmas beyond which a prior says little more: wheels slip
# Share of the scan that has to lie where the map knows something, for a fit to be judged.
_LEAST_OVERLAP = 0.3
FEWEST_POINTS = 10  # in a scan, for it to be matched
# A search takes so many points of the scan, and none farther than this.
_SEARCHED_M = 20.0
_SEARCHED_POINTS = 60
_SEARCH_STRIDE = 2  # cells from one place that is tried to the next
# Weight of where along a surface a point lies:
# its nearest neighbour there is seldom the same thing.
_CLUTTER = 0.25
# Points by which a place at the rim of a search has to fit better than its middle.
_SEARCH_RIM = 1.25


@dataclass(frozen=True)
class MatchConfig(Config):
    """Parameters of the point map and of scan matching."""

    match_cell_m: float = parameter(0.05, 'edge of a cell of the point map, m', low=0.01, high=0.5)
    match_range_m: float = parameter(30.0, 'farther points are not matched, m', low=1.0, high=200.0)
    match_memory: float = parameter(
        15.0, 'points that the mean of a cell remembers', low=1.0, high=1e6
    )
    match_reach_m: float = parameter(
        0.6, 'points look for their surface within, m', low=0.05, high=2.0
    )
    match_sigma_m: float = parameter(
        0.03,
        'doubt of a point on its surface (1 sigma), m; above range noise, as points err together',
        low=0.001,
    )
    match_outlier_m: float = parameter(
        0.1, 'points this far from their surface count half, m', low=0.001, high=1.0
    )
    match_inlier_m: float = parameter(
        0.1, 'points this near to their surface fit, m', low=0.001, high=1.0
    )
    match_good_fit: float = parameter(
        0.85,
        'share of points that fit below which the surroundings are searched',
        low=0.0,
        high=1.0,
    )
    match_least_fit: float = parameter(
        0.65, 'share of points that fit below which a match fails', low=0.0, high=1.0
    )
    search_m: float = parameter(
        0.5, 'after a failed match: how far to search, m', low=0.0, high=10.0
    )
    search_deg: float = parameter(
        30.0, 'after a failed match: how far to turn, degrees', low=0.0, high=180.0
    )


@dataclass(frozen=True, eq=False)
class Match:
    """A matched pose T_map_base (3,) and its covariance (3, 3), map frame.

    fit: of the points that lie where the map knows something, the share that lies on its surfaces;
    overlap: the share of the points that lie there at all; good: whether the pose can be trusted.
    """

    T_map_base: Array
    covariance: Array
    fit: float
    overlap: float
    good: bool


class ScanMatcher:
    """Keeps the map of points, and finds the pose at which a scan fits it."""

    def __init__(self, config: MatchConfig, points: PointMap | None = None) -> None:
        """points: the map to match with; an empty one where none is given."""
        self.config = config
        self.map = points or PointMap(config.match_cell_m, config.match_memory)

    def add(self, points_map: Array, seen_from: Array) -> None:
        """Take points (N, 2) seen from a place (2,) into the map, map frame."""
        self.map.add(points_map, seen_from)

    def match(
        self,
        points_base: Array,
        laser_base: Array,
        prior: Array,
        covariance: Array,
        search: bool = False,
        lost: bool = False,
    ) -> Match:
        """Pose near a prior pose (3,) at which points (N, 2), in beam order, fit the map.

        laser_base (2,): where the laser sits on the robot; covariance (3, 3) of the prior, in the
        map frame. Where the fit is poor, or with `search`, the surroundings are searched. lost: the
        prior is only where to begin. Without points or map, the prior is given back, as not good.
        """
        if len(points_base) < FEWEST_POINTS or self.map.tiles.used == 0:
            return Match(prior, covariance, 0.0, 0.0, False)
        scan = self._weighted(points_base)
        match = self._refine(scan, laser_base, prior, prior, covariance)
        if match.fit < _PLAIN_FIT or _squared_sigmas(match, prior, covariance) > _SLIPS**2:
            # Far neighbours lead astray where little but one wall is seen, or much is new,
            # and the prior was right.
            near = self._refine(scan, laser_base, prior, prior, covariance, far=False)
            match = likelier(match, near, prior, covariance, len(scan))
        if search:
            return _better(match, self._search(scan, laser_base, prior, covariance))
        if match.overlap >= _LEAST_OVERLAP and match.fit < self.config.match_good_fit:
            found = self._search(scan, laser_base, prior, covariance)
            # Where the prior still says something, another place has to be worth the leap.
            match = (
                _better(match, found)
                if lost
                else likelier(match, found, prior, covariance, len(scan))
            )
        if lost:
            return match
        # Few points, or such as hardly fit, may say less than the prior does: then it is better
        # that they say nothing.
        return replace(
            match, good=match.good and _evidence(match, prior, covariance, len(scan)) >= 0.0
        )

    def known(self, points_base: Array, laser_base: Array, T_map_base: Array) -> float:
        """Share of the points (N, 2) that lie where the map knows a surface, at a pose (3,)."""
        if len(points_base) < FEWEST_POINTS or self.map.tiles.used == 0:
            return 0.0
        config, tiles = self.config, self.map.tiles
        rings = int(math.ceil(0.5 * config.match_reach_m / config.match_cell_m))
        limits = (
            config.match_cell_m,
            rings,
            config.match_sigma_m,
            config.match_outlier_m,
            config.match_inlier_m,
        )
        total, near, _ = _add_points(
            self._weighted(points_base),
            laser_base,
            T_map_base,
            self.map.cells,
            tiles.pool,
            tiles.directory,
            self.map.corner,
            (*limits, self.map.since_m),
            np.zeros((3, 3)),
            np.zeros(3),
        )
        return near / total

    def _weighted(self, points_base: Array) -> Array:
        """A scan as `_align` takes it, (N, 4)."""
        around = gaps(points_base)
        weights = np.clip(around / self.config.match_cell_m, 0.05, 1.0)
        return np.column_stack([points_base, weights, around < DENSE_M])

    def _search(self, scan: Array, laser_base: Array, prior: Array, covariance: Array) -> Match:
        """The match to which the search around a prior leads."""
        config, tiles = self.config, self.map.tiles
        turns = np.radians(np.arange(-config.search_deg, config.search_deg + 1e-9, 2.0))
        near = scan[np.hypot(scan[:, 0], scan[:, 1]) < _SEARCHED_M]
        sparse = np.ascontiguousarray(near[:: max(1, len(near) // _SEARCHED_POINTS)])
        steps = int(config.search_m / (_SEARCH_STRIDE * config.match_cell_m) + 1e-9)
        reach = float(np.hypot(sparse[:, 0], sparse[:, 1]).max(initial=0.0)) + config.search_m
        size = 2 * int(math.ceil(reach / config.match_cell_m)) + 8
        low = np.floor(prior[1::-1] / config.match_cell_m).astype(np.int64) - size // 2
        filled = _filled(
            self.map.cells,
            tiles.pool,
            tiles.directory,
            low - self.map.corner,
            size,
            self.map.since_m,
        )
        start = _search(sparse, prior, steps, turns, filled, low, config.match_cell_m)
        # What is searched for is what the prior missed: it must not hold the pose back.
        wide = covariance + np.diag(
            np.square([config.search_m, config.search_m, math.radians(config.search_deg)])
        )
        return self._refine(scan, laser_base, start, prior, wide)

    def _refine(
        self,
        scan: Array,
        laser_base: Array,
        start: Array,
        prior: Array,
        covariance: Array,
        far: bool = True,
    ) -> Match:
        """The match to which a start leads.

        far: whether points look for their surfaces far off at first.
        """
        config, tiles = self.config, self.map.tiles
        limits = np.array(
            [config.match_cell_m, config.match_reach_m, config.match_sigma_m]
            + [config.match_outlier_m, config.match_inlier_m, self.map.since_m]
        )
        information: Array = np.linalg.inv(covariance).astype(np.float64)
        pose, posterior, shares = _align(
            scan,
            laser_base,
            start,
            prior,
            information,
            self.map.cells,
            tiles.pool,
            tiles.directory,
            self.map.corner,
            limits,
            far,
        )
        overlap, fit = shares[1] / shares[0], shares[2] / max(shares[1], 1e-9)
        if not np.isfinite(pose).all():
            return Match(prior, covariance, 0.0, float(overlap), False)
        pose[2] = se2.wrap(float(pose[2]))
        good = overlap >= _LEAST_OVERLAP and fit >= config.match_least_fit
        return Match(
            pose,
            np.linalg.inv(posterior).astype(np.float64),
            float(fit),
            float(overlap),
            bool(good),
        )


def _better(first: Match, second: Match) -> Match:
    """The match of which more fits; the first where as much does of both."""
    return max(first, second, key=lambda match: match.fit)


def likelier(first: Match, second: Match, prior: Array, covariance: Array, points: int) -> Match:
    """The match for which more speaks; the first where as much speaks for both."""
    return max(first, second, key=lambda match: _evidence(match, prior, covariance, points))


def _evidence(match: Match, prior: Array, covariance: Array, points: int) -> float:
    """How much speaks for a match.

    Points that fit, less those that contradict, less how far off the prior it is.
    """
    fitting = points * match.overlap * (2.0 * match.fit - 1.0)
    squared = _squared_sigmas(match, prior, covariance)
    return _OF_A_POINT * fitting - 0.5 * _SLIPS**2 * math.log1p(squared / _SLIPS**2)


def _squared_sigmas(match: Match, prior: Array, covariance: Array) -> float:
    """How far a match is off its prior, squared, in sigmas of that."""
    off = se2.off(match.T_map_base, prior)
    return float(off @ np.linalg.solve(covariance, off))


@kernel
def _nearest(
    x: float,
    y: float,
    laser_x: float,
    laser_y: float,
    cells: NDArray[np.float32],
    tiles: NDArray[np.int32],
    directory: NDArray[np.int32],
    corner: NDArray[np.int64],
    cell_m: float,
    reach: int,
    since: float,
) -> int:
    """Number of the cell whose mean is nearest to a point, ring by ring up to a reach in cells.

    0 where there is none.

    Walls that were seen only from their other side are passed over.
    """
    row, col = int(math.floor(y / cell_m)) - corner[0], int(math.floor(x / cell_m)) - corner[1]
    best_at, best = np.int32(0), np.inf
    for ring in range(reach + 1):
        if best < (max(ring - 1, 0) * cell_m) ** 2:
            break
        for r in range(row - ring, row + ring + 1):
            stride = 1 if ring == 0 or abs(r - row) == ring else 2 * ring
            for c in range(col - ring, col + ring + 1, stride):
                slot = slot_of(directory, r, c)
                if slot == NO_TILE:
                    continue
                at = tiles[slot, r & _MASK, c & _MASK]
                if at == 0:
                    continue
                cell = cells[at]
                if cell[SEEN] < since:
                    continue
                dx, dy = cell[MEAN_X] - x, cell[MEAN_Y] - y
                squared = dx * dx + dy * dy
                if squared >= best:
                    continue
                facing = cell[NORMAL_X] * (laser_x - x) + cell[NORMAL_Y] * (laser_y - y)
                if cell[LOOSE] == 0.0 and facing < 0.0:
                    continue
                best_at, best = at, squared
    return int(best_at)


@inlined
def prior_weight(squared: float) -> float:
    """What a prior counts at a pose so many sigmas off, squared.

    The less the farther, as wheels slip.
    """
    return 1.0 / (1.0 + squared / (_SLIPS * _SLIPS))


@kernel
def _prior_terms(
    pose: Array, prior: Array, prior_information: Array, information: Array, gradient: Array
) -> None:
    """Start the normal equations with the prior.

    It counts less the farther the pose is from it, as wheels slip.
    """
    turn = math.atan2(math.sin(prior[2] - pose[2]), math.cos(prior[2] - pose[2]))
    off = (prior[0] - pose[0], prior[1] - pose[1], turn)
    squared = 0.0
    for a in range(3):
        gradient[a] = 0.0
        for b in range(3):
            gradient[a] += prior_information[a, b] * off[b]
        squared += off[a] * gradient[a]
    weight = prior_weight(squared)
    for a in range(3):
        gradient[a] *= weight
        for b in range(3):
            information[a, b] = weight * prior_information[a, b]


@kernel
def _solve(A: Array, b: Array) -> tuple[float, float, float]:
    """Solution of a symmetric positive system of three equations, by its Cholesky factor."""
    l00 = math.sqrt(A[0, 0])
    l10, l20 = A[1, 0] / l00, A[2, 0] / l00
    l11 = math.sqrt(A[1, 1] - l10 * l10)
    l21 = (A[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(A[2, 2] - l20 * l20 - l21 * l21)
    y0 = b[0] / l00
    y1 = (b[1] - l10 * y0) / l11
    y2 = (b[2] - l20 * y0 - l21 * y1) / l22
    x2 = y2 / l22
    x1 = (y1 - l21 * x2) / l11
    return (y0 - l10 * x1 - l20 * x2) / l00, x1, x2


@kernel
def _add_term(
    weight: float,
    across: float,
    error: float,
    nx: float,
    ny: float,
    information: Array,
    gradient: Array,
) -> None:
    """Add one measured direction (nx, ny) with its error.

    across: how the direction moves with the heading.
    """
    jacobian = (nx, ny, across)
    for a in range(3):
        gradient[a] += weight * jacobian[a] * error
        for b in range(3):
            information[a, b] += weight * jacobian[a] * jacobian[b]


@kernel
def _add_points(
    scan: Array,
    laser_base: Array,
    pose: Array,
    cells: NDArray[np.float32],
    tiles: NDArray[np.int32],
    directory: NDArray[np.int32],
    corner: NDArray[np.int64],
    limits: tuple[float, int, float, float, float, float],
    information: Array,
    gradient: Array,
) -> tuple[float, float, float]:
    """Add what the points of a scan say at a pose (3,) to the normal equations.

    Returns the weights that `_align` tells of. limits: cell, reach in cells, sigma, outlier and
    inlier distance, and where the cells that count were last seen.
    """
    cell_m, reach, sigma, scale, inlier, since = limits
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    laser_x = pose[0] + cos * laser_base[0] - sin * laser_base[1]
    laser_y = pose[1] + sin * laser_base[0] + cos * laser_base[1]
    total, near, fitting = 0.0, 0.0, 0.0
    for i in range(scan.shape[0]):
        px, py = cos * scan[i, 0] - sin * scan[i, 1], sin * scan[i, 0] + cos * scan[i, 1]
        x, y = px + pose[0], py + pose[1]
        total += scan[i, 2]
        at = _nearest(x, y, laser_x, laser_y, cells, tiles, directory, corner, cell_m, reach, since)
        if at == 0:
            continue
        cell = cells[at]
        loose = np.float64(cell[LOOSE])
        if loose == UNFORMED:
            continue
        nx, ny = np.float64(cell[NORMAL_X]), np.float64(cell[NORMAL_Y])
        off_x, off_y = cell[CENTRE_X] - x, cell[CENTRE_Y] - y
        error, slide = nx * off_x + ny * off_y, -ny * off_x + nx * off_y
        squared = error * error + loose * slide * slide
        near += scan[i, 2]
        fitting += scan[i, 2] * (squared < inlier * inlier)
        weight = scan[i, 2] / (sigma * sigma * (1.0 + squared / (scale * scale)))
        _add_term(weight, nx * -py + ny * px, error, nx, ny, information, gradient)
        if loose > 0.0 and scan[i, 3] > 0.0:
            _add_term(
                _CLUTTER * weight * loose, ny * py + nx * px, slide, -ny, nx, information, gradient
            )
    return total, near, fitting


@kernel
def _align(
    scan: Array,
    laser_base: Array,
    start: Array,
    prior: Array,
    prior_information: Array,
    cells: NDArray[np.float32],
    tiles: NDArray[np.int32],
    directory: NDArray[np.int32],
    corner: NDArray[np.int64],
    limits: Array,
    far: bool,
) -> tuple[Array, Array, Array]:
    """Pose (3,), information (3, 3), weights (3,) of all points, those near the map, those on it.

    scan (N, 4): x, y, weight in the robot frame, and whether the beams around are dense; limits:
    cell, reach, sigma, outlier and inlier distance, m, and where on the robot's way the cells that
    count were last seen; far: whether to begin with _WIDE_ROUNDS.
    """
    cell_m, reach, sigma, outlier, inlier, since = limits
    pose, information, gradient, shares = start.copy(), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for iteration in range(_ROUNDS):
        wide = far and iteration < _WIDE_ROUNDS
        rings = int(math.ceil(reach / cell_m)) if wide else int(math.ceil(0.5 * reach / cell_m))
        now = (cell_m, rings, sigma, 3.0 * outlier if wide else outlier, inlier, since)
        _prior_terms(pose, prior, prior_information, information, gradient)
        shares[0], shares[1], shares[2] = _add_points(
            scan, laser_base, pose, cells, tiles, directory, corner, now, information, gradient
        )
        dx, dy, turn = _solve(information, gradient)
        pose[0], pose[1], pose[2] = pose[0] + dx, pose[1] + dy, pose[2] + turn
        if not wide and abs(dx) + abs(dy) < 2e-4 and abs(turn) < 1e-4:
            break
    return pose, information, shares


@kernel
def _filled(
    cells: NDArray[np.float32],
    tiles: NDArray[np.int32],
    directory: NDArray[np.int32],
    low: NDArray[np.int64],
    size: int,
    since: float,
) -> NDArray[np.uint8]:
    """1 where a cell or one of its eight neighbours holds points that count, else 0.

    Shape (size, size), from the cell `low` on.
    """
    filled = np.zeros((size, size), dtype=np.uint8)
    for tile_row in range(
        max(low[0] >> _SHIFT, 0), min((low[0] + size >> _SHIFT) + 1, directory.shape[0])
    ):
        for tile_col in range(
            max(low[1] >> _SHIFT, 0), min((low[1] + size >> _SHIFT) + 1, directory.shape[1])
        ):
            slot = directory[tile_row, tile_col]
            if slot == NO_TILE:
                continue
            top, left = (tile_row << _SHIFT) - low[0], (tile_col << _SHIFT) - low[1]
            for r in range(max(top, 1), min(top + TILE, size - 1)):
                numbers = tiles[slot, r - top]
                for c in range(max(left, 1), min(left + TILE, size - 1)):
                    at = numbers[c - left]
                    if at > 0 and cells[at, SEEN] >= since:
                        filled[r - 1 : r + 2, c - 1 : c + 2] = 1
    return filled


@kernel
def _search(
    scan: Array,
    centre: Array,
    steps: int,
    turns: Array,
    filled: NDArray[np.uint8],
    low: NDArray[np.int64],
    cell_m: float,
) -> Array:
    """The pose (3,) around a centre at which most points fall on or beside cells that hold points.

    steps: how often to go _SEARCH_STRIDE cells to each side; filled (S, S): these cells, from the
    cell `low` on.
    """
    best, best_score = centre.copy(), -np.inf
    rim = max(steps, 1) * _SEARCH_STRIDE * cell_m
    rows, cols = np.empty(scan.shape[0], dtype=np.int64), np.empty(scan.shape[0], dtype=np.int64)
    for turn in turns:
        cos, sin = math.cos(centre[2] + turn), math.sin(centre[2] + turn)
        for k in range(scan.shape[0]):
            x = centre[0] + cos * scan[k, 0] - sin * scan[k, 1]
            y = centre[1] + sin * scan[k, 0] + cos * scan[k, 1]
            rows[k] = int(math.floor(y / cell_m)) - low[0]
            cols[k] = int(math.floor(x / cell_m)) - low[1]
        for i in range(-steps, steps + 1):
            for j in range(-steps, steps + 1):
                down, right = _SEARCH_STRIDE * i, _SEARCH_STRIDE * j
                dx, dy = right * cell_m, down * cell_m
                # Of poses that fit alike the one nearer to the centre.
                score = -_SEARCH_RIM * ((dx * dx + dy * dy) / (rim * rim) + 4.0 * turn * turn)
                for k in range(scan.shape[0]):
                    score += filled[rows[k] + down, cols[k] + right]
                if score > best_score:
                    best_score = score
                    best[0], best[1], best[2] = centre[0] + dx, centre[1] + dy, centre[2] + turn
    return best
