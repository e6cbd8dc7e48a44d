"""What all steps have in common: the pose knows it, and what is learned later corrects the map."""

import numpy as np
import pytest
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.matching.scan_matcher import Match
from thinmap_ros.core.slam.odometry import OdometryCalibration, PoseUncertainty
from thinmap_ros.core.slam.track import LocalizerConfig

PERIOD_NS = 200_000_000
HALL_M = 24.0
LONGER = 1.02  # what the odometry measures as a metre
# A smooth hall that ends in the room, 0.5 m wider than a doorway.
HALL = np.array(
    [
        [-HALL_M, 6.4, 0.0, 6.4],
        [-HALL_M, 8.8, 0.0, 8.8],
        [0.0, 0.0, 10.0, 0.0],
        [10.0, 0.0, 10.0, 10.0],
        [10.0, 10.0, 0.0, 10.0],
        [0.0, 10.0, 0.0, 8.8],
        [0.0, 6.4, 0.0, 0.0],
        *ROOM[4:].tolist(),
    ]
)
START = se2.pose(4.0 - HALL_M, 7.6, 0.0)


def drive_into_the_room():
    """True poses: along the hall, then rounds in the upper half of the room."""
    T = START
    while T[0] < 2.0:
        yield T
        T = se2.compose(T, np.array([0.15, 0.0, 0.0]))
    for goal in [(8.5, 7.6), (8.5, 8.8), (2.0, 8.8), (2.0, 6.5), (8.5, 6.5)] * 2:
        while np.hypot(*(goal - T[:2])) > 0.2:
            off = goal - T[:2]
            turn = float(np.clip(se2.wrap(np.arctan2(off[1], off[0]) - T[2]), -0.3, 0.3))
            T = se2.compose(T, np.array([0.15 if abs(turn) < 0.1 else 0.0, 0.0, turn]))
            yield T


@pytest.fixture(scope='module')
def through_the_hall():
    """True pose and estimate at each scan, and the localizer."""
    rng = np.random.default_rng(2)
    x, y, yaw = START.tolist()
    localizer = Localizer(LocalizerConfig(initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw))
    rows = []
    odom = np.zeros(3)
    last = START
    for k, truth in enumerate(drive_into_the_room()):
        odom = se2.compose(odom, se2.between(last, truth) * [LONGER, LONGER, 1.0])
        rows.append((truth, localizer.step(scan_in(HALL, truth, rng, k * PERIOD_NS), odom)))
        last = truth
    return rows, localizer


def test_in_a_smooth_hall_the_pose_knows_how_far_the_wheels_may_be_wrong(through_the_hall):
    rows, _ = through_the_hall
    in_hall = [(truth, estimate) for truth, estimate in rows if truth[0] < -9.0]
    truth, estimate = in_hall[-1]
    off = estimate.T_map_base[0] - truth[0]
    assert off > 0.15, 'no scan measures the way'
    assert off < 2.0 * np.sqrt(estimate.covariance[0, 0])
    assert abs(estimate.T_map_base[1] - truth[1]) < 0.05
    assert np.sqrt(estimate.covariance[1, 1]) < 0.1


def test_what_the_room_teaches_of_the_wheels_corrects_the_hall(through_the_hall):
    rows, localizer = through_the_hall
    entered = next(k for k, (truth, _) in enumerate(rows) if truth[0] > -1.0)
    before = rows[entered][1].T_map_base[0] - rows[entered][0][0]
    assert any(estimate.correction is not None for _, estimate in rows)
    truth, estimate = rows[-1]
    assert abs(estimate.T_map_base[0] - truth[0]) < 0.5 * before
    path = localizer.optimized_trajectory()
    assert abs(path[entered, 0] - rows[entered][0][0]) < 0.5 * before


def test_a_turn_without_returns_is_as_uncertain_as_the_wheels_and_stays_so():
    """The map that follows is drawn at the dead-reckoned heading, and confirms it."""
    rng = np.random.default_rng(4)
    localizer = Localizer(LocalizerConfig(initial_x_m=3.0, initial_y_m=2.0))
    odom = np.zeros(3)
    truth = se2.pose(3.0, 2.0, 0.0)
    estimates = []
    for k in range(150):
        turn = 0.08 if k < 30 else 0.0
        way = 0.0 if k < 30 else 0.05 * (k < 40)
        truth = se2.compose(truth, np.array([way, 0.0, turn]))
        odom = se2.compose(odom, np.array([way, 0.0, 1.1 * turn]))
        scan = scan_in(ROOM, truth, rng, k * PERIOD_NS)
        if k < 30:
            scan = Scan.create(scan.stamp_ns, np.full(181, np.inf), -1.57, 0.0175, 0.05, 8.0)
        estimates.append(localizer.step(scan, odom))
    last = estimates[-1]
    off = float(se2.wrap(last.T_map_base[2] - truth[2]))
    assert 0.15 < off < 3.0 * np.sqrt(last.covariance[2, 2])


