"""Cholesky factorization of sparse symmetric matrices of blocks (3, 3), in slices of work.

The order of elimination and the blocks of the factor follow from the pattern alone: they are found
once for all matrices of a pattern. Source: George and Liu, "Computer solution of large sparse
positive definite systems", 1981. The order is by minimum degree, as SuperLU finds it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import inlined, kernel

# Pivots below this share of the diagonal are rounding errors: nothing measures that direction.
_MIN_PIVOT = 1e-13

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Pattern:
    """Blocks of the lower triangle of a factor with N block columns, in order of elimination.

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
    """The factor L of a matrix H = L L', as far as it is computed."""

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
