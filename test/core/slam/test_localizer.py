"""The localizer in a simulated room, and what it does with input that is wrong."""

from copy import deepcopy

import numpy as np
import pytest
from slam_room import ROOM, drive, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.slam.localizer import Localizer, LocalizerConfig

START = np.array([2.0, 2.0, 0.0])
AT_START = {'start_x_m': 2.0, 'start_y_m': 2.0}


def driven(steps, seed=3, every=2, **config):
    """Truth, estimate and odometry at each scan of a drive, and the localizer."""
    rng = np.random.default_rng(seed)
    localizer = Localizer(LocalizerConfig(**{**AT_START, **config}))
    rows = []
    for i, (truth, odom) in enumerate(drive(steps, rng, START)):
        if i % every == 0:
            rows.append(
                (truth, localizer.step(scan_in(ROOM, truth, rng, i * 200_000_000), odom), odom)
            )
    return rows, localizer


def errors_of(rows):
    return np.array([se2.between(truth, estimate.T_map_base) for truth, estimate, _ in rows])


@pytest.mark.parametrize('slam', ['ti', 'full', 'off'])
def test_a_drive_round_the_room_stays_on_its_path(slam):
    rows, localizer = driven(900, slam=slam)
    off = errors_of(rows)
    assert np.sqrt(np.mean(off[:, 0] ** 2 + off[:, 1] ** 2)) < 0.03
    assert np.sqrt(np.mean(off[:, 2] ** 2)) < np.radians(0.5)
    odometry = np.array([se2.between(truth, se2.compose(START, odom)) for truth, _, odom in rows])
    assert np.hypot(*odometry[-1, :2]) > 0.3
    assert not any(estimate.lost for _, estimate, _ in rows)
    assert localizer.refused == 0
    assert (len(localizer.features) > 5) == (slam != 'off')


def test_local_areas_cost_no_accuracy():
    """The path with the features of the local area, and with all."""
    local, whole = driven(900, slam='ti')[0], driven(900, slam='full')[0]
    apart = np.array(
        [a.T_map_base - b.T_map_base for (_, a, _), (_, b, _) in zip(local, whole, strict=True)]
    )
    assert np.sqrt(np.mean(apart[:, 0] ** 2 + apart[:, 1] ** 2)) < 0.005
    assert all(estimate.n_local <= estimate.n_features for _, estimate, _ in local)
    assert all(estimate.n_local == estimate.n_features for _, estimate, _ in whole)


def test_the_estimate_is_told_in_a_consistent_way():
    rows, _ = driven(200)
    for _, estimate, odom in rows:
        np.testing.assert_allclose(
            se2.compose(estimate.T_map_odom, odom), estimate.T_map_base, atol=1e-9
        )
        np.testing.assert_allclose(estimate.covariance, estimate.covariance.T)
        assert np.linalg.eigvalsh(estimate.covariance).min() > 0.0
        assert estimate.matched <= estimate.observed
        assert 0.0 <= estimate.match_quality <= 1.0


