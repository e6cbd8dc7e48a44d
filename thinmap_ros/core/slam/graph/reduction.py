"""Fewer keyframes: those go of which later visits show the place as well.

So the map of many days over one floor has about as many keyframes as that of one day.
Source: Kretzschmar and Stachniss, "Information-theoretic compression of pose graphs for laser-based
robot mapping", 2012: scans that say little go, and the graph of the others stays a sparse one.
"""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.places.views import LATTICE_M, RANGE_M, passed_cells
from thinmap_ros.core.se2 import Array, inverse, propagated_covariance, rotated_covariance, wrap
from thinmap_ros.core.slam.graph.keyframes import Keyframe, SavedKeyframes
from thinmap_ros.core.slam.graph.loop_closure import AGAIN_M
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.odometry import CHI2

# Longer beams of 1 degree are more than a cell apart: by chance, others miss what they show.
_HALF = round(RANGE_M / LATTICE_M) + 1  # cells from a laser to the rim of what its scan shows


_NEARER_M = 2.0  # a cell is shown as well from a place that is at most so much farther from it
# Of the cells that a keyframe shows, of which later visits show as well, with which it goes.
_SHARE = 0.85


def reduced(saved: SavedKeyframes) -> SavedKeyframes:
    """The keyframes without those of which later visits show the place as well.

    The kept keyframes have their poses, covariances, and a graph of their own.
    """
    is_kept = needed(saved.frames)
    # Nothing but its edges between visits says where a keyframe is that was come to unknowingly.
    variances = np.array([_variance(inverse(step.information)) for step in saved.steps])
    is_kept[1:] |= variances > _UNKNOWN_M2
    if is_kept.all():
        return saved
    kept = np.flatnonzero(is_kept).tolist()
    numbers = np.cumsum(is_kept) - 1
    stamps_ns = [saved.stamps_ns[k] for k in kept] if saved.stamps_ns else ()
    return SavedKeyframes(
        [
            replace(frame, scan=replace(frame.scan, stamp_ns=number + 1))
            for number, frame in enumerate(saved.frames[k] for k in kept)
        ],
        [step.renumbered(numbers) for step in _kept_steps(saved.steps, is_kept)],
        [edge.renumbered(numbers) for edge in _kept_edges(saved, is_kept)],
        stamps_ns,
    )


def needed(frames: Sequence[Keyframe]) -> NDArray[np.bool_]:
    """Which keyframes (N,) show what no later visit shows as well.

    The first is one of them: the map is relative to it.
    """
    nearest = _Nearest(frames)
    is_kept = np.zeros(len(frames), dtype=np.bool_)
    visits: deque[tuple[float, _Shown]] = deque()
    for k in np.argsort([-frame.path_m for frame in frames], kind='stable').tolist():
        path_m = frames[k].path_m
        while visits and visits[0][0] > path_m + AGAIN_M:
            nearest.add(visits.popleft()[1])
        shown = _Shown.of(frames[k])
        is_kept[k] = k == 0 or nearest.share(shown) < _SHARE
        if is_kept[k]:
            visits.append((path_m, shown))
    return is_kept


@dataclass(frozen=True, eq=False)
class _Shown:
    """The cells (H, W) that a scan shows, the first one at (row, col), and their distances, m."""

    row: int
    col: int
    cells: NDArray[np.bool_]
    away_m: Array

    @staticmethod
    def of(frame: Keyframe) -> '_Shown':
        """Those of a keyframe, in the map frame."""
        scan = frame.scan
        x, y, yaw = se2.compose(frame.T_map_base, scan.T_base_laser).tolist()
        col, row = np.floor(np.array([x, y]) / LATTICE_M).astype(np.int64).tolist()
        at = np.array([x - col * LATTICE_M, y - row * LATTICE_M, yaw])
        ends = np.where(scan.hit, np.minimum(scan.ranges_m, RANGE_M), np.nan)
        cells = passed_cells(at[None], ends[None], scan.angles_rad[None], LATTICE_M, _HALF)
        centres = (np.arange(2 * _HALF) - _HALF + 0.5) * LATTICE_M
        away_m = np.hypot(centres[None, :] - at[0], centres[:, None] - at[1])
        return _Shown(row - _HALF, col - _HALF, cells, away_m)


class _Nearest:
    """From how near the cells of a map are shown, m."""

    def __init__(self, frames: Sequence[Keyframe]) -> None:
        places = np.array([se2.compose(f.T_map_base, f.scan.T_base_laser)[:2] for f in frames])
        cells = np.floor(places / LATTICE_M).astype(np.int64)[:, ::-1]
        self._first = cells.min(axis=0) - _HALF
        rows, cols = cells.max(axis=0) + _HALF - self._first
        self._away_m = np.full((rows, cols), np.inf, dtype=np.float32)

    def add(self, shown: _Shown) -> None:
        """Add the cells that a scan shows."""
        window = self._window(shown)
        window[shown.cells] = np.minimum(window[shown.cells], shown.away_m[shown.cells])

    def share(self, shown: _Shown) -> float:
        """Share of the cells of a scan that are shown as well; 0 of none."""
        if not shown.cells.any():
            return 0.0
        away_m = self._window(shown)[shown.cells]
        return float(np.mean(away_m <= shown.away_m[shown.cells] + _NEARER_M))

    def _window(self, shown: _Shown) -> NDArray[np.float32]:
        row, col = (shown.row, shown.col) - self._first
        return self._away_m[row : row + 2 * _HALF, col : col + 2 * _HALF]


