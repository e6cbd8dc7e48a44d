"""The motion model: adaptation of the odometry noise to the innovations of scan matching."""

import numpy as np
import pytest

from thinmap_ros.core.slam.odometry import MotionConfig, MotionModel

CONFIG = MotionConfig()
SLIP = np.array([CONFIG.noise_floor_m, CONFIG.noise_floor_m, CONFIG.noise_floor_rad])
KNOWN = np.diag([1e8, 1e8, 1e8])  # information of a nearly exact match
CALIBRATED = np.zeros((3, 3))
STEP = np.array([0.1, 0.0, 0.05])


def allowed(increment):
    """Variances (3,) of an odometry increment, as documented."""
    sigma_m = CONFIG.noise_floor_m + CONFIG.noise_ratio * np.hypot(*increment[:2])
    sigma_rad = CONFIG.noise_floor_rad + CONFIG.noise_ratio * abs(increment[2])
    return np.square([sigma_m, sigma_m, sigma_rad])


def learn(model, truths, odometries, information=KNOWN):
    """Predicted sigmas (N, 3) of motions before each update."""
    sigmas = []
    for truth, odometry in zip(truths, odometries, strict=True):
        sigmas.append(np.sqrt(np.diag(model.predict(odometry, CALIBRATED).covariance)))
        model.update(truth, information)
    return np.array(sigmas)


def sigmas_of(model, increment=STEP):
    return np.sqrt(np.diag(model.predict(increment, CALIBRATED).covariance))


def test_the_first_motion_is_as_uncertain_as_the_model_allows():
    motion = MotionModel(CONFIG).predict(STEP, CALIBRATED)
    np.testing.assert_array_equal(motion.increment, STEP)
    np.testing.assert_allclose(motion.covariance, np.diag(allowed(STEP)))


def test_what_the_calibration_leaves_open_is_part_of_the_uncertainty():
    systematic = np.diag([4e-4, 1e-4, 9e-4])
    motion = MotionModel(CONFIG).predict(STEP, systematic)
    np.testing.assert_allclose(motion.covariance, np.diag(allowed(STEP)) + systematic)


def test_a_good_odometry_is_trusted_no_more_than_the_model_allows(rng):
    model = MotionModel(CONFIG)
    truths = STEP + rng.normal(0.0, 0.3, (200, 3)) * SLIP
    learn(model, truths, truths + rng.normal(0.0, 0.3, (200, 3)) * np.sqrt(allowed(STEP)))
    np.testing.assert_allclose(sigmas_of(model), np.sqrt(allowed(STEP)), rtol=0.05)


@pytest.mark.parametrize('turn', [0.2, -0.2])
def test_an_odometry_that_does_not_turn_is_trusted_in_translation_alone(turn):
    truth = np.array([0.1, 0.0, turn])
    without = np.array([0.1, 0.0, 0.0])
    sigmas = learn(MotionModel(CONFIG), [truth] * 100, [without] * 100)
    np.testing.assert_allclose(sigmas[-1, :2], sigmas[0, :2])
    assert 3.0 * sigmas[0, 2] < abs(turn)
    assert sigmas[-1, 2] > 0.5 * abs(turn)


def test_an_odometry_that_never_moves_is_known_for_what_it_is_after_ten_scans():
    truth = np.array([0.16, 0.0, 0.2])
    sigmas = learn(MotionModel(CONFIG), [truth] * 11, [np.zeros(3)] * 11)
    assert (5.0 * sigmas[-1, [0, 2]] > truth[[0, 2]]).all()


def test_an_odometry_that_turns_again_is_trusted_again():
    truth = np.array([0.1, 0.0, 0.2])
    model = MotionModel(CONFIG)
    learn(model, [truth] * 60, [np.array([0.1, 0.0, 0.0])] * 60)
    worst = sigmas_of(model, truth)[2]
    learn(model, [truth] * 300, [truth] * 300)
    assert worst > 3.0 * np.sqrt(allowed(truth)[2])
    assert sigmas_of(model, truth)[2] == pytest.approx(np.sqrt(allowed(truth)[2]), rel=0.05)


def test_a_single_slip_changes_little():
    model = MotionModel(CONFIG)
    learn(model, [STEP] * 30, [STEP] * 30)
    learn(model, [STEP], [STEP + [0.5, 0.0, 1.0]])
    assert (sigmas_of(model) < 1.5 * np.sqrt(allowed(STEP))).all()
    learn(model, [STEP] * 60, [STEP] * 60)
    np.testing.assert_allclose(sigmas_of(model), np.sqrt(allowed(STEP)))


