"""Where a whole map lies in another one: every shift and turn of it is tried.

A view is the scans of some metres of path, and a small map has few of them. Its walls and free
space as a whole fit the right place far better than any other one.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from thinmap_ros.core import se2
from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.places.piece import SAME_M, SAME_RAD, MapPiece
from thinmap_ros.core.places.place_odds import OTHER_PLACES
from thinmap_ros.core.places.recognition import MATCH_NOISE, PieceHypothesis, Placement
from thinmap_ros.core.places.views import LATTICE_M, View, thinned
from thinmap_ros.core.se2 import Array, inverse, propagated_covariance

_CELL_M = 0.1

# Of both maps together. Larger ones have path enough for views, and this bounds the time.
_MAX_EXTENT_M = 60.0

_STEP_RAD = math.radians(3.0)

# Of a wall of one map on free space of the other one, and of free space on free space, where a wall
# on a wall counts 1. With half as much for what is contrary, right places were half as surprising.
_CONTRARY = -0.6
_BOTH_FREE = 0.02

_NEAR_CELLS = 1.5  # a wall that near to another one does not contradict

_SAME_TURN_RAD = 0.35  # two turns with less between them are one: a peak is as wide

_PEAKS_OF_A_TURN = 8

# Log of the range in which the surprise at the best place lies for maps of one place, as far as was
# measured: 0.5 to 38, all alike likely.
_LOG_RANGE = math.log(30.0)

Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Alignment:
    """Pose (3,) of a map in another one where both agree best, and the second best, (3,).

    log_odds: of the best one being the place, against chance.
    """

    T_known_query: Array
    second: Array
    log_odds: float


def align(query: MapPiece, known: MapPiece) -> Alignment | None:
    """Lay the map of a piece on another one in all ways.

    How well wrong places agree is measured at the best of the others. Their tail is exponential:
    the best of many is as far ahead of the second by chance with the probability (1 + r)^-k, r
    being this lead in units of the sum of what the next k are ahead of the one after them (Rényi's
    spacings). Of maps of two places this is uniform, so that 1 of 100,000 reaches 1e-5.
    None where the maps are too small to tell, or empty.
    """
    if not all(mask.any() for piece in (query, known) for mask in _masks(piece.patch)):
        return None
    rasters = [_Raster(query.patch), _Raster(known.patch)]
    is_query_larger = rasters[0].reach_m > rasters[1].reach_m
    small, large = reversed(rasters) if is_query_larger else rasters  # turned by steps: the small
    reach_m = small.reach_m + large.reach_m
    if 2.0 * reach_m > _MAX_EXTENT_M:
        return None
    peaks = _distinct(_peaks(small, large, reach_m), OTHER_PLACES + 2)
    if len(peaks) < OTHER_PLACES + 2:
        return None
    scores = peaks[:, 0]
    ahead = float((scores[1:-1] - scores[-1]).sum())
    surprise = OTHER_PLACES * math.log1p(float(scores[0] - scores[1]) / max(ahead, 1e-9))
    back = np.append(-small.middle, 0.0)
    first, second = (se2.compose(T, back) for T in peaks[:2, 1:])
    if is_query_larger:
        first = se2.invert(first)
        second = se2.invert(second)
    return Alignment(first, second, surprise - _LOG_RANGE)


def _masks(patch: GridPatch) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    return patch.occupied, patch.free


class _Raster:
    """Draws a map, turned about its middle (2,), into a square of cells that wraps around."""

    def __init__(self, patch: GridPatch) -> None:
        walls, free = (
            thinned(patch.frame.centres_of(np.argwhere(mask)), 0.5 * _CELL_M)
            for mask in _masks(patch)
        )
        points = np.vstack([walls, free])
        self.middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        self.reach_m = float(np.hypot(*(points - self.middle).T).max())
        self._walls = walls - self.middle
        self._free = free - self.middle

    def drawn(self, turn: float, size: int) -> tuple[Image, Image]:
        """Walls and free space, (size, size), turned by an angle."""
        c = math.cos(turn)
        s = math.sin(turn)
        R = np.array([[c, s], [-s, c]]) / _CELL_M
        images = []
        for points in (self._walls, self._free):
            cells = np.floor(points @ R).astype(np.int64) % size
            image = np.zeros((size, size), dtype=np.float32)
            image[cells[:, 1], cells[:, 0]] = 1.0
            images.append(image)
        walls, free = images
        return walls, free * (1.0 - walls)


def _peaks(small: _Raster, large: _Raster, reach_m: float) -> Array:
    """Score and pose (N, 4) of the middle of the small map, at the best places of each turn.

    All shifts at a time, as a correlation. reach_m: of both together.
    """
    block = round(SAME_M / _CELL_M)
    size = block * int(fft.next_fast_len(math.ceil(2.0 * reach_m / _CELL_M / block) + 1, real=True))
    walls, free = large.drawn(0.0, size)
    away = distance_cells(walls > 0.0)
    likely = np.exp(-0.5 * away**2) + _CONTRARY * free * (away > _NEAR_CELLS)
    by_walls = fft.rfft2(likely.astype(np.float32))
    by_free = fft.rfft2(_CONTRARY * walls + _BOTH_FREE * free)
    found = []
    for turn in np.arange(-math.pi, math.pi - 1e-9, _STEP_RAD).tolist():
        walls, free = (np.conj(fft.rfft2(image)) for image in small.drawn(turn, size))
        scores = fft.irfft2(by_walls * walls + by_free * free, (size, size))
        values, cells = _best_of_blocks(scores, block)
        shifts = ((cells[:, ::-1] + size // 2) % size - size // 2) * _CELL_M
        found.append(np.column_stack([values, shifts + large.middle, np.full(len(values), turn)]))
    return np.vstack(found)


def _best_of_blocks(scores: Array, block: int) -> tuple[Array, NDArray[np.int64]]:
    """The best values (N,) of blocks of an image, and their cells (N, 2)."""
    count = len(scores) // block
    blocks = scores.reshape(count, block, count, block).swapaxes(1, 2).reshape(count, count, -1)
    best = blocks.max(axis=2).ravel()
    chosen = np.argpartition(-best, _PEAKS_OF_A_TURN)[:_PEAKS_OF_A_TURN]
    inside = blocks.reshape(count * count, -1)[chosen].argmax(axis=1)
    cells = np.column_stack([chosen // count, chosen % count]) * block
    return best[chosen], cells + np.column_stack([inside // block, inside % block])


def _distinct(peaks: Array, count: int) -> Array:
    """The best peaks (N, 4), each of another place."""
    peaks = peaks[np.argsort(-peaks[:, 0], kind='stable')]
    return peaks[se2.distinct(peaks[:, 1:], SAME_M, _SAME_TURN_RAD, count)]


# Share of the walls that agree at the right place, at least. Measured: at right places of homes and
# rooms of other days 0.84 and more, at 50 wrong poses in two homes, refined, 0.43 to 0.66.
LEAST_FOUND = 0.65


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose (3,) of a map in another one, refined, with covariance (3, 3).

    found: share of the walls of which both tell that both have, for the map that finds less.
    """

    T_known_query: Array
    covariance: Array
    found: float

    @property
    def is_contrary(self) -> bool:
        """Whether the maps contradict the pose."""
        return self.found < LEAST_FOUND

    def placement(self, query: MapPiece, log_odds: float) -> Placement:
        """The place of the query, with all of its views at it, and the log odds."""
        poses = {
            view.number: se2.compose(self.T_known_query, view.T_piece_view) for view in query.views
        }
        hypothesis = PieceHypothesis(0, poses)
        return Placement(self.T_known_query, self.covariance, log_odds, hypothesis)


