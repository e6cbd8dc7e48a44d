"""EKF-SLAM with the interface of a localizer: odometry and line features."""

import numpy as np
import pytest
from support.slam_room import ROOM, drive, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig, EkfLocalizer
from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.core.odometry import OdometryAnchor

PERIOD_NS = 200_000_000
START = se2.pose(2.0, 2.0, 0.0)


def at_start(slam='ekf_ti', **options):
    return EkfLocalizer(EkfConfig(slam=slam, initial_x_m=2.0, initial_y_m=2.0, **options))


def driven(localizer, steps):
    """Errors (N, 3) of a drive with systematic odometry errors, and the last estimate."""
    rng = np.random.default_rng(3)
    errors = []
    estimate = None
    for k, (truth, odom) in enumerate(drive(steps, rng, START)):
        scan = scan_in(ROOM, truth, rng, PERIOD_NS * k)
        estimate = localizer.step(scan, odom)
        errors.append(se2.between(truth, estimate.T_map_base))
    return np.array(errors), estimate


def lengths_of(localizer):
    return {f.id: np.hypot(*(f.end - f.start)) for f in localizer.features}


@pytest.mark.parametrize('slam', ['ekf_ti', 'ekf_full'])
def test_line_features_bound_the_error_of_systematic_odometry_drift(slam):
    errors, estimate = driven(at_start(slam), 600)
    off = np.hypot(*errors[:, :2].T)
    assert off.max() < 0.2
    assert np.abs(errors[:, 2]).max() < 0.1
    assert estimate.n_features > 5
    sigma = np.sqrt(np.trace(estimate.covariance[:2, :2]))
    assert off[-1] < 3.0 * sigma < 1.0


@pytest.mark.parametrize('slam', ['ekf_ti', 'ekf_full'])
@pytest.mark.parametrize('turn_rad', [0.2, 0.35])
def test_a_robot_that_turns_to_new_walls_keeps_its_heading(slam, turn_rad):
    """The wall that it has seen is out of view at once, and the odometry turns 12 % too far."""
    walls = np.array([[0.5, 3.0, 2.5, 3.0], [-2.5, -3.0, 0.0, -3.0], [-4.0, -2.0, -4.0, 2.0]])
    rng = np.random.default_rng(0)
    localizer = EkfLocalizer(EkfConfig(slam=slam))
    headings_rad = np.r_[np.zeros(6), -np.arange(0.0, np.pi, turn_rad)]
    ahead_m = 0.05 * np.minimum(np.arange(len(headings_rad)), 5)
    for k, (x, heading) in enumerate(zip(ahead_m, headings_rad, strict=True)):
        truth = se2.pose(x, 0.0, heading)
        scan = scan_in(walls, truth, rng, PERIOD_NS * k)
        estimate = localizer.step(scan, se2.pose(x, 0.0, 1.12 * heading))
    assert abs(se2.between(truth, estimate.T_map_base)[2]) < 0.02


def test_the_local_area_estimates_what_all_features_do():
    local, _ = driven(at_start('ekf_ti'), 300)
    full, _ = driven(at_start('ekf_full'), 300)
    assert np.abs(local - full)[:, :2].max() < 0.03


def test_a_robot_that_stands_grows_neither_surer_nor_less_sure():
    localizer = at_start()
    _, before = driven(localizer, 100)
    rng = np.random.default_rng(1)
    odom = localizer._odometry.T_odom_base
    for k in range(500):
        trembling = odom + rng.normal(0.0, 0.002, 3)
        scan = scan_in(ROOM, localizer.pose, rng, PERIOD_NS * (100 + k))
        estimate = localizer.step(scan, trembling)
    np.testing.assert_allclose(estimate.covariance, before.covariance, rtol=0.3)


def test_a_saved_state_is_resumed_in_another_session():
    localizer = at_start()
    driven(localizer, 600)
    state = localizer.state()
    second = EkfLocalizer.from_state(
        state, EkfConfig(slam='ekf_ti', initial_x_m=2.1, initial_y_m=1.9)
    )
    assert {f.id for f in second.features} == {f.id for f in localizer.features}
    errors, _ = driven(second, 100)
    assert np.hypot(*errors[-1, :2]) < 0.1
    with pytest.raises(InputError, match='expected'):
        EkfLocalizer.from_state({**state, 'lines': np.zeros((1, 3))})


def test_without_mapping_no_feature_comes_grows_or_goes():
    localizer = at_start()
    driven(localizer, 600)
    config = EkfConfig(slam='ekf_ti', initial_x_m=2.0, initial_y_m=2.0, mode='localization')
    second = EkfLocalizer.from_state(localizer.state(), config)
    before = lengths_of(second)
    errors, _ = driven(second, 100)
    assert lengths_of(second) == pytest.approx(before, abs=1e-9)
    assert np.hypot(*errors[-1, :2]) < 0.1
    alone = at_start(mode='localization')
    driven(alone, 100)
    assert alone.features == []


def test_it_resumes_at_the_odometry_pose_after_a_restart():
    last = OdometryAnchor(0, se2.pose(1.0, 2.0, 0.5), se2.pose(1.0, 0.0, 0.0))
    resumed = EkfLocalizer()
    resumed.resume(last, se2.pose(2.0, 0.0, 0.0))
    expected = se2.compose(last.T_map_odom, se2.pose(2.0, 0.0, 0.0))
    np.testing.assert_allclose(resumed.pose, expected)


def test_input_that_makes_no_sense_is_refused():
    localizer = at_start()
    driven(localizer, 50)
    pose = localizer.pose
    localizer.set_pose(np.array([np.nan, 0.0, 0.0]), np.eye(3))
    scan = scan_in(ROOM, pose, None, PERIOD_NS * 50)
    localizer.step(scan, np.array([np.inf, 0.0, 0.0]))
    localizer.step(scan, localizer._odometry.T_odom_base + [500.0, 0.0, 0.0])
    assert localizer.rejected == 3
    np.testing.assert_allclose(localizer.pose, pose, atol=0.3)
    with pytest.raises(ConfigError, match='ekf_full'):
        EkfConfig(slam='full')


def test_its_path_equals_its_estimates():
    localizer = at_start()
    errors, _ = driven(localizer, 50)
    assert localizer.optimized_trajectory().shape == errors.shape
    np.testing.assert_array_equal(localizer.optimized_trajectory()[-1], localizer.pose)
    stamps, poses = localizer.keyframe_trajectory()
    assert (stamps.shape, poses.shape) == ((0,), (0, 3))
