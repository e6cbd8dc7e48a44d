"""Information of a scan that knows nothing in one direction."""

import numpy as np
import pytest

from thinmap_ros.core.slam.matching.scan_matcher import semidefinite


@pytest.mark.parametrize('seed', range(20))
def test_no_variance_is_negative_with_a_prior_that_knows_nothing(seed):
    angle = np.random.default_rng(seed).uniform(-3.0, 3.0)
    axes = np.array(
        [
            [np.cos(angle), -np.sin(angle), 0.0],
            [np.sin(angle), np.cos(angle), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    rounded = axes @ np.diag([-7.6e-5, 5e3, 1.3e5]) @ axes.T
    prior = np.diag([1.0 / 360.0**2, 1.0 / 360.0**2, 1.0])
    assert np.linalg.eigvalsh(np.linalg.inv(rounded + prior)).min() < 0.0
    information = semidefinite(rounded)
    assert np.linalg.eigvalsh(np.linalg.inv(information + prior)).min() > 0.0
    np.testing.assert_allclose(information, rounded, atol=1e-4)


def test_a_scan_that_knows_all_directions_is_left_as_it_is():
    information = np.diag([1.0, 2.0, 3.0])
    assert semidefinite(information) is information