def fitted(query: MapPiece, known: MapPiece, T_known_query: Array) -> Fit:
    """Move the map of a piece, from a rough pose (3,), to where its walls meet those of another."""
    view = _whole_view(query)
    starts = se2.compose(T_known_query, view.T_piece_view) + _AROUND
    rough, fits = known.field.refined_widely(view, starts)
    T, information, _ = known.field.refined(view, rough[int(fits.argmax())])
    T_known_query = se2.compose(T, se2.invert(view.T_piece_view))
    back = _whole_view(known)
    T_query_back = se2.compose(se2.invert(T_known_query), back.T_piece_view)
    shares = (known.field.agreement(view, T), query.field.agreement(back, T_query_back))
    covariance = propagated_covariance(
        inverse(information + np.eye(3)) + MATCH_NOISE, T_known_query[:2] - T[:2]
    )
    return Fit(T_known_query, covariance, min(found for found, _ in shares))


# Of a pose that a person has measured, or that is one of the steps above.
_AROUND = np.array(
    [
        (x, y, turn)
        for turn in (-SAME_RAD, 0.0, SAME_RAD)
        for x in (-SAME_M, 0.0, SAME_M)
        for y in (-SAME_M, 0.0, SAME_M)
    ]
)


def _whole_view(piece: MapPiece) -> View:
    """All walls of a map, and its free places away from them, as one view from its middle."""
    patch = piece.patch
    has_room = patch.free & (distance_cells(patch.occupied) * patch.frame.resolution > _CLEAR_M)
    walls, free = (
        thinned(patch.frame.centres_of(np.argwhere(m)), LATTICE_M)
        for m in (patch.occupied, has_room)
    )
    middle = np.append(walls.mean(axis=0), 0.0) if len(walls) else np.zeros(3)
    return View(0, walls - middle[:2], free - middle[:2], middle, (0, 0, 0), 0.0)


_CLEAR_M = 2.0 * LATTICE_M  # as far as the free places of a view end before a wall
