"""Motion and observation models: known results and Jacobians.

Every Jacobian is compared with numeric differences of independent implementations.
"""

import cmath
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core.ekf_slam.features import (
    OdometryConfig,
    motion_jacobians,
    observe_line,
    odometry_variances,
    place_line,
)

poses = st.tuples(*[st.floats(-20.0, 20.0)] * 2, st.floats(-3.1, 3.1)).map(np.array)
lines = st.tuples(st.floats(0.0, 30.0), st.floats(-3.1, 3.1)).map(np.array)
increments = st.tuples(*[st.floats(-1.0, 1.0)] * 2, st.floats(-1.0, 1.0)).map(np.array)


def numeric(function, x, angles):
    """Central differences; `angles` lists the outputs that are angles."""
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
    """Foot of the perpendicular from the robot to the line, robot frame, polar coordinates."""
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
    if expected[0] < 0.01:  # on the line itself the direction of the foot is undefined
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


@pytest.mark.parametrize('metres, radians', [(0.0, 0.0), (0.5, 0.0), (0.0, -0.4), (-0.3, 0.2)])
def test_odometry_noise_is_a_floor_plus_a_share_of_the_motion(metres, radians):
    config = OdometryConfig(noise_ratio=0.1, noise_floor_m=0.01, noise_floor_rad=0.02)
    sigmas = np.sqrt(odometry_variances(np.array([0.6 * metres, 0.8 * metres, radians]), config))
    along = 0.01 + 0.1 * abs(metres)
    np.testing.assert_allclose(sigmas, [along, along, 0.02 + 0.1 * abs(radians)])
