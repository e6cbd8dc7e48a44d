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
from thinmap_ros.jit import inlined, kernel

# Pivots below this share of the diagonal are rounding errors: nothing measures that direction.
_MIN_PIVOT = 1e-13

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Pattern:
    """Blocks (3, 3) of the lower triangle of a Cholesky factor with N block columns.

    In order of elimination, which is by minimum degree, as SuperLU finds it. They follow from the
    pattern of a sparse symmetric matrix alone, and are found once for all matrices of that.
    Source: George and Liu, "Computer solution of large sparse positive definite systems", 1981.

    place (N,): column of each unknown; first (N + 1,): number of the first block of each column,
    which is the diagonal one; rows (L,): row of each block, ascending in a column; slots (M,):
    number of the block of each pair of unknowns.
    """

    place: Indices
    first: Indices
    rows: Indices
    slots: Indices

    @staticmethod
    def of(count: int, a: Indices, b: Indices) -> 'Pattern':
        """The pattern for a number of unknowns, of which pairs (M,), (M,) share an entry."""
        place = _elimination_order(count, a, b)
        low = np.maximum(place[a], place[b])
        high = np.minimum(place[a], place[b])
        order = np.lexsort((low, high))
        starts = np.searchsorted(high[order], np.arange(count + 1))
        first, rows = _fill(count, starts, low[order])
        return Pattern(place, first, rows, _slots(first, rows, low, high))

    @property
    def diagonal(self) -> Indices:
        """Number (N,) of the diagonal block of each unknown."""
        return self.first[self.place]


class Factorization:
    """The Cholesky factor L of a matrix H = L L', as far as it is computed, in slices of work."""

    def __init__(self, pattern: Pattern, blocks: Array) -> None:
        """Blocks (L, 3, 3): of H, by the numbers of the pattern; they become those of the factor.

        A block of a pair (a, b) has the rows of the one that is eliminated later.
        """
        self._pattern = pattern
        self._blocks = blocks
        diagonal = blocks[pattern.first[:-1]]
        self._least = _MIN_PIVOT * np.diagonal(diagonal, axis1=1, axis2=2)
        self._done = 0

    @property
    def is_complete(self) -> bool:
        """Whether all columns are eliminated."""
        return self._done == len(self._pattern.place)

    def eliminate(self, products: int) -> int:
        """Eliminate columns with about a number of products of blocks; returns how many it took."""
        pattern = self._pattern
        self._done, taken = _eliminate(
            pattern.first, pattern.rows, self._blocks, self._least, self._done, products
        )
        return int(taken)

    def solve(self, right: Array) -> Array:
        """Solution (N, 3) of H x = right, (N, 3), by unknown."""
        pattern = self._pattern
        x = np.empty_like(right)
        x[pattern.place] = right
        _substitute(pattern.first, pattern.rows, self._blocks, x)
        return np.asarray(x[pattern.place])


def _elimination_order(count: int, a: Indices, b: Indices) -> Indices:
    """Place (N,) of each unknown in the order of elimination."""
    # Imported here: without a loop closure they are not needed, and they take 18 MB.
    from scipy.sparse import coo_matrix, diags_array
    from scipy.sparse.linalg import splu

    ends = (np.concatenate([a, b]), np.concatenate([b, a]))
    pairs = coo_matrix((np.full(len(ends[0]), -1.0), ends), shape=(count, count)).tocsc()
    # Diagonally dominant: only the pattern counts.
    matrix = pairs + diags_array(1.0 - np.asarray(pairs.sum(axis=1)).ravel(), format='csc')
    by_degree = {'SymmetricMode': True}
    factor = splu(
        matrix.tocsc(), permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0, options=by_degree
    )
    return np.asarray(factor.perm_c, dtype=np.int64)


@kernel
def _fill(count: int, starts: Indices, low: Indices) -> tuple[Indices, Indices]:
    """First block (N + 1,) of each column of the factor, and row (L,) of each block.

    low: rows of the entries below the diagonal, column j from starts[j] to starts[j + 1].
    """
    first = np.zeros(count + 1, dtype=np.int64)
    rows = np.empty(4 * (count + len(low)), dtype=np.int64)
    seen = np.full(count, -1, dtype=np.int64)
    # Columns whose first row below the diagonal is j pass on their rows to column j.
    next_child = np.full(count, -1, dtype=np.int64)
    child = np.full(count, -1, dtype=np.int64)
    end = 0
    for j in range(count):
        if end + count - j > len(rows):
            grown = np.empty(2 * len(rows) + count, dtype=np.int64)
            grown[:end] = rows[:end]
            rows = grown
        begin = end
        rows[end] = j
        seen[j] = j
        end += 1
        for k in range(starts[j], starts[j + 1]):
            if seen[low[k]] != j:
                seen[low[k]] = j
                rows[end] = low[k]
                end += 1
        c = child[j]
        while c >= 0:
            for k in range(first[c] + 1, first[c + 1]):
                if seen[rows[k]] != j:
                    seen[rows[k]] = j
                    rows[end] = rows[k]
                    end += 1
            c = next_child[c]
        rows[begin:end].sort()
        first[j + 1] = end
        if end - begin > 1:
            parent = rows[begin + 1]
            next_child[j] = child[parent]
            child[parent] = j
    return first, rows[:end].copy()


@kernel
def _slots(first: Indices, rows: Indices, low: Indices, high: Indices) -> Indices:
    """Number (M,) of the block in row low (M,) and column high (M,)."""
    found = np.empty(len(low), dtype=np.int64)
    for k in range(len(low)):
        column = rows[first[high[k]] : first[high[k] + 1]]
        found[k] = first[high[k]] + np.searchsorted(column, low[k])
    return found