_UNKNOWN_M2 = 1.0  # variance of a step that no two poses on a path have


def _variance(covariance: Array) -> float:
    """That of the position, m2."""
    return float(covariance[0, 0] + covariance[1, 1])


@dataclass(frozen=True, eq=False)
class _Way:
    """Relative pose T (3,) of something in keyframe `begin`, covariance (3, 3) in its frame."""

    begin: int
    T: Array
    covariance: Array

    @staticmethod
    def along(edge: Edge) -> '_Way':
        """That of the end of an edge."""
        return _Way(edge.a, edge.T_a_b, inverse(edge.information))

    def then(self, other: '_Way') -> '_Way':
        """That of the end of another way, which begins where this one ends."""
        T = se2.compose(self.T, other.T)
        moved = propagated_covariance(self.covariance, T[:2] - self.T[:2])
        added = rotated_covariance(other.covariance, float(self.T[2]))
        return _Way(self.begin, T, moved + added)

    def widened(self, times: int) -> '_Way':
        """With a covariance that is so many times larger."""
        return replace(self, covariance=times * self.covariance)

    def reversed(self, end: int) -> '_Way':
        """That of its begin in its end, which is a keyframe."""
        moved = propagated_covariance(self.covariance, -self.T[:2])
        return _Way(end, se2.invert(self.T), rotated_covariance(moved, -float(self.T[2])))


def _kept_steps(steps: Sequence[Edge], is_kept: NDArray[np.bool_]) -> list[Edge]:
    """The steps to the keyframes that are kept, from the last one before on the path of steps."""
    ways: list[_Way | None] = [None]
    for step in steps:
        before = ways[step.a]
        way = _Way.along(step)
        ways.append(way if is_kept[step.a] or before is None else before.then(way))
    return [
        replace(step, a=way.begin, T_a_b=way.T, information=inverse(way.covariance))
        for step, way in zip(steps, ways[1:], strict=True)
        if is_kept[step.b] and way is not None
    ]


def _kept_edges(saved: SavedKeyframes, is_kept: NDArray[np.bool_]) -> list[Edge]:
    """The edges between visits, each at the kept keyframes that are nearest along the steps.

    Edges that are placed from one keyframe, and the step from it, have errors of the same steps in
    them: times their number, these are as those of independent edges, or larger.
    Source: Julier and Uhlmann, "A non-divergent estimation algorithm in the presence of unknown
    correlations", 1997.
    """
    places = _places(saved.steps, is_kept)
    ends = [end for edge in saved.edges for end in (edge.a, edge.b)]
    shared = Counter(places[end].begin for end in ends if not is_kept[end])
    places = [place.widened(1 + shared[place.begin]) for place in places]
    found: dict[tuple[int, int], Edge] = {}
    for edge in saved.edges:
        to_a = places[edge.a]
        to_b = places[edge.b]
        if to_a.begin == to_b.begin:
            continue
        way = to_a.then(_Way.along(edge)).then(to_b.reversed(edge.b))
        b = to_b.begin
        moved = replace(edge, a=way.begin, b=b, T_a_b=way.T, information=inverse(way.covariance))
        pair = (way.begin, b)
        found[pair] = _fused(found[pair], moved) if pair in found else moved
    return list(found.values())


def _places(steps: Sequence[Edge], is_kept: NDArray[np.bool_]) -> list[_Way]:
    """The way to each keyframe from the kept one that is nearest along the steps."""
    itself = [_Way(k, np.zeros(3), np.zeros((3, 3))) for k in range(len(is_kept))]
    found: list[_Way | None] = [itself[k] if is_kept[k] else None for k in range(len(is_kept))]
    for step in reversed(steps):  # each has all that come after it
        after = found[step.b]
        if after is not None:
            back = _Way.along(step).reversed(step.b)
            found[step.a] = _nearer(found[step.a], after.then(back))
    for step in steps:
        before = found[step.a]
        if before is not None:
            found[step.b] = _nearer(found[step.b], before.then(_Way.along(step)))
    return [way or own for way, own in zip(found, itself, strict=True)]


def _nearer(one: _Way | None, other: _Way) -> _Way:
    """The way of the smaller variance."""
    if one is None or _variance(other.covariance) < _variance(one.covariance):
        return other
    return one


def _fused(one: Edge, other: Edge) -> Edge:
    """One edge of two between the same keyframes; the surer one where they do not agree."""
    off = se2.pose_difference(other.T_a_b, one.T_a_b)
    covariance = inverse(one.information) + inverse(other.information)
    if float(off @ np.linalg.solve(covariance, off)) > CHI2:
        return max(one, other, key=lambda edge: float(np.linalg.det(edge.information)))
    information = one.information + other.information
    T = one.T_a_b + np.linalg.solve(information, other.information @ off)
    T[2] = wrap(float(T[2]))
    ratio = max(one.inlier_ratio, other.inlier_ratio)
    return replace(one, T_a_b=T, information=information, inlier_ratio=ratio)
