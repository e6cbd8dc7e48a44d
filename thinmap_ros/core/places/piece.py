"""A piece of map: keyframes, grid, topological map, and constellations of its landmarks."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.places.views import PlacedScan, View, views_of
from thinmap_ros.core.places.wall_field import WallField
from thinmap_ros.core.scan import NO_RETURN_CLEAR_RANGE_M, Scan
from thinmap_ros.core.se2 import BOUND_SIGMAS, Array
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap
from thinmap_ros.jit import inlined, kernel

# Of pairs of landmarks.
MAX_LENGTH_M = 12.0
_MIN_LENGTH_M = 1.0  # a shorter pair hardly has a direction
_LENGTH_BIN_M = 0.3
_CLEARANCE_BIN_M = 0.2
_CLEARANCE_BINS = 20  # the last one holds all larger clearances

_MAX_POSES = 200_000  # the rarest pairs first: bounds the time of a search

Numbers = NDArray[np.int64]


@inlined
def _length(xy: Array, i: int, j: int) -> float:
    return math.hypot(xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1])


@inlined
def _is_pair(xy: Array, i: int, j: int) -> bool:
    """Whether landmarks i and j determine a pose."""
    return _MIN_LENGTH_M <= _length(xy, i, j) <= MAX_LENGTH_M


@inlined
def _room(clearance: float) -> int:
    """Bin of a clearance in bins."""
    return min(max(int(math.floor(clearance)), 0), _CLEARANCE_BINS - 1)


@inlined
def _key(length: int, first: int, second: int) -> int:
    """Key of a pair, wherever it lies, by bins of its length and of both clearances."""
    return (length * _CLEARANCE_BINS + first) * _CLEARANCE_BINS + second


@kernel
def pairs_of(xy: Array, clearances: Array) -> tuple[Numbers, Numbers, Numbers]:
    """Keys (P,) of all ordered pairs of landmarks (N, 2), and the first and second of each (P,).

    clearances (N,): of the landmarks, m.
    """
    keys = [0 for _ in range(0)]
    first = [0 for _ in range(0)]
    second = [0 for _ in range(0)]
    for i in range(len(xy)):
        for j in range(len(xy)):
            if not _is_pair(xy, i, j):
                continue
            length = int(_length(xy, i, j) / _LENGTH_BIN_M)
            one = _room(clearances[i] / _CLEARANCE_BIN_M)
            other = _room(clearances[j] / _CLEARANCE_BIN_M)
            keys.append(_key(length, one, other))
            first.append(i)
            second.append(j)
    return np.array(keys), np.array(first), np.array(second)


@kernel
def _neighbour_keys(xy: Array, clearances: Array, i: int, j: int) -> Numbers:
    """Keys that a pair may have in another map: of its own bins, and of the nearest ones."""
    keys = np.empty(8, dtype=np.int64)
    length = int(math.floor(_length(xy, i, j) / _LENGTH_BIN_M - 0.5))
    one = clearances[i] / _CLEARANCE_BIN_M - 0.5
    other = clearances[j] / _CLEARANCE_BIN_M - 0.5
    for k in range(8):
        keys[k] = _key(length + (k & 1), _room(one + (k >> 1 & 1)), _room(other + (k >> 2)))
    return np.unique(keys)


@kernel
def _matching_pairs(xy: Array, clearances: Array, keys: Numbers) -> Numbers:
    """Rows (L, 4) of each pair of landmarks and of sorted keys that it may have.

    Number of keys that are equal, the first of them, and the two landmarks.
    """
    found = np.empty((64, 4), dtype=np.int64)
    count = 0
    for i in range(len(xy)):
        for j in range(len(xy)):
            if not _is_pair(xy, i, j):
                continue
            for key in _neighbour_keys(xy, clearances, i, j):
                low = np.searchsorted(keys, key)
                high = np.searchsorted(keys, key + 1)
                if high == low:
                    continue
                if count == len(found):
                    found = np.concatenate((found, np.empty_like(found)))
                found[count, 0] = high - low
                found[count, 1] = low
                found[count, 2] = i
                found[count, 3] = j
                count += 1
    return found[:count]


@inlined
def _put_pose(pose: Array, a: Array, b: Array, own_a: Array, own_b: Array) -> None:
    """Pose (3,) of the frame in which two points lie at own_a and own_b, if they are at a and b."""
    line = math.atan2(b[1] - a[1], b[0] - a[0])
    turn = line - math.atan2(own_b[1] - own_a[1], own_b[0] - own_a[0])
    c = math.cos(turn)
    s = math.sin(turn)
    x = 0.5 * (own_a[0] + own_b[0])
    y = 0.5 * (own_a[1] + own_b[1])
    pose[0] = 0.5 * (a[0] + b[0]) - (c * x - s * y)
    pose[1] = 0.5 * (a[1] + b[1]) - (s * x + c * y)
    pose[2] = math.atan2(math.sin(turn), math.cos(turn))


@kernel
def poses_by_pairs(
    own_xy: Array, own_clearances: Array, xy: Array, keys: Numbers, first: Numbers, second: Numbers
) -> tuple[Array, Array]:
    """Poses (N, 3) of a view in a map by pairs of landmarks that may be the same, and weights (N,).

    own_xy (V, 2), own_clearances (V,): landmarks of the view; xy (M, 2): of the map; keys, first,
    second (P,): pairs of the map, sorted by key. Rare pairs come first and have a larger weight.
    """
    lists = _matching_pairs(own_xy, own_clearances, keys)
    total = min(int(lists[:, 0].sum()), _MAX_POSES)
    poses = np.empty((total, 3))
    weights = np.empty(total)
    used = 0
    for k in np.argsort(lists[:, 0], kind='mergesort'):
        size, low, i, j = lists[k]
        for m in range(low, low + size):
            if used >= total:
                break
            _put_pose(poses[used], xy[first[m]], xy[second[m]], own_xy[i], own_xy[j])
            weights[used] = 1.0 / size
            used += 1
    return poses, weights


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Branch nodes of a topological map at xy (N, 2), m, with clearances (N,), m.

    They are found again in the map of another visit. Of end and corner nodes a tenth are.
    """

    xy: Array
    clearances: Array

    def __len__(self) -> int:
        return len(self.xy)

    def around(self, view: View) -> 'Landmarks':
        """Those within reach of a view of the same piece, in the frame of the view."""
        near = np.hypot(*(self.xy - view.T_piece_view[:2]).T) < MAX_LENGTH_M
        xy = se2.transform_points(se2.invert(view.T_piece_view), self.xy[near])
        return Landmarks(xy, self.clearances[near])


