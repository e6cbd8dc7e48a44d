"""How far the pose may be off: what motion adds, what matches take away, and what stays of them."""

import numpy as np

from thinmap_ros.core.slam.doubt import Doubt

ADDED, SEEN = np.diag([4e-4, 4e-4, 1e-4]), np.diag([1e4, 1e2, 1e5])
AHEAD = np.array([0.1, 0.0, 0.0])


def posterior_of(doubt: Doubt) -> np.ndarray:
    return np.linalg.inv(np.linalg.inv(doubt.since_match) + SEEN)


def test_what_matches_leave_open_grows_only_where_they_say_nothing():
    doubt, along = Doubt(), np.diag([1e4, 0.0, 1e5])
    for _ in range(200):
        doubt.move(np.eye(3), ADDED)
        doubt.match(
            doubt.evidence(np.linalg.inv(np.linalg.inv(doubt.since_match) + along), np.zeros(3)),
            AHEAD,
        )
    assert np.allclose(doubt.since_match, 0.0)
    assert np.isclose(doubt.on_map[1, 1], 200 * ADDED[1, 1])
    assert doubt.on_map[0, 0] < 1e-4
    assert doubt.on_map[2, 2] < 1e-5


def test_a_match_adds_less_the_less_the_robot_has_moved():
    added = []
    for way in (0.0, 0.1, 1.0, 5.0):
        doubt = Doubt()
        doubt.move(np.eye(3), ADDED)
        posterior = posterior_of(doubt)
        added.append(doubt.match(doubt.evidence(posterior, np.zeros(3)), np.array([way, 0.0, 0.0])))
        assert (np.linalg.eigvalsh(posterior - added[-1]) > -1e-15).all()
    assert added[0][0, 0] < added[1][0, 0] < added[2][0, 0]
    np.testing.assert_allclose(added[2], added[3])
    np.testing.assert_allclose(added[2], posterior)


def test_a_match_that_trusts_its_prior_less_than_that_claims_leaves_a_covariance():
    doubt = Doubt(np.diag([1e-6, 1e-6, 1e-6]))
    doubt.move(np.eye(3), 1e-8 * np.eye(3))
    doubt.match(doubt.evidence(np.diag([1e-2, 1e-8, 1e-6]), np.zeros(3)), AHEAD)
    assert (np.linalg.eigvalsh(doubt.on_map) > 0.0).all()


def test_what_the_map_says_counts_in_full_where_it_contradicts_the_wheels():
    doubt, by_map = Doubt(np.diag([1e-4, 1e-4, 1e-4])), np.diag([1e5, 1e5, 1e5])
    off = np.array(
        [0.0, 0.0, 0.2]
    )  # 20 sigmas: the match has held on to its prior by a fraction only
    held = 9.0 / (9.0 + 0.2**2 / 1e-4)
    posterior = np.linalg.inv(by_map + held * np.linalg.inv(doubt.since_match))
    np.testing.assert_allclose(doubt.evidence(posterior, off).by_map, by_map, atol=1e-3)
