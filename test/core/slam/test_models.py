"""Motion and observation: known answers and Jacobians.

Every Jacobian is held against numeric differences of functions written anew.
"""

import cmath
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core import se2
from thinmap_ros.core.slam.models import (
    MotionConfig,
    motion_jacobians,
    observe_line,
    odometry_covariance,
    place_line,
)

poses = st.tuples(*[st.floats(-20.0, 20.0)] * 2, st.floats(-3.1, 3.1)).map(np.array)
lines = st.tuples(st.floats(0.0, 30.0), st.floats(-3.1, 3.1)).map(np.array)
increments = st.tuples(*[st.floats(-1.0, 1.0)] * 2, st.floats(-1.0, 1.0)).map(np.array)


def numeric(function, x, angles):
    """Central differences; the listed outputs are angles."""
    columns = []
    for i in range(len(x)):
        step = np.zeros(len(x))
        step[i] = 1e-6
        change = np.asarray(function(x + step)) - np.asarray(function(x - step))
        for k in angles:
            change[k] = math.remainder(change[k], 2.0 * math.pi)
        columns.append(change / 2e-6)
    return np.column_stack(columns)


def moved(pose, increment):
    """Composition with complex numbers instead of matrices."""
    z = complex(pose[0], pose[1]) + complex(increment[0], increment[1]) * cmath.exp(1j * pose[2])
    return [z.real, z.imag, pose[2] + increment[2]]


def seen(pose, line):
    """Foot of the perpendicular from the robot on the line, in the robot's frame, in polar form."""
    on_line = line[0] * cmath.exp(1j * line[1])
    normal = cmath.exp(1j * line[1])
    robot = complex(pose[0], pose[1])
    foot = robot + ((on_line - robot) * normal.conjugate()).real * normal
    relative = (foot - robot) * cmath.exp(-1j * pose[2])
    return [abs(relative), cmath.phase(relative)]


@given(poses, increments)
def test_motion_jacobians(pose, increment):
    F_x, F_u = motion_jacobians(pose, increment)
    np.testing.assert_allclose(F_x, numeric(lambda x: moved(x, increment), pose, [2]), atol=1e-6)
    np.testing.assert_allclose(F_u, numeric(lambda u: moved(pose, u), increment, [2]), atol=1e-6)


@given(poses, lines)
def test_observation_and_its_jacobians(pose, line):
    expected, by_pose, by_line = observe_line(pose, line)
    if expected[0] < 0.01:  # seen from on the line itself the direction of the foot is undefined
        return
    reference = seen(pose, line)
    assert expected[0] == pytest.approx(reference[0], abs=1e-9)
    assert math.remainder(expected[1] - reference[1], 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(by_pose, numeric(lambda x: seen(x, line), pose, [1]), atol=1e-4)
    np.testing.assert_allclose(by_line, numeric(lambda x: seen(pose, x), line, [1]), atol=1e-4)


@given(poses, lines)
def test_placing_a_line_undoes_the_observation(pose, line):
    expected, _, _ = observe_line(pose, line)
    placed, _, _ = place_line(pose, expected)
    normal = placed[0] * np.array([math.cos(placed[1]), math.sin(placed[1])])
    np.testing.assert_allclose(
        normal, line[0] * np.array([math.cos(line[1]), math.sin(line[1])]), atol=1e-7
    )
    assert placed[0] >= 0.0


@given(poses, lines)
def test_placement_jacobians(pose, z):
    placed, by_pose, by_seen = place_line(pose, z)
    if placed[0] < 0.01:
        return
    np.testing.assert_allclose(
        by_pose, numeric(lambda x: place_line(x, z)[0], pose, [1]), atol=1e-4
    )
    np.testing.assert_allclose(
        by_seen, numeric(lambda x: place_line(pose, x)[0], z, [1]), atol=1e-4
    )


def test_a_line_passed_by_is_seen_from_its_other_side():
    wall = np.array([2.0, 0.0])  # x = 2
    np.testing.assert_allclose(observe_line(np.zeros(3), wall)[0], [2.0, 0.0])
    np.testing.assert_allclose(observe_line(np.array([5.0, 1.0, 0.0]), wall)[0], [3.0, math.pi])


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
