"""Poses of a robot that is lost, for those who know their covariance alone."""

import numpy as np

from thinmap_ros.core.stage import Estimate
from thinmap_ros.ros import messages


def test_the_pose_of_a_lost_robot_is_unsure_and_that_of_another_as_it_is() -> None:
    own = np.diag([0.04, 0.01, 0.02])
    for is_lost in (False, True):
        estimate = Estimate(np.array([1.0, 2.0, 0.5]), own, np.zeros(3), is_lost=is_lost)
        message = messages.estimate_msg(estimate, 'map', 5)
        np.testing.assert_allclose(messages.pose_from_msg(message.pose.pose), [1.0, 2.0, 0.5])
        said = messages.covariance_from_msg(message)
        if is_lost:
            assert (np.diag(said) > [100.0**2, 100.0**2, 9.0]).all()
        else:
            np.testing.assert_allclose(said, own)