@inlined
def _root(block: Array, least: Array) -> None:
    """Replace a block by its Cholesky factor, lower triangle; least (3,): smallest pivots."""
    for i in range(3):
        for j in range(i + 1):
            value = block[i, j]
            for k in range(j):
                value -= block[i, k] * block[j, k]
            if i > j:
                block[i, j] = value / block[j, j]
            else:
                # A direction that nothing measures stays where it is.
                block[i, i] = np.sqrt(value) if value > least[i] else np.inf


@inlined
def _divide(block: Array, root: Array) -> None:
    """Replace a block B by B L'^-1, with the factor L of the diagonal block."""
    for i in range(3):
        for j in range(3):
            value = block[i, j]
            for k in range(j):
                value -= block[i, k] * root[j, k]
            block[i, j] = value / root[j, j]


@inlined
def _subtract_product(block: Array, left: Array, right: Array) -> None:
    """Subtract left right' from a block."""
    for i in range(3):
        for j in range(3):
            block[i, j] -= (
                left[i, 0] * right[j, 0] + left[i, 1] * right[j, 1] + left[i, 2] * right[j, 2]
            )


@kernel
def _eliminate(
    first: Indices, rows: Indices, blocks: Array, least: Array, done: int, products: int
) -> tuple[int, int]:
    """Eliminate columns from number `done` on; returns the next column, and the products taken."""
    taken = 0
    for j in range(done, len(first) - 1):
        if taken >= products:
            return j, taken
        _root(blocks[first[j]], least[j])
        end = first[j + 1]
        for p in range(first[j] + 1, end):
            _divide(blocks[p], blocks[first[j]])
        for p in range(first[j] + 1, end):
            at = first[rows[p]]
            for q in range(p, end):
                while rows[at] != rows[q]:
                    at += 1
                _subtract_product(blocks[at], blocks[q], blocks[p])
            taken += end - p
        taken += 2
    return len(first) - 1, taken


@kernel
def _substitute(first: Indices, rows: Indices, blocks: Array, x: Array) -> None:
    """Replace the right side x (N, 3) by the solution."""
    for j in range(len(first) - 1):
        root = blocks[first[j]]
        for i in range(3):
            for k in range(i):
                x[j, i] -= root[i, k] * x[j, k]
            x[j, i] /= root[i, i]
        for p in range(first[j] + 1, first[j + 1]):
            for i in range(3):
                for k in range(3):
                    x[rows[p], i] -= blocks[p, i, k] * x[j, k]
    for j in range(len(first) - 2, -1, -1):
        for p in range(first[j] + 1, first[j + 1]):
            for i in range(3):
                for k in range(3):
                    x[j, k] -= blocks[p, i, k] * x[rows[p], i]
        root = blocks[first[j]]
        for i in range(2, -1, -1):
            for k in range(i + 1, 3):
                x[j, i] -= root[k, i] * x[j, k]
            x[j, i] /= root[i, i]


# Of graduated non-convexity.
_LARGE = 16.0  # squared error, in sigmas, at which a robust edge has a quarter of its weight
_NARROWING = 2.0  # factor by which the width of the loss decreases in each iteration
_SETTLED = 1e-5  # m and rad: a smaller step ends the optimization
_MAX_ITERATIONS = 30

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

    def shifted(self, by_a: int, by_b: int) -> 'Edge':
        """The edge between keyframes with other numbers."""
        return replace(self, a=self.a + by_a, b=self.b + by_b)

    def renumbered(self, numbers: Indices) -> 'Edge':
        """The edge between keyframes with numbers (N,), by those that they had."""
        return replace(self, a=int(numbers[self.a]), b=int(numbers[self.b]))

    def weight_at(self, T_a_b: Array) -> float:
        """The weight, 0 to 1, that the robust loss leaves it at a relative pose (3,)."""
        if not self.robust:
            return 1.0
        off = self.T_a_b - T_a_b
        off[2] = wrap(float(off[2]))
        squared = float(off @ self.information @ off)
        return float((1.0 + squared / _LARGE) ** -2)


@dataclass(frozen=True, eq=False)
class EdgeArrays:
    """M edges as arrays.

    a, b (M,), T_a_b (M, 3), information (M, 3, 3), robust (M,): as in `Edge`.
    """

    a: Indices
    b: Indices
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
        e, _, _ = _linearise(poses, self.a, self.b, self.T_a_b)
        squared = _squared(e, self.information)
        weight = np.where(self.robust, (1.0 + squared / _LARGE) ** -2, 1.0)
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
    for _ in range(_MAX_ITERATIONS):
        e, by_a, by_b = _linearise(poses, edges.a, edges.b, edges.T_a_b)
        squared = _squared(e, edges.information)
        width = 2.0 * float(squared.max()) if width is None else width / _NARROWING
        scale = np.where(edges.robust, (1.0 + squared / max(width, _LARGE)) ** -2, 1.0)
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
        if width <= _LARGE and np.abs(step).max() < _SETTLED:
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
    a: Indices,
    b: Indices,
    e: Array,
    by_a: Array,
    by_b: Array,
    information: Array,
    weights: Array,
    place: Indices,
    diagonal: Indices,
    slots: Indices,
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


@kernel
def _linearise(poses: Array, a: Indices, b: Indices, T_a_b: Array) -> tuple[Array, Array, Array]:
    """Error (M, 3) of each edge, frame of a, and its Jacobians (M, 3, 3) w.r.t. a and b."""
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
