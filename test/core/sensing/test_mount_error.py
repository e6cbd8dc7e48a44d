"""The error of the laser's pose on the robot, from motions by matching and by odometry."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core import se2
from thinmap_ros.core.sensing.consistency import MountErrorConfig, MountErrorEstimator

GIVEN = se2.pose(0.2, -0.1, 0.4)
NOWHERE = np.zeros(3)
# A match within 1 cm and 0.3 degrees.
INFORMATION = np.diag([1e4, 1e4, 4e4])
CORRIDOR = np.diag([1e-9, 1e4, 4e4])


def true_motion(rng, metres, turn=0.3):
    """Steps (3,) of 5 cm, straight and in curves, with turns in place between them."""
    path_m = 0.0
    while path_m < metres:
        curve = rng.uniform(-turn, turn)
        for _ in range(20):
            path_m += 0.05
            yield np.array([0.05, 0.0, 0.05 * curve])
        for _ in range(10):
            yield np.array([0.0, 0.0, 0.1 * np.sign(curve)])


class Drive:
    """A robot whose laser is off its given pose by an error E, and an estimator that follows."""

    def __init__(self, seed=3, information=INFORMATION):
        self.rng = np.random.default_rng(seed)
        self.estimator = MountErrorEstimator()
        self.truth = np.zeros(3)
        self.odom = se2.pose(5.0, -3.0, 2.0)
        self.information = information
        self.path_m = 0.0
        self.estimates = []

    def step(self, motion, error, odometry=lambda motion: motion):
        self.truth = se2.compose(self.truth, motion)
        self.path_m += abs(motion[0])
        self.odom = se2.compose(self.odom, odometry(motion))
        noise = self.rng.normal(0.0, 1.0, 3) * [0.01, 0.01, 0.005]
        matched = se2.compose(self.truth, error) + noise
        if self.estimator.add(matched, self.information, self.odom, GIVEN):
            self.estimates += self.estimator.estimates(GIVEN)

    def run(self, metres, error=NOWHERE, odometry=lambda motion: motion, turn=0.3):
        for motion in true_motion(self.rng, metres, turn):
            self.step(motion, error, odometry)
        return self.estimates[-1]


def mounted(T_base_laser):
    """Error E of the estimated robot pose, where the laser is in truth at a pose (3,)."""
    return se2.compose(T_base_laser, se2.invert(GIVEN))


@pytest.mark.parametrize('deg', [0.0, 4.0, -15.0, 45.0, -120.0, 180.0])
@pytest.mark.parametrize('offset', [(0.0, 0.0), (0.25, -0.1)])
def test_yaw_and_offset_are_found(deg, offset):
    true = GIVEN + np.array([*offset, math.radians(deg)])
    found = Drive().run(12.0, mounted(true))
    assert abs(se2.wrap(found.yaw_rad - math.radians(deg))) < math.radians(1.5)
    assert found.offset_m == pytest.approx(offset, abs=0.03)
    assert found.yaw_sigma_rad < math.radians(2.0) and found.offset_sigma_m < 0.03


@given(st.integers(0, 10_000), st.floats(-3.0, 3.0), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_the_standard_deviations_are_honest(seed, yaw, x, y):
    found = Drive(seed).run(8.0, mounted(GIVEN + np.array([x, y, yaw])))
    assert abs(se2.wrap(found.yaw_rad - yaw)) < 3.0 * found.yaw_sigma_rad
    assert np.hypot(*(found.offset_m - (x, y))) < 4.0 * found.offset_sigma_m


@pytest.mark.parametrize(('deg', 'certain'), [(10.0, 5.0), (30.0, 20.0), (-60.0, 20.0)])
def test_a_slip_in_the_middle_of_a_drive_is_found_within_some_metres(deg, certain):
    drive = Drive()
    drive.run(15.0)
    drive.estimates.clear()
    begin_m = drive.path_m
    slipped = mounted(GIVEN + np.array([0.0, 0.0, math.radians(deg)]))
    for motion in true_motion(drive.rng, 8.0, turn=0.1):
        drive.step(motion, slipped)
        if any(e.least_yaw_rad > math.radians(certain) for e in drive.estimates):
            break
    assert drive.path_m - begin_m < 6.0


def test_after_more_spans_than_are_kept_an_earlier_pose_is_forgotten():
    config = MountErrorConfig()
    drive = Drive()
    drive.run(15.0, mounted(GIVEN + np.array([0.0, 0.0, 0.5])))
    found = drive.run(1.5 * max(config.windows) * config.span_m)
    assert abs(found.yaw_rad) < 0.03


@pytest.mark.parametrize(
    'odometry',
    [
        pytest.param(lambda m: m * [1.1, 1.0, 1.0], id='wheels of another size'),
        pytest.param(lambda m: m + [0.0, 0.0, 0.1 * m[0]], id='unequal wheels'),
        pytest.param(lambda m: m * [1.0, 1.0, 0.8], id='another wheel base'),
        pytest.param(lambda m: m * [1.0, 1.0, 0.0], id='odometry that does not turn'),
    ],
)
def test_systematic_errors_of_the_odometry_are_no_error_of_the_mount(odometry):
    drive = Drive()
    drive.run(30.0, odometry=odometry)
    least_yaw = [error.least_yaw_rad for error in drive.estimates]
    least_m = [error.least_offset_m for error in drive.estimates]
    assert max(least_yaw) < math.radians(1.0) and max(least_m) < 0.02


def test_an_odometry_that_integrates_arcs_against_their_turn_shows_no_yaw():
    """A published driver of a vacuum robot: each step is turned by minus its own turn."""

    class Coarse:
        heading = 0.0

        def __call__(self, motion):
            turn = float(motion[2])
            self.heading += turn
            return np.array(
                [motion[0] * math.cos(4.0 * turn), -motion[0] * math.sin(4.0 * turn), turn]
            )

    drive = Drive()
    for _ in range(400):
        drive.step(np.array([0.05, 0.0, 0.05]), NOWHERE, Coarse())
    least = [error.least_yaw_rad for error in drive.estimates]
    assert max(least) < math.radians(5.0)


def test_pushes_slips_and_jumps_of_the_odometry_are_outliers():
    drive = Drive()
    for number, motion in enumerate(true_motion(drive.rng, 40.0)):
        if number % 150 == 40:  # a robot that is pushed to the side
            drive.truth = se2.compose(drive.truth, np.array([0.0, 0.4, 0.0]))
        if number % 150 == 90:  # wheels that spin
            drive.odom = se2.compose(drive.odom, np.array([0.3, 0.0, 0.2]))
        if number == 200:  # a driver that was restarted
            drive.odom = np.zeros(3)
        drive.step(motion, NOWHERE)
    least_yaw = [error.least_yaw_rad for error in drive.estimates]
    least_m = [error.least_offset_m for error in drive.estimates]
    assert max(least_yaw) < math.radians(3.0) and max(least_m) < 0.05


def test_without_motion_by_odometry_nothing_is_estimated():
    drive = Drive()
    for motion in true_motion(drive.rng, 20.0):
        drive.step(motion, NOWHERE, lambda motion: np.zeros(3))
    assert not drive.estimates


def test_along_a_corridor_the_direction_across_it_is_enough():
    true = mounted(GIVEN + np.array([0.0, 0.0, 0.5]))
    drive = Drive(information=CORRIDOR)
    for _ in range(300):
        drive.step(np.array([0.05, 0.0, 0.0]), true)
    found = drive.estimates[-1]
    assert found.yaw_rad == pytest.approx(0.5, abs=0.05)


def test_a_span_does_not_reach_over_a_pose_that_is_unknown():
    drive = Drive()
    drive.run(6.0)
    before = drive.estimates[-1]
    drive.estimator.reset_span()
    drive.truth = se2.compose(drive.truth, np.array([5.0, 3.0, 1.0]))
    drive.run(1.0)
    assert abs(drive.estimates[-1].yaw_rad - before.yaw_rad) < 0.03
    assert len(drive.estimates) > 10
