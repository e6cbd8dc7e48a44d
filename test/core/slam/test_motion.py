"""The motion model: who is believed, odometry or velocity, as the scans have told."""

import numpy as np
import pytest

from thinmap_ros.core.slam.motion import MotionConfig, MotionModel

SECONDS = 0.2
CONFIG = MotionConfig()
SLIP = np.array([CONFIG.odom_slip_m, CONFIG.odom_slip_m, CONFIG.odom_slip_rad])
KNOWN = np.diag([1e8, 1e8, 1e8])  # a scan tells the motion all but exactly
STEP = np.array([0.1, 0.0, 0.05])


def allowed(increment, config=CONFIG):
    """Variances (3,) of an odometry increment, as documented."""
    sigma_m = config.odom_slip_m + config.odom_noise * np.hypot(*increment[:2])
    sigma_rad = config.odom_slip_rad + config.odom_noise * abs(increment[2])
    return np.square([sigma_m, sigma_m, sigma_rad])


def told(model, truths, odometries, information=KNOWN):
    """A model after scans that found the true motions; what it expected."""
    expected = []
    for truth, odometry in zip(truths, odometries, strict=True):
        expected.append(model.expect(odometry, SECONDS))
        model.learn(truth, information)
    return expected


def odometry_shares(model):
    return model._odometry.share


def test_the_first_motion_is_that_of_the_odometry():
    motion = MotionModel(CONFIG).expect(STEP, 0.0)
    np.testing.assert_array_equal(motion.increment, STEP)
    np.testing.assert_allclose(motion.variances, allowed(STEP))


def test_a_good_odometry_keeps_its_share(rng):
    model = MotionModel(CONFIG)
    truths = STEP + rng.normal(0.0, 0.3, (200, 3)) * SLIP
    told(model, truths, truths + rng.normal(0.0, 0.5, (200, 3)) * np.sqrt(allowed(STEP)))
    np.testing.assert_array_equal(odometry_shares(model), 1.0)


def test_what_was_expected_is_weighted_by_information():
    """Of odometry, and of the velocity that the last match gave."""
    model = MotionModel(CONFIG)
    told(model, [STEP], [STEP])
    odometry = STEP + [0.02, 0.0, -0.03]
    motion = model.expect(odometry, SECONDS)
    by_odometry = 1.0 / allowed(odometry)
    # The velocity before was found from two poses, as uncertain as the slip.
    sigma = 2.0 * SLIP + SECONDS**2 * np.array([0.5, 0.5, 1.0])
    np.testing.assert_allclose(CONFIG.acceleration_m_s2, 0.5)
    np.testing.assert_allclose(CONFIG.acceleration_rad_s2, 1.0)
    # The last scan was one of a step without a time before it: its pause counts as this one.
    by_velocity = 1.0 / np.square(sigma)
    mean = (by_odometry * odometry + by_velocity * STEP) / (by_odometry + by_velocity)
    np.testing.assert_allclose(motion.increment, mean, atol=1e-12)
    np.testing.assert_allclose(motion.variances, 1.0 / (by_odometry + by_velocity))


def test_two_headings_either_side_of_the_wrap_have_their_mean_there():
    """Turns of almost half a circle, one way and the other."""
    model = MotionModel(CONFIG)
    told(model, [np.array([0.0, 0.0, 3.1])], [np.array([0.0, 0.0, 3.1])])
    motion = model.expect(np.array([0.0, 0.0, -3.1]), SECONDS)
    assert abs(motion.increment[2]) > 3.09


@pytest.mark.parametrize('turn', [0.2, -0.2])
def test_an_odometry_that_does_not_turn_loses_its_say_in_turns(turn):
    truth = np.array([0.1, 0.0, turn])
    blind = np.array([0.1, 0.0, 0.0])
    model = MotionModel(CONFIG)
    expected = told(model, [truth] * 100, [blind] * 100)
    translation, rotation = odometry_shares(model)
    assert translation == 1.0
    assert rotation > 10.0
    assert abs(expected[1].increment[2] - turn) > 0.05
    assert abs(expected[-1].increment[2] - turn) < 0.03
    assert expected[-1].increment[0] == pytest.approx(0.1)


def test_an_odometry_that_turns_again_is_forgiven():
    truth = np.array([0.1, 0.0, 0.2])
    model = MotionModel(CONFIG)
    told(model, [truth] * 60, [np.array([0.1, 0.0, 0.0])] * 60)
    worst = odometry_shares(model)[1]
    told(model, [truth] * 200, [truth] * 200)
    assert worst > 5.0
    assert odometry_shares(model)[1] == pytest.approx(1.0, abs=0.05)


def test_a_single_slip_changes_little():
    model = MotionModel(CONFIG)
    told(model, [STEP] * 30, [STEP] * 30)
    told(model, [STEP], [STEP + [0.5, 0.0, 1.0]])
    shares = odometry_shares(model).copy()
    assert shares.max() < 2.0
    motion = model.expect(STEP, SECONDS)
    np.testing.assert_allclose(motion.increment, STEP, atol=1e-9)
    told(model, [STEP] * 60, [STEP] * 60)
    assert odometry_shares(model).max() == 1.0


