"""Planar poses: group laws and conventions."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core import se2

number = st.floats(-50.0, 50.0)
poses = st.builds(se2.pose, number, number, st.floats(-10.0, 10.0))


@given(st.floats(-1e4, 1e4))
def test_wrap_lands_in_the_half_open_interval_and_keeps_the_direction(angle):
    wrapped = se2.wrap(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_wrap_of_an_array_equals_wrap_of_each_and_keeps_pi():
    angles = np.linspace(-20.0, 20.0, 101)
    np.testing.assert_allclose(se2.wrap(angles), [se2.wrap(a) for a in angles])
    assert se2.wrap(math.pi) == math.pi
    assert se2.wrap(-math.pi) == math.pi


@given(poses, poses)
def test_between_undoes_compose(a, b):
    np.testing.assert_allclose(se2.compose(a, se2.between(a, b))[:2], b[:2], atol=1e-9)
    assert abs(se2.wrap(float(se2.compose(a, se2.between(a, b))[2] - b[2]))) < 1e-9


@given(poses, poses)
def test_points_move_like_poses(a, b):
    np.testing.assert_allclose(
        se2.transform_points(a, b[None, :2])[0], se2.compose(a, b)[:2], atol=1e-9
    )


def test_a_step_ahead_of_a_robot_facing_north_goes_north():
    np.testing.assert_allclose(
        se2.compose(se2.pose(1, 2, math.pi / 2), se2.pose(1, 0, 0))[:2], [1, 3]
    )


def test_interpolation_turns_in_the_shorter_direction():
    middle = se2.interpolate(se2.pose(0, 0, 3.0), se2.pose(2, 0, -3.0), 0.5)
    np.testing.assert_allclose(middle, [1.0, 0.0, math.pi])


@given(number, number, number)
def test_variances_are_the_eigenvalues_of_a_covariance(a, b, c):
    root = np.array([[a, 0.0], [b, c]])
    covariance = root @ root.T
    expected = np.linalg.eigvalsh(covariance)
    np.testing.assert_allclose(se2.variances(covariance), expected, rtol=1e-9, atol=1e-9)


def test_many_poses_compose_as_each_does():
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [-4.0, 0.5, -2.0]])
    others = np.array([[1.0, 0.0, 0.5], [0.2, -0.3, 1.0], [2.0, 1.0, -3.0]])
    expected = [se2.compose(a, b) for a, b in zip(poses, others, strict=True)]
    np.testing.assert_allclose(se2.compose_each(poses, others), expected, atol=1e-12)
    by_one = [se2.compose(a, others[0]) for a in poses]
    np.testing.assert_allclose(se2.compose_each(poses, others[:1]), by_one, atol=1e-12)


def test_of_poses_that_are_near_each_other_the_first_is_kept():
    poses = np.array(
        [
            [0.0, 0.0, math.pi],
            [0.4, 0.4, -math.pi + 0.05],  # near, across half a turn
            [0.4, 0.6, math.pi],  # farther in y
            [0.0, 0.0, 3.0],  # turned
            [0.1, 0.1, 3.0],
        ]
    )
    assert se2.distinct(poses, 0.5, 0.1, 9) == [0, 2, 3]
    assert se2.distinct(poses, 0.5, 0.1, 2) == [0, 2]
    assert se2.distinct(poses[:0], 0.5, 0.1, 2) == []
