"""Pose uncertainty: covariance of a step during which the pose was set."""

import numpy as np

from thinmap_ros.core.slam.odometry import UNKNOWN, PoseUncertainty


def test_a_robot_that_is_put_somewhere_else_may_have_come_from_anywhere():
    uncertainty = PoseUncertainty(np.zeros(3))
    covariance = np.diag([0.04, 0.09, 0.01])
    uncertainty.place(np.array([5.0, 1.0, 0.5]), covariance)
    step, jump = uncertainty.step()
    np.testing.assert_allclose(jump, UNKNOWN + covariance, atol=1e-4)
    assert np.trace(step) < 1e-4
    assert np.linalg.eigvalsh(uncertainty.since_anchor).min() > 0.0