def test_the_same_input_gives_the_same_output():
    first, second = (np.array([e.T_map_base for _, e, _ in driven(120)[0]]) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_robot_that_stands_still_learns_nothing():
    rng = np.random.default_rng(1)
    localizer = Localizer(LocalizerConfig(**AT_START))
    estimates = [localizer.step(scan_in(ROOM, START, rng), np.zeros(3)) for _ in range(60)]
    assert estimates[0].observed > 0
    assert all(e.observed == 0 for e in estimates[1:])
    poses = np.array([e.T_map_base for e in estimates])
    assert np.abs(poses - START).max() < 0.02
    assert not localizer.features


@pytest.mark.parametrize('trembling', [0.0, 0.0005])
def test_standing_still_adds_no_uncertainty(trembling):
    """After 600 s at 5 Hz it had grown to 0.10 m and 0.06 rad, with an error of less than 2 mm."""
    rng = np.random.default_rng(3)
    rows, localizer = driven(120)
    truth, before, odom = rows[-1]
    scans = [scan_in(ROOM, truth, rng) for _ in range(20)]
    for k in range(3000):
        trembled = se2.compose(odom, rng.normal(0.0, trembling, 3))
        estimate = localizer.step(scans[k % len(scans)], trembled)
    grown = np.sqrt(np.diag(estimate.covariance)) - np.sqrt(np.diag(before.covariance))
    assert grown.max() < (1e-6 if trembling == 0.0 else 2e-3)
    assert np.abs(se2.between(truth, estimate.T_map_base)).max() < 0.03
    # It is not surer of where it stands either: going on, it is as it was.
    assert np.diag(localizer._doubt.on_map).min() > 0.0
    gone = localizer.step(scan_in(ROOM, truth, rng), se2.compose(odom, se2.pose(0.5, 0.0, 0.0)))
    assert np.trace(gone.covariance) > np.trace(estimate.covariance)


def test_a_robot_that_is_pushed_while_its_wheels_stand_is_followed():
    rng = np.random.default_rng(3)
    rows, localizer = driven(120)
    truth, before, odom = rows[-1]
    for k in range(20):
        pushed = se2.compose(truth, se2.pose(0.015 * (k + 1), 0.0, 0.0))
        estimate = localizer.step(scan_in(ROOM, pushed, rng), odom)
    assert np.abs(se2.between(pushed, estimate.T_map_base)).max() < 0.03
    assert np.trace(estimate.covariance) > np.trace(before.covariance)


@pytest.mark.parametrize('odom', [[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [50.0, 0.0, 0.0]])
def test_nonsense_of_the_odometry_is_refused_and_counted(odom):
    rng = np.random.default_rng(2)
    rows, localizer = driven(60)
    truth, before, last = rows[-1]
    estimate = localizer.step(scan_in(ROOM, truth, rng), np.array(odom))
    assert localizer.refused == 1
    assert np.abs(se2.between(before.T_map_base, estimate.T_map_base)).max() < 0.02
    assert np.isfinite(estimate.covariance).all()
    if not np.isfinite(odom).all():
        later = localizer.step(scan_in(ROOM, truth, rng), last)
        assert np.abs(se2.between(before.T_map_base, later.T_map_base)).max() < 0.02


@pytest.mark.parametrize('value', [np.nan, np.inf, 0.0, -1.0, 1e9])
def test_a_scan_of_nothing_leaves_the_odometry(value):
    rows, localizer = driven(60)
    _, before, odom = rows[-1]
    blind = Scan.create(0, np.full(181, value), -1.57, 0.0175, 0.05, 8.0)
    ahead = se2.pose(0.3, 0.0, 0.1)
    expected, _ = deepcopy(localizer._calibration).corrected(ahead, np.zeros(2))
    estimate = localizer.step(blind, se2.compose(odom, ahead))
    # What the odometry says, less what it was found to err by all the time.
    moved = se2.between(before.T_map_base, estimate.T_map_base)
    np.testing.assert_allclose(moved, expected, atol=1e-9)
    np.testing.assert_allclose(moved, ahead, atol=0.02)
    assert np.trace(estimate.covariance) > np.trace(before.covariance)


def test_a_laser_whose_place_is_not_known_is_refused():
    localizer = Localizer(LocalizerConfig(**AT_START))
    scan = scan_in(ROOM, START)
    lost = Scan(0, scan.ranges_m, -1.57, 0.0175, 0.05, 8.0, np.array([np.nan, 0.0, 0.0]))
    np.testing.assert_allclose(localizer.step(lost, np.zeros(3)).T_map_base, START)
    assert localizer.refused == 1


def test_wheels_that_slip_are_caught_by_the_walls():
    """Jumps of 0.3 m or 10 degrees in the odometry, now and then."""
    rng = np.random.default_rng(4)
    localizer, worst = Localizer(LocalizerConfig(**AT_START)), 0.0
    measured, last = np.zeros(3), np.zeros(3)
    for i, (truth, odom) in enumerate(drive(700, rng, START)):
        measured, last = se2.compose(measured, se2.between(last, odom)), odom
        if i % 100 == 60:
            slip = (
                se2.pose(0.3, 0.0, 0.0) if i % 200 == 60 else se2.pose(0.0, 0.0, np.radians(10.0))
            )
            measured = se2.compose(measured, slip)
        estimate = localizer.step(scan_in(ROOM, truth, rng), measured)
        worst = max(worst, float(np.hypot(*(estimate.T_map_base - truth)[:2])))
    assert worst < 0.1


def test_stuck_odometry_for_two_seconds_is_made_up_by_the_walls():
    rng = np.random.default_rng(6)
    localizer, stuck, worst = Localizer(LocalizerConfig(**AT_START)), np.zeros(3), 0.0
    for i, (truth, odom) in enumerate(drive(400, rng, START)):
        if not 200 <= i < 210:
            stuck = odom
        estimate = localizer.step(scan_in(ROOM, truth, rng), stuck)
        worst = max(worst, float(np.hypot(*(estimate.T_map_base - truth)[:2])))
    assert worst < 0.1


def test_people_walking_through_do_not_carry_the_robot_along():
    rng = np.random.default_rng(7)
    localizer, worst = Localizer(LocalizerConfig(**AT_START)), 0.0
    for i, (truth, odom) in enumerate(drive(500, rng, START)):
        legs = []
        for k in range(3):
            at = truth[:2] + [1.5 * np.cos(0.05 * i + 2.0 * k), 1.5 * np.sin(0.05 * i + 2.0 * k)]
            legs += [
                [at[0] - 0.15, at[1], at[0] + 0.15, at[1]],
                [at[0], at[1] - 0.15, at[0], at[1] + 0.15],
            ]
        estimate = localizer.step(scan_in(np.vstack([ROOM, legs]), truth, rng), odom)
        worst = max(worst, float(np.hypot(*(estimate.T_map_base - truth)[:2])))
    assert worst < 0.1


def test_a_robot_carried_away_says_that_it_is_lost():
    """Set down where nothing fits: scans no longer lie on the map, and the estimate admits it."""
    rng = np.random.default_rng(8)
    rows, localizer = driven(300)
    _, _, odom = rows[-1]
    scans = [
        Scan.create(0, rng.uniform(0.5, 4.0, 181), -1.57, 0.0175, 0.05, 8.0) for _ in range(12)
    ]
    estimates = [localizer.step(scan, odom) for scan in scans]
    assert estimates[-1].lost
    assert not estimates[0].lost


def test_far_from_the_start_a_robot_is_not_lost():
    """In a large building the pose in the map is in doubt by metres; the scans fit all the same."""
    rng = np.random.default_rng(10)
    rows, localizer = driven(120)
    truth, _, odom = rows[-1]
    localizer._ekf.set_pose(localizer._ekf.pose, np.diag([4.0, 4.0, 0.001]))
    estimate = localizer.step(scan_in(ROOM, truth, rng), odom)
    assert estimate.covariance[0, 0] > 1.0
    assert not estimate.lost


def test_beyond_a_hall_in_which_nothing_is_seen_the_map_goes_on(rng):
    """Walls that come into range far off, some points at a time, are new: no reason to be lost."""
    # Two rooms, each open towards the hall between them.
    hall = np.vstack([ROOM[[0, 2, 3]], np.delete(ROOM, 3, axis=0) + [18.0, 0.0, 18.0, 0.0]])
    localizer, odom = Localizer(LocalizerConfig(start_x_m=2.0, start_y_m=7.0)), np.zeros(3)
    for x in np.arange(2.0, 22.0, 0.1):
        odom = odom + [0.1 * 1.004, rng.normal(0.0, 1e-4), rng.normal(0.0, 1e-4)]
        truth = np.array([x, 7.0, 0.0])
        estimate = localizer.step(scan_in(hall, truth, rng, beams=46), odom)
    assert not estimate.lost
    assert estimate.match_quality > 0.9
    assert abs(estimate.T_map_base - truth).max() < 0.3


def test_a_pose_that_is_set_is_settled_by_the_walls():
    rng = np.random.default_rng(9)
    rows, localizer = driven(300)
    truth, _, odom = rows[-1]
    localizer.set_pose(truth + [0.1, -0.1, 0.05], np.diag([0.04, 0.04, 0.01]))
    estimate = localizer.step(scan_in(ROOM, truth, rng), odom)
    assert np.hypot(*(estimate.T_map_base - truth)[:2]) < 0.03
    localizer.set_pose(np.array([np.nan, 0.0, 0.0]), np.eye(3))
    assert localizer.refused == 1


def test_a_robot_that_was_put_somewhere_roughly_draws_nothing_until_a_scan_fits():
    """Where nothing is known nothing contradicts it; somebody's guess is no reason to map there."""
    rows, localizer = driven(300)
    before = len(localizer.state()['cells'])
    localizer.set_pose(rows[-1][0] + [40.0, 0.0, 0.0], np.diag([4.0, 4.0, 0.1]))
    rng, odom = np.random.default_rng(1), rows[-1][2]
    for i in range(20):
        odom = se2.compose(odom, np.array([0.1, 0.0, 0.05]))
        localizer.step(scan_in(ROOM, rows[-1][0], rng, (600 + i) * 200_000_000), odom)
    assert len(localizer.state()['cells']) == before


def test_after_a_reset_the_map_is_empty():
    rows, localizer = driven(200)
    localizer.reset()
    assert not localizer.features
    estimate = localizer.step(scan_in(ROOM, START), rows[-1][2])
    np.testing.assert_allclose(estimate.T_map_base, START)


def test_a_map_is_taken_over_by_another_localizer():
    """A saved map: put elsewhere in the room, the robot goes on in it; features keep their ids."""
    _, first = driven(900)
    state = first.state()
    before = {f.id: (f.r_m, f.alpha_rad, f.nodes) for f in first.features}
    second = Localizer.from_state(state, LocalizerConfig())
    assert {f.id: (f.r_m, f.alpha_rad, f.nodes) for f in second.features} == before
    np.testing.assert_array_equal(
        np.array([f.covariance for f in second.features]),
        np.array([f.covariance for f in first.features]),
    )
    rng = np.random.default_rng(8)
    elsewhere = np.array([8.0, 8.0, np.pi / 2.0])
    second.set_pose(elsewhere + [0.15, -0.1, 0.05], np.diag([0.04, 0.04, 0.01]))
    matched = 0
    for i, (truth, odom) in enumerate(drive(300, rng, elsewhere)):
        estimate = second.step(scan_in(ROOM, truth, rng, i * 200_000_000), odom)
        matched += estimate.matched
    assert not estimate.lost
    off = se2.between(truth, estimate.T_map_base)
    assert np.hypot(off[0], off[1]) < 0.05
    assert sum(f.id in before for f in second.features) > 0.7 * len(before)
    assert matched > 100


def test_a_robot_with_a_given_map_is_lost_until_it_is_put_where_it_is():
    _, first = driven(400)
    second = Localizer.from_state(first.state(), LocalizerConfig(start_x_m=8.0, start_y_m=1.0))
    points = second.state()['points']
    rng, here = np.random.default_rng(8), np.array([2.5, 2.0, 0.3])
    scans = [scan_in(ROOM, here, rng, i * 200_000_000) for i in range(12)]
    assert all(second.step(scan, np.zeros(3)).lost for scan in scans[:6])
    np.testing.assert_array_equal(second.state()['points'], points)
    second.set_pose(here, 0.01 * np.eye(3))
    estimates = [second.step(scan, np.zeros(3)) for scan in scans[6:]]
    assert not any(estimate.lost for estimate in estimates)
    assert np.hypot(*(estimates[-1].T_map_base - here)[:2]) < 0.03


def test_without_mapping_the_map_stays_as_it_is():
    _, first = driven(900)
    state = first.state()
    second = Localizer.from_state(state, LocalizerConfig(**AT_START, mapping=False))
    rng = np.random.default_rng(8)
    for i, (truth, odom) in enumerate(drive(300, rng, START)):
        estimate = second.step(scan_in(ROOM, truth, rng, i * 200_000_000), odom)
    assert not estimate.lost
    assert np.hypot(*(estimate.T_map_base - truth)[:2]) < 0.05
    after = second.state()
    for name in ('cells', 'ids', 'lines', 'line_covariance', 'spans'):
        np.testing.assert_array_equal(after[name], state[name])
    assert not second.keyframes


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('cell_m', np.array(0.1)),
        ('cells', np.zeros((3, 2), dtype=np.int64)),
        ('points', np.full((1, 10), np.nan)),
        ('lines', np.zeros((1, 3))),
        ('line_covariance', np.eye(3)),
        ('next_id', np.array(1)),
        ('stored_at', np.array([[1, 10_000]])),
        ('spans', None),
    ],
)
def test_a_state_that_is_none_is_refused_in_words(name, value):
    _, localizer = driven(300)
    state = localizer.state()
    del state[name]
    if value is not None:
        state[name] = value
    with pytest.raises(InputError, match=r'^saved .*expected'):
        Localizer.from_state(state)
