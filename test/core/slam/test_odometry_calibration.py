"""Systematic odometry errors are calibrated; single errors are ignored."""

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.slam.odometry import OdometryCalibration

# Odometry measures a metre as 1.04 m with 0.03 rad of rotation, and a radian as 1.05 rad. The laser
# is mounted 1.5 deg askew.
SCALE = 1.04
DRIFT = 0.03
TURN_SCALE = 1.05
ASKEW = 0.026
NOISE = np.full(2, 2.5e-7)  # variances of a step
MEASURED = np.zeros((3, 4))  # derivative of a pose that scans have measured
KNOWN = np.diag([1e6, 1e6, 1e6])  # information of a match at the end of a span


def driven(steps, seed=0, backwards=False):
    """True poses, and odometry increments with these errors and small noise."""
    rng = np.random.default_rng(seed)
    T = np.zeros(3)
    for k in range(steps):
        way = -0.1 if backwards else 0.1
        turn = 0.2 * np.sin(k / 7.0) * (k % 40 > 20)
        c = np.cos(ASKEW + 0.5 * turn)
        s = np.sin(ASKEW + 0.5 * turn)
        T = se2.compose(T, np.array([way * c, way * s, turn]))
        told_turn = TURN_SCALE * turn + DRIFT * way
        told = np.array([np.cos(0.5 * told_turn), np.sin(0.5 * told_turn)]) * SCALE * way
        yield T, np.append(told, told_turn) + rng.normal(0.0, [5e-4, 5e-4, 5e-4])


@pytest.mark.parametrize('backwards', [False, True])
def test_the_systematic_error_is_estimated_and_removed(backwards):
    calibration = OdometryCalibration()
    last = np.zeros(3)
    off = []
    for T, told in driven(600, backwards=backwards):
        found, _ = calibration.corrected(told, NOISE)
        calibration.update(T, KNOWN, MEASURED)
        off.append(se2.between(se2.between(last, T), found))
        last = T
    late = np.mean(off[300:], axis=0)
    np.testing.assert_allclose(late, 0.0, atol=5e-4)
    assert abs(np.mean(off[:10], axis=0)[0]) > 3e-3, 'it erred before'


def test_the_residual_covariance_shrinks_with_the_path():
    calibration = OdometryCalibration()
    left = []
    for T, told in driven(300):
        _, G = calibration.corrected(told, NOISE)
        left.append(G @ calibration.covariance @ G.T)
        calibration.update(T, KNOWN, MEASURED)
    assert np.trace(left[-1]) < 0.1 * np.trace(left[0])
    assert np.linalg.eigvalsh(left[-1]).min() > -1e-12


@pytest.mark.parametrize('increment', [(0.3, 0.1, 0.4), (0.2, -0.15, -0.8), (-0.4, 0.2, 0.3)])
def test_the_derivative_is_that_of_numeric_differences(increment):
    known = np.array([1.1, 0.05, 0.9, 0.2])

    def corrected(offset):
        calibration = OdometryCalibration()
        calibration.parameters = known + offset
        return calibration.corrected(np.array(increment), NOISE)

    step = 1e-6
    differences = [corrected(d)[0] - corrected(-d)[0] for d in step * np.eye(4)]
    J = np.array(differences).T / (2.0 * step)
    np.testing.assert_allclose(corrected(np.zeros(4))[1], J, rtol=1e-6, atol=1e-9)


def test_a_single_slip_does_not_change_the_calibration():
    calibration = OdometryCalibration()
    known = []
    for k, (T, told) in enumerate(driven(300)):
        calibration.corrected(told + [0.5, 0.0, 0.4] if k == 250 else told, NOISE)
        calibration.update(T, KNOWN, MEASURED)
        known.append(calibration.parameters)
    np.testing.assert_allclose(known[-1], known[249], atol=5e-3)


def test_across_an_interruption_nothing_is_compared():
    calibration = OdometryCalibration()
    known = calibration.parameters
    for k, (T, told) in enumerate(driven(100)):
        calibration.corrected(told, NOISE)
        calibration.update(T + [3.0 * k, 0.0, 0.0], KNOWN, MEASURED)
        calibration.reset_segment()
    np.testing.assert_array_equal(calibration.parameters, known)


def test_what_the_map_leaves_open_teaches_nothing():
    """Along a corridor the match equals the odometry prediction."""
    calibration = OdometryCalibration()
    for T, told in driven(300):
        calibration.corrected(told, NOISE)
        calibration.update(T + [0.2 * T[0], 0.0, 0.0], np.diag([0.0, 1e6, 1e6]), MEASURED)
    alone = OdometryCalibration()
    for T, told in driven(300):
        alone.corrected(told, NOISE)
        alone.update(T + [0.2 * T[0], 0.0, 0.0], KNOWN, MEASURED)
    assert abs(calibration.parameters[0] - 1.0) < 0.2 * abs(alone.parameters[0] - 1.0)