def test_slips_beyond_three_sigmas_all_say_the_same():
    found = []
    for slip in (0.2, 2.0, 20.0):
        model = MotionModel(CONFIG)
        told(model, [STEP] * 30, [STEP] * 30)
        told(model, [STEP], [STEP + [slip, 0.0, 0.0]])
        found.append(odometry_shares(model)[0])
    assert 1.0 < found[0] < 1.5
    assert np.ptp(found) < 1e-3


def test_what_the_scan_does_not_know_teaches_nothing():
    """As along a corridor: the match gives back what was expected."""
    model = MotionModel(CONFIG)
    nothing = np.zeros((3, 3))
    for _ in range(50):
        expected = model.expect(STEP, SECONDS).increment
        model.learn(expected, nothing)
    np.testing.assert_allclose(odometry_shares(model), 1.0)


def test_wheels_that_stand_while_the_robot_is_driven_lose_their_say():
    """An odometry that is zero all the time: a hand-held laser."""
    truth = np.array([0.16, 0.0, 0.2])
    model = MotionModel(CONFIG)
    off = [np.abs(m.increment - truth) for m in told(model, [truth] * 100, [np.zeros(3)] * 100)]
    np.testing.assert_array_equal(off[0], truth)
    assert (off[-1] <= 0.25 * truth).all()


def test_a_robot_that_stands_is_told_to_stand():
    model = MotionModel(CONFIG)
    expected = told(model, [np.zeros(3)] * 20, [np.zeros(3)] * 20)
    for motion in expected:
        assert motion.stands
        np.testing.assert_array_equal(motion.increment, 0.0)
    np.testing.assert_array_equal(odometry_shares(model), 1.0)


@pytest.mark.parametrize('axis', range(3))
@pytest.mark.parametrize('sign', [-1.0, 1.0])
def test_more_than_slip_is_motion(axis, sign):
    for sigmas, stands in ((2.9, True), (3.1, False)):
        increment = np.zeros(3)
        increment[axis] = sign * sigmas * SLIP[axis]
        assert MotionModel(CONFIG).expect(increment, SECONDS).stands is stands


def test_what_goes_on_without_wheels_does_not_stand():
    """The wheels are blocked; the scans see the robot pushed on."""
    model = MotionModel(CONFIG)
    push = np.array([0.15, 0.0, 0.0])
    expected = told(model, [push] * 40, [np.zeros(3)] * 40)
    assert expected[0].stands
    assert not expected[-1].stands


def test_after_an_interruption_there_is_no_velocity():
    model = MotionModel(CONFIG)
    told(model, [STEP] * 5, [STEP] * 5)
    model.interrupt()
    motion = model.expect(np.zeros(3), SECONDS)
    np.testing.assert_array_equal(motion.increment, 0.0)
    np.testing.assert_allclose(motion.variances, allowed(np.zeros(3)))


def test_a_scan_of_the_same_moment_has_no_velocity():
    model = MotionModel(CONFIG)
    told(model, [STEP] * 5, [STEP] * 5)
    motion = model.expect(np.zeros(3), 0.0)
    np.testing.assert_array_equal(motion.increment, 0.0)
    model.learn(np.zeros(3), KNOWN)
    again = model.expect(np.zeros(3), SECONDS)
    assert np.isfinite(again.increment).all()
    assert (again.variances > 0.0).all()


@pytest.mark.parametrize('seconds', [0.01, 0.2, 1.0, 10.0, 3600.0])
def test_the_longer_the_pause_the_less_a_velocity_says(seconds):
    model = MotionModel(CONFIG)
    told(model, [STEP] * 5, [STEP] * 5)
    motion = model.expect(np.zeros(3), seconds)
    assert np.isfinite(motion.increment).all()
    assert (motion.variances <= allowed(np.zeros(3))).all()
    if seconds >= 10.0:
        np.testing.assert_allclose(motion.increment, 0.0, atol=0.01)


def test_variances_are_those_of_the_errors(rng):
    """An odometry three times as bad as it is taken to be, over many steps."""
    model = MotionModel(CONFIG)
    truths = np.tile(STEP, (600, 1)) + rng.normal(0.0, 0.02, (600, 3))
    odometries = truths + 3.0 * rng.normal(0.0, 1.0, (600, 3)) * np.sqrt(allowed(STEP))
    expected = told(model, truths, odometries)
    off = np.array([m.increment - t for m, t in zip(expected, truths, strict=True)])[100:]
    sigmas = np.sqrt(np.array([m.variances for m in expected]))[100:]
    scaled = np.sqrt(np.mean(np.square(off / sigmas), axis=0))
    assert scaled.max() < 2.0
    assert odometry_shares(model).min() > 3.0