def moved(uncertainty, steps):
    """Covariance (3, 3) after steps of 0.1 m with a scale that is known to 2 %."""
    T = np.zeros(3)
    for _ in range(steps):
        before = T
        T = T + [0.1, 0.0, 0.0]
        by = np.zeros((3, 4))
        by[0, 0] = 0.1
        uncertainty.predict(before, T, 1e-8 * np.eye(3), False, by)
        uncertainty.coast(T, 1e-8 * np.eye(3), False)
    by = uncertainty.systematic
    return by @ np.diag([4e-4, 0.0, 0.0, 0.0]) @ by.T


def test_the_error_of_a_scale_grows_with_the_path_and_not_with_its_root():
    once = np.sqrt(moved(PoseUncertainty(np.zeros(3)), 50)[0, 0])
    assert once == pytest.approx(0.02 * 5.0)
    assert np.sqrt(moved(PoseUncertainty(np.zeros(3)), 200)[0, 0]) == pytest.approx(4.0 * once)


MEASURED = np.zeros((3, 4))


def learning(spans, scale=1.02):
    """A calibration that has measured spans of a metre by well-known poses."""
    calibration = OdometryCalibration()
    truth = np.zeros(3)
    for _ in range(10 * spans + 1):
        calibration.corrected(np.array([0.1, 0.0, 0.0]), np.full(2, 2.5e-7))
        truth = truth + [0.1 * scale, 0.0, 0.0]
        calibration.update(truth, 1e6 * np.eye(3), MEASURED)
    return calibration


def test_what_was_measured_early_follows_what_is_known_later():
    calibration = learning(40)
    smoothed = calibration.smoothed()
    assert smoothed.shape == (calibration.spans + 1, 4)
    np.testing.assert_allclose(smoothed[:, 0], 1.02, atol=0.004)
    np.testing.assert_array_equal(smoothed[-1], calibration.parameters)


def test_before_the_first_span_nothing_is_known_better():
    np.testing.assert_array_equal(OdometryCalibration().smoothed(), [[1.0, 0.0, 1.0, 0.0]])


def test_a_match_with_a_map_that_was_drawn_by_the_wheels_does_not_confirm_them():
    calibration = OdometryCalibration()
    known = calibration.covariance
    by = np.zeros((3, 4))
    pose = np.zeros(3)
    for _ in range(50):
        found, G = calibration.corrected(np.array([0.1, 0.0, 0.0]), np.full(2, 2.5e-7))
        lever = np.array([[0.0, 0.0, -found[1]], [0.0, 0.0, found[0]], [0.0, 0.0, 0.0]])
        by = by + lever @ by + G
        pose = pose + found
        calibration.update(pose, 1e6 * np.eye(3), by)
    np.testing.assert_allclose(calibration.parameters, [1.0, 0.0, 1.0, 0.0])
    assert (np.diag(calibration.covariance) >= np.diag(known)).all(), 'but for the random walk'


def test_a_calibration_with_large_innovations_is_as_uncertain_as_they_are():
    """An odometry that slips in single steps tells less of its wheels."""
    uncertain = []
    for slip in (0.0, 0.1):
        rng = np.random.default_rng(4)
        calibration = OdometryCalibration()
        truth = np.zeros(3)
        for _ in range(300):
            calibration.corrected(np.array([0.1, 0.0, 0.0]), np.full(2, 2.5e-7))
            truth = truth + [0.1 + slip * rng.choice([-0.5, 0.0, 0.5]), 0.0, 0.0]
            calibration.update(truth, 1e6 * np.eye(3), MEASURED)
        uncertain.append(calibration.covariance[0, 0])
        assert abs(calibration.parameters[0] - 1.0) < 3.0 * np.sqrt(uncertain[-1])
    assert uncertain[1] > 3.0 * uncertain[0]


def test_of_walls_in_view_a_match_takes_off_what_the_wheels_have_added():
    """What was drawn since they came into view, and not only since the last scan in the map."""
    uncertainty = PoseUncertainty(np.zeros(3))
    left = []
    for _ in range(20):
        moved(uncertainty, 2)
        uncertainty.map_updated(0.25)
        left.append(uncertainty.systematic[0, 0])
    match = Match(np.zeros(3), 1e-9 * np.eye(3), 1e9 * np.eye(3), 1.0, 0.0, 0.0, 1.0)
    uncertainty.update(match, np.zeros(3), 1e-4 * np.eye(3), True, False)
    after = uncertainty.systematic[0, 0]
    in_view = 0.2 * 0.75 / 0.25  # of the way since each update, a quarter goes into the map
    assert left[-1] - after == pytest.approx(in_view, rel=0.05)
