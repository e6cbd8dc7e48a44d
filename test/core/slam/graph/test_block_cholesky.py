"""Cholesky factorization of sparse blocks, against dense matrices."""

import numpy as np
import pytest

from thinmap_ros.core.slam.graph.pose_graph import Factorization, Pattern


def chain_with_loops(rng, count, loops):
    a = np.concatenate([np.arange(count - 1), rng.integers(0, count, loops)])
    b = np.concatenate([np.arange(1, count), rng.integers(0, count, loops)])
    apart = a != b
    return a[apart], b[apart]


def system(rng, count, a, b):
    """A dense positive definite matrix (3 N, 3 N) of edges, and its blocks by a pattern."""
    pattern = Pattern.of(count, a, b)
    blocks = np.zeros((len(pattern.rows), 3, 3))
    H = np.zeros((count, 3, count, 3))
    for i in range(count):
        H[i, :, i] += 0.1 * np.eye(3)
        blocks[pattern.diagonal[i]] += 0.1 * np.eye(3)
    for i, j, slot in zip(a.tolist(), b.tolist(), pattern.slots.tolist(), strict=True):
        J = rng.normal(0.0, 1.0, (3, 6))
        whole = J.T @ J
        later, sooner = (i, j) if pattern.place[i] > pattern.place[j] else (j, i)
        H[later, :, later] += whole[:3, :3]
        H[sooner, :, sooner] += whole[3:, 3:]
        H[later, :, sooner] += whole[:3, 3:]
        H[sooner, :, later] += whole[3:, :3]
        blocks[pattern.diagonal[later]] += whole[:3, :3]
        blocks[pattern.diagonal[sooner]] += whole[3:, 3:]
        blocks[slot] += whole[:3, 3:]
    return pattern, blocks, H.reshape(3 * count, 3 * count)


@pytest.mark.parametrize(('count', 'loops'), [(1, 0), (2, 0), (2, 4), (40, 0), (60, 30)])
@pytest.mark.parametrize('products', [1, 10**9])
def test_the_solution_is_that_of_the_dense_matrix(rng, count, loops, products):
    a, b = chain_with_loops(rng, count, loops)
    pattern, blocks, H = system(rng, count, a, b)
    factor = Factorization(pattern, blocks)
    parts = 0
    while not factor.is_complete:
        assert factor.eliminate(products) > 0
        parts += 1
    assert parts == (count if products == 1 else 1)
    right = rng.normal(0.0, 1.0, (count, 3))
    np.testing.assert_allclose(
        factor.solve(right).ravel(), np.linalg.solve(H, right.ravel()), rtol=1e-6, atol=1e-9
    )


def test_a_chain_has_no_fill(rng):
    a, b = chain_with_loops(rng, 500, 0)
    assert len(Pattern.of(500, a, b).rows) == 999


def test_loops_between_neighbouring_rows_fill_little(rng):
    """A drive back and forth along 20 rows of 50 keyframes: the factor stays sparse."""
    a = np.concatenate([np.arange(999), [50 * row + 49 - k for row in range(19) for k in (9, 29)]])
    b = np.concatenate(
        [np.arange(1, 1000), [50 * row + 50 + k for row in range(19) for k in (9, 29)]]
    )
    assert len(Pattern.of(1000, a, b).rows) < 4 * 1000


def test_directions_that_nothing_measures_stay(rng):
    """Of two unknowns with one edge between them, rounding leaves pivots that are no more."""
    J = rng.normal(0.0, 1e3, (3, 6))
    whole = J.T @ J
    pattern = Pattern.of(2, np.array([0]), np.array([1]))
    blocks = np.zeros((3, 3, 3))
    later, sooner = np.argsort(-pattern.place)
    blocks[pattern.diagonal[later]] = whole[:3, :3]
    blocks[pattern.diagonal[sooner]] = whole[3:, 3:]
    blocks[pattern.slots[0]] = whole[:3, 3:]
    factor = Factorization(pattern, blocks)
    factor.eliminate(10)
    step = rng.normal(0.0, 1.0, 6)
    x = factor.solve((whole @ step).reshape(2, 3)[[0, 1] if later == 0 else [1, 0]])
    assert np.isfinite(x).all()
    np.testing.assert_array_equal(x[later], 0.0)
    np.testing.assert_allclose(J[:, 3:] @ x[sooner], J @ step, rtol=1e-6)