def landmarks_of(graph: TopologicalMap) -> Landmarks:
    """Landmarks of a topological map."""
    return _landmarks(graph.nodes.values())


def landmarks_around(graph: TopologicalMap, view: View) -> Landmarks:
    """Landmarks around a view of the same piece, in its frame; as fast in a large graph."""
    x, y, _ = view.T_piece_view.tolist()
    return _landmarks(graph.nodes_near(x, y, MAX_LENGTH_M)).around(view)


def _landmarks(nodes: Iterable[Node]) -> Landmarks:
    branches = [node for node in nodes if node.kind is NodeKind.BRANCH]
    xy = np.array([node.position for node in branches]).reshape(-1, 2)
    return Landmarks(xy, np.array([node.clearance_m for node in branches]))


# A view tells poses farther apart from each other.
SAME_M = 0.5
SAME_RAD = 0.1


# Standard deviations of the relative pose of two maps: of a match, and per metre of path.
MATCH_M = 0.15
MATCH_RAD = 0.02
_PER_M = 0.02
_RAD_PER_M = 0.003


def drift_m(path_m: float) -> float:
    """Largest difference of a position over a path, m."""
    return BOUND_SIGMAS * (MATCH_M + _PER_M * path_m)


def agree(T: Array, T_predicted: Array, path_m: float) -> bool:
    """Whether a pose (3,) is one that was predicted over a path."""
    x, y, turn = se2.between(T_predicted, T).tolist()
    drift_rad = BOUND_SIGMAS * (MATCH_RAD + _RAD_PER_M * path_m)
    return math.hypot(x, y) < drift_m(path_m) and abs(turn) < drift_rad


def are_same(poses: Array, T: Array) -> NDArray[np.bool_]:
    """Which poses (N, 3) a view does not tell from another one, (3,) or (N, 3)."""
    off = np.abs(poses - T)
    is_near = off[:, :2].max(axis=1) <= SAME_M
    return np.asarray(is_near & (np.abs(se2.wrap(off[:, 2])) <= SAME_RAD))


