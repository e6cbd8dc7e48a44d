"""Pose graph optimization, with and without outlier edges."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares

from thinmap_ros.core import se2
from thinmap_ros.core.slam.graph import pose_graph
from thinmap_ros.core.slam.graph.pose_graph import (
    Edge,
    EdgeArrays,
    _linearise,
    optimized,
    rounds,
)

STEP = np.diag(1.0 / np.square([0.05, 0.05, 0.02]))
CORRELATED = np.array([[400.0, 150.0, -80.0], [150.0, 300.0, 60.0], [-80.0, 60.0, 900.0]])


def ring(rng, number=24, noise=0.01):
    """True poses on a circle, dead-reckoned estimates by noisy steps, and the steps."""
    angles = np.linspace(0.0, 2.0 * np.pi, number, endpoint=False)
    truth = np.column_stack(
        [5.0 * np.cos(angles), 5.0 * np.sin(angles), se2.wrap(angles + np.pi / 2.0)]
    )
    measured = [se2.between(a, b) + rng.normal(0.004, noise, 3) for a, b in pairwise(truth)]
    poses = [truth[0]]
    for T in measured:
        poses.append(se2.compose(poses[-1], T))
    steps = [Edge(i, i + 1, T, STEP, False) for i, T in enumerate(measured)]
    return truth, np.array(poses), steps


def loop(truth, a, b, off=(0.0, 0.0, 0.0), information=100.0 * STEP):
    return Edge(a, b, se2.between(truth[a], truth[b]) + off, information, True)


def worst(poses, truth):
    return float(np.hypot(*(poses - truth)[:, :2].T).max())


def test_two_measurements_of_one_step_meet_by_their_information():
    """A graph of two poses: the result is the weighted mean."""
    poses = np.array([[1.0, 2.0, 0.5], [0.0, 0.0, 0.0]])
    once = np.array([1.0, 0.0, 0.0])
    twice = np.array([1.4, 0.4, 0.2])
    edges = [Edge(0, 1, once, np.eye(3), False), Edge(0, 1, twice, 3.0 * np.eye(3), False)]
    T = se2.between(poses[0], optimized(poses, edges)[1])
    np.testing.assert_allclose(T, 0.25 * once + 0.75 * twice, atol=1e-6)


def test_a_gap_along_a_line_is_shared_by_the_steps():
    """Four steps of 1 m, and a loop that measures 4.5 m: each takes a share of the error."""
    poses = np.column_stack([np.arange(5.0), np.zeros(5), np.zeros(5)])
    steps = [Edge(i, i + 1, np.array([1.0, 0.0, 0.0]), np.eye(3), False) for i in range(4)]
    whole = Edge(0, 4, np.array([4.5, 0.0, 0.0]), np.eye(3), False)
    np.testing.assert_allclose(optimized(poses, [*steps, whole])[:, 0], 1.1 * np.arange(5.0))


def test_edges_in_reverse_direction_are_equivalent(rng):
    truth, poses, steps = ring(rng)
    there = optimized(poses, [*steps, Edge(0, 20, se2.between(truth[0], truth[20]), STEP, False)])
    assert worst(there, truth) < worst(poses, truth)
    exact = [Edge(e.b, e.a, se2.between(truth[e.b], truth[e.a]), STEP, False) for e in steps]
    np.testing.assert_allclose(np.sin(optimized(poses, exact) - truth)[:, 2], 0.0, atol=1e-6)
    np.testing.assert_allclose(optimized(poses, exact)[:, :2], truth[:, :2], atol=1e-5)


@pytest.mark.parametrize('information', [STEP, CORRELATED])
def test_the_minimum_is_that_of_a_general_solver(rng, information):
    truth, poses, steps = ring(rng, 10)
    edges = [Edge(e.a, e.b, e.T_a_b, information, False) for e in steps]
    edges += [Edge(9, 0, se2.between(truth[9], truth[0]), information, False)]
    edges += [Edge(2, 7, se2.between(truth[2], truth[7]), STEP, False)]
    roots = [np.linalg.cholesky(edge.information).T for edge in edges]

    def residuals(x):
        p = np.vstack([poses[0], x.reshape(-1, 3)])
        off = [se2.between(p[e.a], p[e.b]) - e.T_a_b for e in edges]
        off = [np.array([e[0], e[1], se2.wrap(float(e[2]))]) for e in off]
        return np.concatenate([root @ e for root, e in zip(roots, off, strict=True)])

    best = least_squares(residuals, poses[1:].ravel(), xtol=1e-14, ftol=1e-14).x.reshape(-1, 3)
    np.testing.assert_allclose(np.sin(optimized(poses, edges)[1:] - best)[:, 2], 0.0, atol=1e-4)
    np.testing.assert_allclose(optimized(poses, edges)[1:, :2], best[:, :2], atol=1e-4)


def test_jacobians_are_those_of_numeric_differences(rng):
    poses = np.column_stack([rng.uniform(-5.0, 5.0, (12, 2)), rng.uniform(-3.1, 3.1, 12)])
    pairs = [rng.choice(12, 2, replace=False) for _ in range(40)]
    edges = [
        Edge(int(a), int(b), se2.between(poses[a], poses[b]) + rng.normal(0.0, 0.3, 3), STEP, True)
        for a, b in pairs
    ]
    arrays = EdgeArrays.of(edges)
    e, by_a, by_b = _linearise(poses, arrays.a, arrays.b, arrays.T_a_b)
    step = 1e-6
    for k, edge in enumerate(edges):

        def error(T_a, T_b, edge=edge):
            off = se2.between(T_a, T_b) - edge.T_a_b
            return np.array([off[0], off[1], se2.wrap(float(off[2]))])

        a = poses[edge.a]
        b = poses[edge.b]
        np.testing.assert_allclose(e[k], error(a, b), atol=1e-12)
        for i, axis in enumerate(np.eye(3)):
            numeric_a = (error(a + step * axis, b) - error(a - step * axis, b)) / (2.0 * step)
            numeric_b = (error(a, b + step * axis) - error(a, b - step * axis)) / (2.0 * step)
            np.testing.assert_allclose(by_a[k][:, i], numeric_a, atol=1e-7)
            np.testing.assert_allclose(by_b[k][:, i], numeric_b, atol=1e-7)


def test_a_closed_loop_spreads_the_drift(rng):
    truth, poses, steps = ring(rng)
    closed = optimized(poses, [*steps, loop(truth, 23, 0)])
    assert worst(poses, truth) > 0.15
    assert worst(closed, truth) < 0.5 * worst(poses, truth)
    np.testing.assert_array_equal(closed[0], poses[0])


def test_a_large_gap_is_closed_by_true_loops(rng):
    """A true loop with an initial error of many sigmas: the loss has to start wide."""
    truth, _, steps = ring(rng)
    bent = [truth[0]]
    for edge in steps:
        bent.append(se2.compose(bent[-1], edge.T_a_b + [0.0, 0.0, 0.03]))
    bent = np.array(bent)
    steps = [Edge(e.a, e.b, e.T_a_b + [0.0, 0.0, 0.03], STEP, False) for e in steps]
    loops = [loop(truth, 23 - i, i) for i in range(3)]
    assert worst(bent, truth) > 2.0
    assert worst(optimized(bent, [*steps, *loops]), truth) < 0.2 * worst(bent, truth)


def test_a_false_edge_is_held_down(rng):
    truth, poses, steps = ring(rng)
    right = [loop(truth, 23 - i, i) for i in range(3)]
    false = loop(truth, 4, 15, off=(6.0, -3.0, 1.0))
    without = optimized(poses, [*steps, *right])
    assert worst(optimized(poses, [*steps, *right, false]), without) < 0.1
    # If it had its full weight, it would bend the whole path.
    trusted = Edge(false.a, false.b, false.T_a_b, false.information, False)
    assert worst(optimized(poses, [*steps, *right, trusted]), without) > 1.0


def test_the_last_round_is_the_optimum(rng):
    truth, poses, steps = ring(rng)
    edges = [*steps, loop(truth, 23, 0), loop(truth, 5, 15, off=(3.0, 0.0, 0.0))]
    given = poses.copy()
    each = [T.copy() for T in rounds(poses, EdgeArrays.of(edges))]
    assert 1 < len(each) <= 30
    np.testing.assert_array_equal(each[-1], optimized(poses, edges))
    np.testing.assert_array_equal(poses, given)
    np.testing.assert_array_equal([T[0] for T in each], [given[0]] * len(each))
    again = optimized(each[-1], edges)
    assert worst(again, each[-1]) < 0.01


def test_slices_of_an_iteration_change_nothing_but_when_it_ends(rng, monkeypatch):
    truth, poses, steps = ring(rng, 200)
    edges = EdgeArrays.of([*steps, loop(truth, 199, 0), loop(truth, 30, 90, off=(3.0, 0.0, 0.0))])
    whole = [T.copy() for T in rounds(poses, edges)]
    monkeypatch.setattr(pose_graph, '_SLICE', 200)
    sliced = [T.copy() for T in rounds(poses, edges)]
    assert len(sliced) > 4 * len(whole)
    np.testing.assert_array_equal(sliced[-1], whole[-1])
    ends = [k for k in range(1, len(sliced)) if (sliced[k] != sliced[k - 1]).any()]
    assert len(ends) == len(whole)


def test_a_pose_that_nothing_measures_stays(rng):
    truth, poses, steps = ring(rng)
    free = np.vstack([poses, [7.0, 8.0, 0.5]])
    heading = Edge(0, 24, np.array([0.0, 0.0, 1.0]), np.diag([0.0, 0.0, 1e4]), False)
    found = optimized(free, [*steps, loop(truth, 23, 0), heading])
    np.testing.assert_array_equal(found[24, :2], [7.0, 8.0])
    assert found[24, 2] == pytest.approx(free[0, 2] + 1.0)
    np.testing.assert_allclose(found[:24], optimized(poses, [*steps, loop(truth, 23, 0)]))


def test_headings_stay_within_half_a_turn(rng):
    truth, poses, steps = ring(rng)
    turned = poses + [0.0, 0.0, 2.0 * np.pi]
    for T in rounds(turned, EdgeArrays.of([*steps, loop(truth, 23, 0)])):
        assert (np.abs(T[1:, 2]) <= np.pi).all()


def test_without_edges_nothing_moves():
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 3.0]])
    np.testing.assert_array_equal(optimized(poses, []), poses)
    np.testing.assert_array_equal(optimized(poses[:1], []), poses[:1])
    assert optimized(np.zeros((0, 3)), []).shape == (0, 3)
