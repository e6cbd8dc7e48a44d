"""The conventional filter: equal to the textbook formulas, with a valid covariance."""

import numpy as np
import pytest
from reference_filter import DenseFilter

from thinmap_ros.core.ekf_slam.ekf import EkfSlam, line_difference
from thinmap_ros.core.ekf_slam.features import observe_line
from thinmap_ros.core.se2 import compose

P0 = np.diag([0.01, 0.02, 0.003])
Q = np.diag([1e-4, 5e-5, 4e-5])
R = np.array([[4e-4, 1e-5], [1e-5, 1e-4]])


def both(rng, features):
    pose = np.array([1.0, -2.0, 0.4])
    fast = EkfSlam(pose, P0)
    plain = DenseFilter(pose, P0)
    for _ in range(features):
        seen = np.array([rng.uniform(0.5, 8.0), rng.uniform(-3.1, 3.1)])
        fast.add(seen, R)
        plain.add(seen, R)
    return fast, plain


def look(rng, filter_, indices):
    """Observations of some features: predictions with noise."""
    expected = np.array([observe_line(filter_.pose, filter_.lines[i])[0] for i in indices]).reshape(
        -1, 2
    )
    return expected + rng.multivariate_normal([0.0, 0.0], R, len(indices))


def assert_same(fast, plain):
    np.testing.assert_allclose(np.concatenate([fast.pose, fast.lines.ravel()]), plain.x, atol=1e-9)
    np.testing.assert_allclose(fast.covariance, plain.P, atol=1e-9)


def test_the_fast_filter_is_the_textbook_filter(rng):
    fast, plain = both(rng, 6)
    for step in range(200):
        increment = rng.normal(0.0, [0.2, 0.02, 0.1])
        fast.predict(compose(fast.pose, increment), increment, Q)
        plain.predict(increment, Q)
        indices = rng.permutation(fast.count)[: rng.integers(0, 4)]
        z = look(rng, fast, indices)
        assert fast.update(indices, z, np.tile(R, (len(indices), 1, 1)))
        plain.update(indices, z, np.tile(R, (len(indices), 1, 1)))
        if step % 40 == 20:
            seen = np.array([rng.uniform(0.5, 8.0), rng.uniform(-3.1, 3.1)])
            assert fast.add(seen, R) == fast.count - 1
            plain.add(seen, R)
        if step % 50 == 30:
            fast.remove(2)
            plain.remove(2)
    assert_same(fast, plain)


def test_two_features_merged_into_one_wall(rng):
    fast, plain = both(rng, 4)
    seen = np.array([2.0, 0.3])
    for filter_ in (fast, plain):
        filter_.add(seen, R)
        filter_.add(seen + [0.01, -0.004], R)
        filter_.merge(4, 5, 1e-4 * np.eye(2))
    assert_same(fast, plain)
    v, S, _ = fast.difference(4, 5)
    assert np.abs(v).max() < 0.005
    assert np.linalg.eigvalsh(S).max() < 1.01e-4


def test_the_covariance_stays_symmetric_and_positive(rng):
    fast, _ = both(rng, 12)
    for _ in range(500):
        increment = rng.normal(0.0, [0.1, 0.01, 0.2])
        fast.predict(compose(fast.pose, increment), increment, 1e-8 * np.eye(3))
        indices = rng.permutation(fast.count)[:6]
        fast.update(indices, look(rng, fast, indices), np.tile(1e-8 * np.eye(2), (6, 1, 1)))
    P = fast.covariance
    np.testing.assert_allclose(P, P.T, atol=1e-15)
    assert np.linalg.eigvalsh(P).min() > -1e-12


def test_more_observations_never_increase_the_variance_of_a_line(rng):
    fast, _ = both(rng, 5)
    before = np.linalg.eigvalsh(fast.line_covariances()).max(axis=1)
    indices = np.arange(5)
    fast.update(indices, look(rng, fast, indices), np.tile(R, (5, 1, 1)))
    assert (np.linalg.eigvalsh(fast.line_covariances()).max(axis=1) <= before + 1e-15).all()


def test_one_wall_in_two_forms_is_merged():
    """A wall through the origin may be represented as (r, alpha) or (-r, alpha + pi)."""
    pose = np.array([1.0, 0.0, 0.0])
    fast = EkfSlam(pose, P0)
    plain = DenseFilter(pose, P0)
    for filter_ in (fast, plain):
        filter_.add(np.array([0.99, np.pi]), R)
        filter_.add(np.array([1.02, np.pi]), R)
        filter_.merge(0, 1, 1e-6 * np.eye(2))
    assert abs(abs(fast.lines[0, 1] - fast.lines[1, 1]) - np.pi) < 0.01
    assert fast.lines[0, 0] == pytest.approx(-fast.lines[1, 0], abs=1e-3)
    assert_same(fast, plain)


@pytest.mark.parametrize(('turned', 'signs'), [(1.5, [1.0, 1.0]), (1.6, [-1.0, 1.0])])
def test_a_line_is_compared_with_the_form_that_is_nearer_in_angle(turned, signs):
    v, found = line_difference(np.array([2.0, 0.3 + turned]), np.array([1.5, 0.3]))
    np.testing.assert_array_equal(found, signs)
    expected = [0.5, turned] if signs[0] > 0.0 else [3.5, turned - np.pi]
    np.testing.assert_allclose(v, expected)


def test_a_pose_that_is_set_has_nothing_to_do_with_the_features(rng):
    fast, _ = both(rng, 3)
    lines = fast.lines.copy()
    fast.set_pose(np.array([4.0, 5.0, 7.0]), P0)
    np.testing.assert_allclose(fast.pose, [4.0, 5.0, 7.0 - 2.0 * np.pi])
    assert not fast.covariance[:3, 3:].any()
    np.testing.assert_array_equal(fast.lines, lines)


@pytest.mark.parametrize('bad', [np.nan, np.inf])
def test_an_update_with_nonsense_changes_nothing(rng, bad):
    fast, _ = both(rng, 3)
    pose = fast.pose
    P = fast.covariance
    assert not fast.update(np.array([0]), np.array([[bad, 0.0]]), R[None])
    assert not fast.update(np.array([1]), np.array([[1.0, 0.0]]), np.full((1, 2, 2), bad))
    assert not fast.update(np.array([1]), np.array([[1.0, 0.0]]), -100.0 * np.eye(2)[None])
    np.testing.assert_array_equal(fast.pose, pose)
    np.testing.assert_array_equal(fast.covariance, P)
    assert fast.update(np.array([], dtype=np.int64), np.empty((0, 2)), np.empty((0, 2, 2)))