_HEADING_BINS = math.ceil(2.0 * math.pi / SAME_RAD)
_CANDIDATES = 60


class ConstellationIndex:
    """Pairs of the landmarks of a map, sorted by what does not depend on where they lie.

    A pair of a view that may be the same gives a pose of the view: constellations.
    """

    def __init__(self, landmarks: Landmarks) -> None:
        self._landmarks = landmarks
        keys, first, second = pairs_of(landmarks.xy, landmarks.clearances)
        order = np.argsort(keys, kind='stable')
        self._keys = keys[order]
        self._first = first[order]
        self._second = second[order]

    def __len__(self) -> int:
        return len(self._keys)

    def candidates(self, own: Landmarks) -> Array:
        """Poses (N, 3) in the map of a view with landmarks of its own, the likeliest first."""
        poses, weights = poses_by_pairs(
            own.xy,
            own.clearances,
            self._landmarks.xy,
            self._keys,
            self._first,
            self._second,
        )
        return _peaks(poses, weights) if len(poses) else poses


def _peaks(poses: Array, weights: Array) -> Array:
    """Weighted means (N, 3) of the bins of poses that have the most votes with their neighbours."""
    votes, means = _counted(poses, weights)
    means = means[np.argsort(-votes, kind='stable')]
    two_bins = 4.0 * math.pi / _HEADING_BINS
    return means[se2.distinct(means, SAME_M, two_bins, _CANDIDATES)]


