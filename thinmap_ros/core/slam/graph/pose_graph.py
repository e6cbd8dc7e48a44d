"""Edges of the pose graph, and its optimization.

Source: Grisetti, Kuemmerle, Stachniss and Burgard, "A tutorial on graph-based SLAM", 2010.
Edges that may be outliers have the robust loss of Geman and McClure. Its width decreases in each
iteration, so that true loops with a large error close first: Yang et al., "Graduated non-convexity
for robust spatial perception", 2020.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array, wrap


@dataclass(frozen=True)
class OptimizerConfig:
    """Graduated non-convexity of robust edges.

    large: squared error, in sigmas, at which a robust edge has a quarter of its weight; narrowing:
    factor by which the width of the loss decreases in each iteration; settled: a smaller step (m
    and rad) ends the optimization, as do max_iterations.
    """

    large: float = 16.0
    narrowing: float = 2.0
    settled: float = 1e-5
    max_iterations: int = 30


_CONFIG = OptimizerConfig()


@dataclass(frozen=True, eq=False)
class Systematic:
    """Share of the odometry in a relative pose.

    derivative (3, 4): of the pose by the calibration; parameters (4,): of the calibration, as the
    pose contains them; spans: that the calibration was estimated from, then.
    """

    derivative: Array
    parameters: Array
    spans: int

    def change(self, parameters: Array) -> Array:
        """Change (3,) of the pose with parameters (N, 4), by the number of spans."""
        return np.asarray(self.derivative @ (parameters[self.spans] - self.parameters))

    def calibrated(self, parameters: Array) -> 'Systematic':
        """The share after that change."""
        return replace(self, parameters=parameters[self.spans])


NO_SHARE = Systematic(np.zeros((3, 4)), np.zeros(4), 0)


@dataclass(frozen=True, eq=False)
class Edge:
    """Relative pose T_a_b (3,) of keyframe b in a, with its information (3, 3), frame of a.

    robust: whether it may be an outlier; systematic: its share of the odometry; inlier_ratio: of
    the match that it is, 0 if it is none.
    """

    a: int
    b: int
    T_a_b: Array
    information: Array
    robust: bool
    systematic: Systematic = NO_SHARE
    inlier_ratio: float = 0.0

    def calibrated(self, parameters: Array) -> 'Edge':
        """The edge with other parameters (N, 4) of the calibration, by the number of spans."""
        T_a_b = self.T_a_b + self.systematic.change(parameters)
        return replace(self, T_a_b=T_a_b, systematic=self.systematic.calibrated(parameters))

    def settled(self, poses: Array, parameters: Array) -> 'Edge':
        """The edge as the poses (N, 3) have it, with its robust weight, then calibrated."""
        T = se2.between(poses[self.a], poses[self.b])
        there = replace(self, T_a_b=T, information=self.weight_at(T) * self.information)
        return there.calibrated(parameters)

    def weight_at(self, T_a_b: Array) -> float:
        """The weight, 0 to 1, that the robust loss leaves it at a relative pose (3,)."""
        if not self.robust:
            return 1.0
        off = self.T_a_b - T_a_b
        off[2] = wrap(float(off[2]))
        squared = float(off @ self.information @ off)
        return float((1.0 + squared / _CONFIG.large) ** -2)


def optimized(poses: Array, edges: list[Edge]) -> Array:
    """Optimize poses (N, 3); the first is fixed."""
    return deque(rounds(poses, edges), maxlen=1)[0]


def rounds(poses: Array, edges: list[Edge]) -> Iterator[Array]:
    """Yield the poses (N, 3) after each Gauss-Newton iteration; the first pose is fixed."""
    poses = poses.copy()
    if len(poses) < 2 or not edges:
        yield poses
        return
    arrays = _Edges(edges)
    width: float | None = None
    for _ in range(_CONFIG.max_iterations):
        e, by_a, by_b = _linearise(poses, arrays)
        squared = np.einsum('ki,kij,kj->k', e, arrays.information, e)
        width = 2.0 * float(squared.max()) if width is None else width / _CONFIG.narrowing
        scale = np.where(arrays.robust, (1.0 + squared / max(width, _CONFIG.large)) ** -2, 1.0)
        step = _step(arrays, e, by_a, by_b, scale[:, None, None] * arrays.information)
        poses[1:] += step
        poses[:, 2] = wrap(poses[:, 2])
        yield poses
        if width <= _CONFIG.large and np.abs(step).max() < _CONFIG.settled:
            break


class _Edges:
    """Edges as arrays."""

    def __init__(self, edges: list[Edge]) -> None:
        self.a = np.array([edge.a for edge in edges])
        self.b = np.array([edge.b for edge in edges])
        self.T_a_b = np.array([edge.T_a_b for edge in edges])
        self.information = np.array([edge.information for edge in edges])
        self.robust = np.array([edge.robust for edge in edges])


def _linearise(poses: Array, edges: _Edges) -> tuple[Array, Array, Array]:
    """Error (M, 3) of each edge, frame of a, and its Jacobians (M, 3, 3) w.r.t. a and b."""
    a = poses[edges.a]
    b = poses[edges.b]
    c = np.cos(a[:, 2])
    s = np.sin(a[:, 2])
    dx = (b - a)[:, 0]
    dy = (b - a)[:, 1]
    e = np.column_stack([c * dx + s * dy, -s * dx + c * dy, b[:, 2] - a[:, 2]]) - edges.T_a_b
    e[:, 2] = wrap(e[:, 2])
    by_b = np.zeros((len(e), 3, 3))
    by_b[:, 0, 0] = c
    by_b[:, 0, 1] = s
    by_b[:, 1, 0] = -s
    by_b[:, 1, 1] = c
    by_b[:, 2, 2] = 1.0
    by_a = -by_b
    by_a[:, 0, 2] = -s * dx + c * dy
    by_a[:, 1, 2] = -c * dx - s * dy
    return e, by_a, by_b


def _step(edges: _Edges, e: Array, by_a: Array, by_b: Array, W: Array) -> Array:
    """Gauss-Newton step (N - 1, 3) of all poses but the first.

    e (M, 3), by_a, by_b (M, 3, 3): errors and Jacobians; W (M, 3, 3): weights.
    """
    # Imported here: without a loop closure they are not needed, and they take 18 MB.
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve

    number = int(max(edges.a.max(), edges.b.max())) + 1
    size = 3 * number
    gradient = np.zeros((number, 3))
    blocks = []
    rows = []
    cols = []
    sides = ((edges.a, by_a), (edges.b, by_b))
    for i, J_i in sides:
        weighted = np.swapaxes(J_i, 1, 2) @ W
        np.add.at(gradient, i, -(weighted @ e[:, :, None])[:, :, 0])
        for j, J_j in sides:
            row, col = _places(i, j)
            blocks.append((weighted @ J_j).ravel())
            rows.append(row)
            cols.append(col)
    H = coo_matrix(
        (np.concatenate(blocks), (np.concatenate(rows), np.concatenate(cols))), shape=(size, size)
    ).tocsc()
    return np.asarray(spsolve(H[3:, 3:], gradient.ravel()[3:]).reshape(-1, 3))


def _places(
    i: NDArray[np.int64], j: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns, each (9 M,), of blocks (3, 3) at block rows i and columns j, (M,)."""
    along = np.arange(3)
    row = np.broadcast_to(3 * i[:, None, None] + along[:, None], (len(i), 3, 3))
    col = np.broadcast_to(3 * j[:, None, None] + along, (len(j), 3, 3))
    return row.ravel(), col.ravel()
