"""Edges of the pose graph, and its optimization.

Source: Grisetti, Kuemmerle, Stachniss and Burgard, "A tutorial on graph-based SLAM", 2010.
Edges that may be outliers have the robust loss of Geman and McClure. Its width decreases in each
iteration, so that true loops with a large error close first: Yang et al., "Graduated non-convexity
for robust spatial perception", 2020.
An iteration takes slices of work: of a graph of kilometres, each is a small part of it.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.core.slam.graph.block_cholesky import Factorization, Pattern
from thinmap_ros.jit import kernel


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
# Work of a slice, in products of blocks: 2 ms on a desktop processor. An iteration of a graph of
# up to 2,000 keyframes is one slice.
_SLICE = 60_000
_PER_EDGE = 15  # products that take as long as the share of an edge in the equations
_PER_POSE = 40  # and that of a pose in the order of elimination


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

    def weight_at(self, T_a_b: Array) -> float:
        """The weight, 0 to 1, that the robust loss leaves it at a relative pose (3,)."""
        if not self.robust:
            return 1.0
        off = self.T_a_b - T_a_b
        off[2] = wrap(float(off[2]))
        squared = float(off @ self.information @ off)
        return float((1.0 + squared / _CONFIG.large) ** -2)


@dataclass(frozen=True, eq=False)
class EdgeArrays:
    """M edges as arrays.

    a, b (M,), T_a_b (M, 3), information (M, 3, 3), robust (M,): as in `Edge`.
    """

    a: NDArray[np.int64]
    b: NDArray[np.int64]
    T_a_b: Array
    information: Array
    robust: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.a)

    @staticmethod
    def of(edges: Sequence[Edge]) -> 'EdgeArrays':
        """The arrays of some edges."""
        return EdgeArrays(
            np.array([edge.a for edge in edges], dtype=np.int64),
            np.array([edge.b for edge in edges], dtype=np.int64),
            np.array([edge.T_a_b for edge in edges]).reshape(-1, 3),
            np.array([edge.information for edge in edges]).reshape(-1, 3, 3),
            np.array([edge.robust for edge in edges], dtype=np.bool_),
        )

    @staticmethod
    def joined(parts: Sequence['EdgeArrays']) -> 'EdgeArrays':
        """All edges of some arrays."""
        return EdgeArrays(
            np.concatenate([part.a for part in parts]),
            np.concatenate([part.b for part in parts]),
            np.concatenate([part.T_a_b for part in parts]),
            np.concatenate([part.information for part in parts]),
            np.concatenate([part.robust for part in parts]),
        )

    def settled(self, poses: Array) -> 'EdgeArrays':
        """The edges as the poses (N, 3) have them, with the robust weights that they have there."""
        e, _, _ = _linearise(poses, self)
        squared = _squared(e, self.information)
        weight = np.where(self.robust, (1.0 + squared / _CONFIG.large) ** -2, 1.0)
        information = weight[:, None, None] * self.information
        return replace(self, T_a_b=self.T_a_b + e, information=information)


def optimized(poses: Array, edges: Sequence[Edge]) -> Array:
    """Optimize poses (N, 3); the first is fixed."""
    return last(rounds(poses, EdgeArrays.of(edges)))


def last(moving: Iterator[Array]) -> Array:
    """The poses (N, 3) after the last iteration."""
    return deque(moving, maxlen=1)[0]


def rounds(poses: Array, edges: EdgeArrays) -> Iterator[Array]:
    """Yield the poses (N, 3) after each Gauss-Newton iteration; the first pose is fixed.

    And, as they were, after each slice of an iteration that has more than one.
    """
    poses = poses.copy()
    if len(poses) < 2 or not len(edges):
        yield poses
        return
    equations = _Equations(len(poses), edges)
    if len(poses) * _PER_POSE > _SLICE:
        equations.pattern  # noqa: B018  # found once, in a slice of its own
        yield poses
    width: float | None = None
    for _ in range(_CONFIG.max_iterations):
        e, by_a, by_b = _linearise(poses, edges)
        squared = _squared(e, edges.information)
        width = 2.0 * float(squared.max()) if width is None else width / _CONFIG.narrowing
        scale = np.where(edges.robust, (1.0 + squared / max(width, _CONFIG.large)) ** -2, 1.0)
        gradient, factor = equations.at(e, by_a, by_b, edges.information, scale)
        left = _SLICE - _PER_EDGE * len(edges)
        while not factor.is_complete:
            if left <= 0:
                yield poses
                left = _SLICE
            left -= factor.eliminate(left)
        step = factor.solve(gradient)
        poses[1:] += step
        poses[:, 2] = wrap(poses[:, 2])
        yield poses
        if width <= _CONFIG.large and np.abs(step).max() < _CONFIG.settled:
            break


class _Equations:
    """The normal equations of a graph of N poses, of which the first is fixed."""

    def __init__(self, count: int, edges: EdgeArrays) -> None:
        # Unknowns, of which the fixed pose is none: -1.
        self._count = count - 1
        self._a = edges.a - 1
        self._b = edges.b - 1
        self._is_pair = (self._a >= 0) & (self._b >= 0)

    @cached_property
    def pattern(self) -> Pattern:
        """Where the equations have entries; the same in all iterations."""
        return Pattern.of(self._count, self._a[self._is_pair], self._b[self._is_pair])

    def at(
        self, e: Array, by_a: Array, by_b: Array, information: Array, weights: Array
    ) -> tuple[Array, Factorization]:
        """Right side (N - 1, 3), and matrix.

        e (M, 3): errors; by_a, by_b (M, 3, 3): Jacobians; weights (M,): of the information.
        """
        pattern = self.pattern
        slots = np.full(len(self._a), -1, dtype=np.int64)
        slots[self._is_pair] = pattern.slots
        blocks = np.zeros((len(pattern.rows), 3, 3))
        gradient = np.zeros((self._count, 3))
        _assemble(
            self._a,
            self._b,
            e,
            by_a,
            by_b,
            information,
            weights,
            pattern.place,
            pattern.diagonal,
            slots,
            blocks,
            gradient,
        )
        return gradient, Factorization(pattern, blocks)


@kernel
def _assemble(
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    e: Array,
    by_a: Array,
    by_b: Array,
    information: Array,
    weights: Array,
    place: NDArray[np.int64],
    diagonal: NDArray[np.int64],
    slots: NDArray[np.int64],
    blocks: Array,
    gradient: Array,
) -> None:
    """Add the edges to the blocks (L, 3, 3) of the matrix, and to the right side (N, 3)."""
    W = np.empty((3, 3))
    weighted = np.empty((3, 3))
    for k in range(len(a)):
        for i in range(3):
            for j in range(3):
                W[i, j] = weights[k] * information[k, i, j]
        for one, other, J, K in ((a[k], b[k], by_a[k], by_b[k]), (b[k], a[k], by_b[k], by_a[k])):
            if one < 0:
                continue
            for i in range(3):
                for j in range(3):
                    weighted[i, j] = J[0, i] * W[0, j] + J[1, i] * W[1, j] + J[2, i] * W[2, j]
            own = blocks[diagonal[one]]
            for i in range(3):
                for j in range(3):
                    gradient[one, i] -= weighted[i, j] * e[k, j]
                    for m in range(3):
                        own[i, j] += weighted[i, m] * J[m, j]
            if other >= 0 and place[one] > place[other]:
                pair = blocks[slots[k]]
                for i in range(3):
                    for j in range(3):
                        for m in range(3):
                            pair[i, j] += weighted[i, m] * K[m, j]


@kernel
def _squared(e: Array, information: Array) -> Array:
    """Squared errors (M,), in sigmas, of errors (M, 3)."""
    squared = np.zeros(len(e))
    for k in range(len(e)):
        for i in range(3):
            for j in range(3):
                squared[k] += e[k, i] * information[k, i, j] * e[k, j]
    return squared


def _linearise(poses: Array, edges: EdgeArrays) -> tuple[Array, Array, Array]:
    """Error (M, 3) of each edge, frame of a, and its Jacobians (M, 3, 3) w.r.t. a and b."""
    found: tuple[Array, Array, Array] = _errors(poses, edges.a, edges.b, edges.T_a_b)
    return found


@kernel
def _errors(
    poses: Array, a: NDArray[np.int64], b: NDArray[np.int64], T_a_b: Array
) -> tuple[Array, Array, Array]:
    e = np.empty((len(a), 3))
    by_a = np.zeros((len(a), 3, 3))
    by_b = np.zeros((len(a), 3, 3))
    for k in range(len(a)):
        c = np.cos(poses[a[k], 2])
        s = np.sin(poses[a[k], 2])
        dx = poses[b[k], 0] - poses[a[k], 0]
        dy = poses[b[k], 1] - poses[a[k], 1]
        turn = poses[b[k], 2] - poses[a[k], 2] - T_a_b[k, 2]
        e[k, 0] = c * dx + s * dy - T_a_b[k, 0]
        e[k, 1] = -s * dx + c * dy - T_a_b[k, 1]
        e[k, 2] = np.pi - (np.pi - turn) % (2.0 * np.pi)
        by_b[k, 0, 0] = c
        by_b[k, 0, 1] = s
        by_b[k, 1, 0] = -s
        by_b[k, 1, 1] = c
        by_b[k, 2, 2] = 1.0
        by_a[k, :, :] = -by_b[k]
        by_a[k, 0, 2] = -s * dx + c * dy
        by_a[k, 1, 2] = -c * dx - s * dy
    return e, by_a, by_b