def _counted(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Votes (B,) of each bin and its 26 neighbours, and weighted mean poses (B, 3) of the bins."""
    cells = np.floor(poses[:, :2] / SAME_M).astype(np.int64)
    cells -= cells.min(axis=0) - 1
    turns = np.floor((poses[:, 2] / (2.0 * math.pi) + 0.5) * _HEADING_BINS).astype(np.int64)
    width, height = (cells.max(axis=0) + 2).tolist()
    layer = width * height
    keys = turns % _HEADING_BINS * layer + cells[:, 1] * width + cells[:, 0]
    bins, owner = np.unique(keys, return_inverse=True)
    own = np.bincount(owner, weights)
    columns = [poses[:, 0], poses[:, 1], np.cos(poses[:, 2]), np.sin(poses[:, 2])]
    x, y, cos, sin = (np.bincount(owner, weights * column) / own for column in columns)
    votes = np.zeros(len(bins))
    for turn in (-1, 0, 1):
        beside = (bins // layer + turn) % _HEADING_BINS * layer + bins % layer
        for offset in (dy * width + dx for dy in (-1, 0, 1) for dx in (-1, 0, 1)):
            at = np.minimum(np.searchsorted(bins, beside + offset), len(bins) - 1)
            votes += np.where(bins[at] == beside + offset, own[at], 0.0)
    return votes, np.column_stack([x, y, np.arctan2(sin, cos)])


_BESIDE_CELLS = 1.5  # the eight cells around one


class MapPiece:
    """A piece of map in which views of another one are looked for, or whose views these are.

    What the search needs is made when it is first used; it does not change with the piece.
    """

    def __init__(
        self,
        keyframes: Sequence[PlacedScan],
        patch: GridPatch,
        graph: TopologicalMap,
        views: list[View] | None = None,
        tag: str = '',
    ) -> None:
        """keyframes: in the order of the path; all in the frame of the piece.

        views: along the keyframes, if they are made already; tag: of its storey, '' where nobody
        knows it.
        """
        self.tag = tag
        self.keyframes = keyframes
        self._views = views
        self.patch = patch
        self.graph = graph

    @property
    def free_area_m2(self) -> float:
        """Area of the free cells."""
        return float(np.count_nonzero(self.patch.free)) * self.patch.frame.resolution**2

    @cached_property
    def field(self) -> WallField:
        """Distances to its walls."""
        poses = np.array([frame.T_map_base for frame in self.keyframes]).reshape(-1, 3)
        return WallField(self.patch, poses[:, :2])

    @cached_property
    def walls(self) -> Array:
        """Centres (N, 2) of the cells of walls beside free ones."""
        is_seen = self.patch.occupied & (distance_cells(self.patch.free) < _BESIDE_CELLS)
        return self.patch.frame.centres_of(np.argwhere(is_seen))

    @cached_property
    def landmarks(self) -> Landmarks:
        """Branch nodes of its topological map."""
        return landmarks_of(self.graph)

    @cached_property
    def index(self) -> ConstellationIndex:
        """Pairs of its landmarks."""
        return ConstellationIndex(self.landmarks)

    @cached_property
    def views(self) -> list[View]:
        """Views along its keyframes."""
        return views_of(self.keyframes) if self._views is None else self._views

    def find(self, view: View, landmarks: Landmarks, count: int) -> Array:
        """The best places, distinct poses (N, 3), of a view of another piece with its landmarks."""
        poses = self.index.candidates(landmarks)
        if not len(poses):
            return poses
        rough, fits = self.field.refined_widely(view, poses)
        rough = rough[np.argsort(-fits, kind='stable')]
        kept = se2.distinct(rough, SAME_M, SAME_RAD, count)
        return np.array([self.field.refined(view, T)[0] for T in rough[kept]])


# Of drawn scans.
_BEAMS = 360
_SPACING_M = 0.7  # of path, as of keyframes
_INSIDE = 1e-6  # of a cell: a ray ends on the edge of the cell that it enters


@dataclass(frozen=True, eq=False)
class DrawnScan:
    """A scan that is drawn from a map: points (N, 2) on walls, robot frame, and its pose (3,)."""

    scan: Scan
    points: Array
    T_map_base: Array


def drawn_scans(patch: GridPatch, graph: TopologicalMap) -> list[DrawnScan]:
    """Scans along the edges of a topological map, as a laser with a range of 8 m makes them.

    For a map without keyframes. Beams into unknown cells are invalid.
    """
    margin = patch.padded((1, 1, 1, 1))
    obstacles = (~margin.free).astype(np.uint8)
    places = [place for path in _walk(graph) for place in _spaced(path)]
    return [_drawn(margin, obstacles, k, x, y) for k, (x, y) in enumerate(places)]


def _drawn(
    patch: GridPatch, obstacles: NDArray[np.uint8], number: int, x: float, y: float
) -> DrawnScan:
    """Scan at a place; obstacles (H, W): what is not free."""
    cell_m = patch.frame.resolution
    angles = 2.0 * math.pi * (np.arange(_BEAMS, dtype=np.float64) / _BEAMS - 0.5)
    x_cell, y_cell = patch.frame.in_cells(np.array([[x, y]]))[0].tolist()
    cells = cast_rays(obstacles, x_cell, y_cell, angles, NO_RETURN_CLEAR_RANGE_M / cell_m)
    ends = np.isfinite(cells)
    reach = cells[ends] + _INSIDE
    cols = np.floor(x_cell + reach * np.cos(angles[ends])).astype(np.int64)
    rows = np.floor(y_cell + reach * np.sin(angles[ends])).astype(np.int64)
    ranges = cells * cell_m
    ranges[ends] = np.where(patch.occupied[rows, cols], ranges[ends], np.nan)
    scan = Scan.create(
        number, ranges, -math.pi, 2.0 * math.pi / _BEAMS, 0.0, NO_RETURN_CLEAR_RANGE_M
    )
    return DrawnScan(scan, scan.points_base(), np.array([x, y, 0.0]))


def _spaced(path: Array) -> Array:
    """Points (N, 2) along a path (K, 2), a spacing apart."""
    along = se2.lengths_along(path)
    at = np.arange(0.0, along[-1] + 1e-9, _SPACING_M)
    return np.column_stack([np.interp(at, along, path[:, i]) for i in (0, 1)])


def _walk(graph: TopologicalMap) -> Iterator[Array]:
    """Paths of all edges; each begins where the last one ends, where that is possible."""
    left: dict[int, Edge] = dict(sorted(graph.edges.items()))
    here: int | None = None
    while left:
        ahead = [edge for edge in graph.edges_at(here) if edge.id in left] if here else []
        edge = ahead[0] if ahead else next(iter(left.values()))
        del left[edge.id]
        start = here if ahead and here else edge.a
        yield edge.path_from(start)
        here = edge.other(start)