def test_slips_beyond_three_sigmas_all_count_the_same():
    found = []
    for slip in (0.2, 2.0, 20.0):
        model = MotionModel(CONFIG)
        learn(model, [STEP] * 30, [STEP] * 30)
        learn(model, [STEP], [STEP + [slip, 0.0, 0.0]])
        found.append(sigmas_of(model)[0])
    assert found[0] > 1.01 * np.sqrt(allowed(STEP)[0])
    np.testing.assert_allclose(found, found[0], rtol=1e-3)


def test_a_scan_that_measures_nothing_teaches_nothing():
    """As along a corridor: the match returns the prediction."""
    model = MotionModel(CONFIG)
    learn(model, [STEP] * 50, [STEP] * 50, np.zeros((3, 3)))
    np.testing.assert_allclose(sigmas_of(model), np.sqrt(allowed(STEP)))


def test_a_match_with_half_the_weight_updates_by_the_square_of_its_gain():
    """A match with half the weight shows half of the motion error, with noise of the scan."""
    model = MotionModel(CONFIG)
    variances = allowed(STEP)
    model.predict(STEP, CALIBRATED)
    model._share[:] = 4.0
    motion = np.diag(model.predict(STEP, CALIBRATED).covariance).copy()
    np.testing.assert_allclose(motion, 4.0 * variances)
    model.update(STEP, np.diag(1.0 / motion))  # no innovation, and half the weight
    # The first update has a rate of a half, times a quarter, and removes the excess.
    np.testing.assert_allclose(model._share, 4.0 * (1.0 - 0.5 * 0.25))


def test_a_clear_error_teaches_though_the_scan_decides_little():
    """An innovation far beyond the scan's noise is an odometry error, for any weights."""
    shares = []
    for off in (0.5, 2.0, 50.0):
        model = MotionModel(CONFIG)
        motion = np.diag(model.predict(STEP, CALIBRATED).covariance).copy()
        scan_information = np.diag(1.0 / (9.0 * motion))  # a gain of a tenth
        slip = np.array([off * 3.0 * np.sqrt(motion[0]), 0.0, 0.0])
        model.update(STEP + 0.1 * slip, scan_information)
        shares.append(model._share[0])
    assert shares[0] == 1.0, "within the scan's error"
    assert shares[0] < shares[1] < shares[2]
    # Rate 0.5 of the first update, half for one of two axes, limited to nine shares, minus one.
    assert shares[2] == pytest.approx(1.0 + 0.25 * 8.0 - 0.25 * 0.01, rel=0.01)


@pytest.mark.parametrize('axis', range(3))
@pytest.mark.parametrize('sign', [-1.0, 1.0])
def test_more_than_slip_is_motion(axis, sign):
    for sigmas, is_stationary in ((2.9, True), (3.1, False)):
        increment = np.zeros(3)
        increment[axis] = sign * sigmas * SLIP[axis]
        assert MotionModel(CONFIG).predict(increment, CALIBRATED).is_stationary is is_stationary


def test_variances_are_those_of_the_errors(rng):
    """Odometry with three times the modelled noise, over many steps."""
    truths = np.tile(STEP, (600, 1)) + rng.normal(0.0, 0.02, (600, 3))
    errors = 3.0 * rng.normal(0.0, 1.0, (600, 3)) * np.sqrt(allowed(STEP))
    sigmas = learn(MotionModel(CONFIG), truths, truths + errors)
    scaled = np.sqrt(np.mean(np.square(errors[100:] / sigmas[100:]), axis=0))
    assert (scaled < 1.5).all()
    assert (scaled > 0.6).all()


@pytest.mark.parametrize(('along', 'is_open'), [(3e4, True), (500.0, False)])
def test_a_scan_that_slides_along_a_corridor_is_no_error_of_the_odometry(along, is_open):
    """In a smooth corridor the matches of a moving robot do not move: all are wrong."""
    information = np.diag([along, 3e4, 1e5])
    model = MotionModel(CONFIG)
    odometry = np.array([0.14, 0.0, 0.0])
    before = sigmas_of(model, odometry)
    for _ in range(60):
        motion = model.predict(odometry, CALIBRATED)
        gain = motion.covariance[0, 0] / (motion.covariance[0, 0] + 1.0 / along)
        slid = odometry - [gain * 0.14, 0.0, 0.0]  # the scan alone measures no motion
        model.update(slid, information)
    assert (sigmas_of(model, odometry)[0] > 3.0 * before[0]) == is_open
