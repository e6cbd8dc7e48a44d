"""Noise of wheel odometry of the localizer before."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.models import motion_jacobians
from thinmap_ros.core.slam.wheel_noise import MotionConfig, odometry_covariance

increments = st.tuples(*[st.floats(-1.0, 1.0)] * 2, st.floats(-1.0, 1.0)).map(np.array)


@given(increments)
def test_odometry_noise_is_a_covariance(increment):
    Q = odometry_covariance(increment, MotionConfig())
    np.testing.assert_array_equal(Q, Q.T)
    assert np.linalg.eigvalsh(Q).min() > 0.0


def test_doubt_after_a_drive_does_not_depend_on_the_number_of_scans():
    config = MotionConfig(odom_slip_m=1e-5, odom_slip_rad=1e-5)

    def after(steps):
        P, pose, u = np.zeros((3, 3)), np.zeros(3), np.array([4.0 / steps, 0.0, 0.0])
        for _ in range(steps):
            F_x, F_u = motion_jacobians(pose, u)
            P = F_x @ P @ F_x.T + F_u @ odometry_covariance(u, config) @ F_u.T
            pose = se2.compose(pose, u)
        return P

    np.testing.assert_allclose(after(40), after(400), rtol=0.05, atol=1e-7)
    assert math.sqrt(after(40)[0, 0]) == pytest.approx(2.0 * config.odom_distance_sigma, rel=1e-6)


def test_turning_noise_matches_an_arc_driven_many_times(rng):
    config = MotionConfig(odom_slip_m=1e-5, odom_slip_rad=1e-5)
    d, phi = 0.5, 0.6
    noise = [config.odom_distance_sigma * math.sqrt(d)]
    noise.append(
        math.hypot(config.odom_turn_sigma * math.sqrt(phi), config.odom_drift_sigma * math.sqrt(d))
    )
    off = np.array(noise)[:, None] * rng.normal(size=(2, 20000)) * 0.2
    chords, turns = np.array([d, phi])[:, None] + off
    samples = np.stack([chords * np.cos(turns / 2.0), chords * np.sin(turns / 2.0), turns])
    mean = np.array([d * math.cos(phi / 2.0), d * math.sin(phi / 2.0), phi])
    expected = odometry_covariance(mean, config)
    np.testing.assert_allclose(np.cov(samples) / 0.04, expected, rtol=0.1, atol=2e-5)
