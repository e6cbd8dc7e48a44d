"""The localizer in a simulated room, and with invalid input."""

from copy import deepcopy
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.local_map_cells import wall_distances
from support.slam_room import BLIND, ROOM, drive, drive_round_the_block, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.slam.graph.loop_closure import LoopClosureConfig
from thinmap_ros.core.slam.joining.join import Atlas
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.matching.local_map import MIN_HIT_RATIO, LocalMapConfig
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import Destination
from thinmap_ros.sim.drives import DriveConfig
from thinmap_ros.sim.drives import drive as drive_along
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import RobotConfig
from thinmap_ros.sim.simulation import Simulation
from thinmap_ros.sim.world import World

START = np.array([2.0, 2.0, 0.0])
AT_START = {'initial_x_m': 2.0, 'initial_y_m': 2.0}
PERIOD_NS = 200_000_000
# A scan that is unlike any part of the room.
ELSEWHERE = np.array(
    [
        [0.0, 0.0, 3.0, 0.6],
        [3.0, 0.6, 4.5, 3.0],
        [4.5, 3.0, 2.0, 5.5],
        [2.0, 5.5, -1.0, 4.0],
        [-1.0, 4.0, 0.0, 0.0],
        [1.4, 3.4, 1.9, 3.8],
    ]
)


def at_start(**config):
    return Localizer(LocalizerConfig(**{**AT_START, **config}))


def driven(steps, seed=3, localizer=None, odometry=lambda odom: odom, **config):
    """True pose, estimate and odometry at each scan of a drive, and the localizer."""
    rng = np.random.default_rng(seed)
    localizer = localizer or at_start(**config)
    rows = []
    for i, (truth, odom) in enumerate(drive(steps, rng, START)):
        scan = scan_in(ROOM, truth, rng, i * PERIOD_NS)
        rows.append((truth, localizer.step(scan, odometry(odom)), odom))
    return rows, localizer


def errors_of(rows):
    return np.array([se2.between(truth, estimate.T_map_base) for truth, estimate, _ in rows])


def worst(rows):
    return float(np.hypot(*errors_of(rows)[:, :2].T).max())


def on(localizer, steps, truth, odom, rng, segments=ROOM, turn=0.1):
    """More rows, of a robot that turns and moves a little near its position."""
    rows = []
    for _ in range(steps):
        step = se2.pose(0.02, 0.0, turn)
        truth = se2.compose(truth, step)
        odom = se2.compose(odom, step)
        stamp = (localizer._tracker.prediction._increments.stamp_ns or 0) + PERIOD_NS
        rows.append((truth, localizer.step(scan_in(segments, truth, rng, stamp), odom), odom))
    return rows


@pytest.fixture(scope='module')
def whole_drive():
    return driven(900)


def test_a_drive_round_the_room_stays_on_its_path(whole_drive):
    rows, localizer = whole_drive
    off = errors_of(rows)
    assert np.sqrt(np.mean(off[:, 0] ** 2 + off[:, 1] ** 2)) < 0.05
    assert np.sqrt(np.mean(off[:, 2] ** 2)) < np.radians(0.7)
    assert worst(rows) < 0.1
    odometry = np.array([se2.between(truth, se2.compose(START, odom)) for truth, _, odom in rows])
    assert np.hypot(*odometry[-1, :2]) > 0.3
    assert not any(estimate.is_lost for _, estimate, _ in rows)
    assert localizer.rejected == 0


def test_the_whole_path_is_available_afterwards(whole_drive):
    rows, localizer = whole_drive
    path = localizer.optimized_trajectory()
    assert path.shape == (len(rows), 3)
    truths = np.array([truth for truth, *_ in rows])
    assert np.sqrt(np.mean(np.square((path - truths)[:, :2]).sum(axis=1))) < 0.06
    stamps, past = localizer.keyframe_trajectory()
    assert (np.diff(stamps) > 0).all()
    off = (past - truths[stamps // PERIOD_NS])[:, :2]
    assert np.hypot(*off.T).max() < 0.1
    # The robot returns to mapped places: far fewer keyframes than the path length would give.
    assert 10 < len(localizer.keyframes) < len(stamps)
    for frame in localizer.keyframes:
        assert np.hypot(*(truths[:, :2] - frame.T_map_base[:2]).T).min() < 0.1


def test_the_whole_path_is_within_4_cm(whole_drive):
    rows, localizer = whole_drive
    off = (localizer.optimized_trajectory() - np.array([truth for truth, *_ in rows]))[:, :2]
    assert np.sqrt(np.mean(np.square(off).sum(axis=1))) < 0.04


def test_a_pose_that_is_set_is_within_5_cm():
    rows, localizer = driven(300)
    truth, _, odom = rows[-1]
    localizer.set_pose(truth + [0.1, -0.1, 0.05], np.diag([0.04, 0.04, 0.01]))
    after = on(localizer, 10, truth, odom, np.random.default_rng(9))
    assert np.hypot(*errors_of(after)[-1][:2]) < 0.05


def test_drives_are_as_true_as_their_first_scans():
    """On average over drives with different noise."""
    rms = []
    for seed in range(6):
        rows, _ = driven(300, seed=seed)
        rms.append(np.sqrt(np.mean(np.square(errors_of(rows)[:, :2]).sum(axis=1))))
    assert np.mean(rms) < 0.04
    assert np.max(rms) < 0.06


def test_errors_are_within_the_covariance(whole_drive):
    rows, _ = whole_drive
    off = np.array([se2.pose_difference(estimate.T_map_base, truth) for truth, estimate, _ in rows])
    sigmas = np.sqrt(np.array([np.diag(estimate.covariance) for _, estimate, _ in rows]))
    within = np.abs(off) <= 3.0 * sigmas + 1e-12
    # After the first metre: the initial map is only as accurate as the first scans.
    assert within[40:].mean(axis=0).min() > 0.97
    assert (sigmas[40:, :2] < 0.5).all(), 'nor does it say that it could be anywhere'


def test_the_estimate_is_consistent(whole_drive):
    for _, estimate, odom in whole_drive[0]:
        np.testing.assert_allclose(
            se2.compose(estimate.T_map_odom, odom), estimate.T_map_base, atol=1e-9
        )
        np.testing.assert_array_equal(estimate.covariance, estimate.covariance.T)
        assert np.linalg.eigvalsh(estimate.covariance).min() >= -1e-12
        assert 0.0 <= estimate.inlier_ratio <= 1.0


def test_the_same_input_gives_the_same_output():
    first, second = (np.array([e.T_map_base for _, e, _ in driven(120)[0]]) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize('decimals', [12, 11])
def test_an_odometry_that_went_through_text_leads_to_the_same(decimals):
    exact, rounded = (
        np.array([e.T_map_base for _, e, _ in driven(300, odometry=odometry)[0]])
        for odometry in (lambda odom: odom, lambda odom: np.round(odom, decimals))
    )
    np.testing.assert_allclose(rounded, exact, atol=1e-9)


def test_a_robot_that_stands_learns_nothing_new():
    rng = np.random.default_rng(1)
    localizer = at_start()
    scans = [scan_in(ROOM, START, rng, k * PERIOD_NS) for k in range(60)]
    estimates = [localizer.step(scan, np.zeros(3)) for scan in scans]
    assert np.abs(np.array([e.T_map_base for e in estimates]) - START).max() < 0.02
    assert len(localizer.keyframes) == 1


@pytest.mark.parametrize('trembling', [0.0, 0.0005])
def test_standing_still_adds_no_uncertainty(trembling):
    rng = np.random.default_rng(3)
    rows, localizer = driven(120)
    truth, before, odom = rows[-1]
    scans = [scan_in(ROOM, truth, rng) for _ in range(20)]
    keyframes = len(localizer.keyframes)
    for k in range(1500):
        trembled = se2.compose(odom, rng.normal(0.0, trembling, 3))
        seen = scans[k % len(scans)]
        scan = replace(seen, stamp_ns=(120 + k) * PERIOD_NS)
        estimate = localizer.step(scan, trembled)
    grown = np.sqrt(np.diag(estimate.covariance)) - np.sqrt(np.diag(before.covariance))
    assert grown.max() < 2e-3
    assert np.abs(se2.between(truth, estimate.T_map_base)).max() < 0.04
    assert len(localizer.keyframes) <= keyframes + 1
    assert not estimate.is_lost


def straight(localizer, poses, rng, first=0):
    """Estimates at poses (N, 3), with exact odometry."""
    return [
        localizer.step(scan_in(ROOM, T, rng, (first + k) * PERIOD_NS), T - START)
        for k, T in enumerate(poses)
    ]


def test_a_robot_that_stands_is_as_sure_as_before():
    rng = np.random.default_rng(5)
    localizer = at_start()
    straight(localizer, [START + [0.05 * k, 0.0, 0.0] for k in range(21)], rng)
    stood = straight(localizer, 200 * [START + [1.0, 0.0, 0.0]], rng, 21)
    np.testing.assert_allclose(stood[-1].covariance, stood[0].covariance, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize('seed', range(10))
def test_driving_adds_uncertainty_whichever_scans_were_lost(seed):
    rng = np.random.default_rng(seed)
    losses = np.random.default_rng(1000 + seed)
    localizer = at_start()

    def sigmas(metres, count):
        """Errors (3,) after some scans at a pose ahead, half of which are dropped."""
        pose = START + [metres, 0.0, 0.0]
        for k in range(count):
            scan = scan_in(ROOM, pose, rng, k * PERIOD_NS)
            if k == 0 or losses.random() < 0.5:
                estimate = localizer.step(scan, pose - START)
        return np.sqrt(np.diag(estimate.covariance))

    for metres in np.arange(0.0, 1.0, 0.05):
        sigmas(metres, 2)
    standing = sigmas(1.0, 40)
    assert (sigmas(1.5, 8) > standing).any()


def test_a_robot_that_creeps_is_less_sure_of_its_position_with_every_metre():
    rng = np.random.default_rng(5)
    crept = straight(at_start(), [START + [0.02 * k, 0.0, 0.0] for k in range(101)], rng)
    sigmas = np.array([np.sqrt(np.diag(estimate.covariance)) for estimate in crept])
    assert (sigmas[50] > 0.002).all()
    assert (sigmas[100, :2] > sigmas[50, :2]).all()


def test_a_scan_with_coincident_points_is_not_matched():
    _, localizer = driven(60)
    before = localizer.pose
    scan = Scan.create(60 * PERIOD_NS, np.full(16, 2.0), 0.5, 1e-18, 0.05, 8.0)
    estimate = localizer.step(scan, np.zeros(3))
    assert np.isfinite(estimate.T_map_base).all()
    assert estimate.inlier_ratio == 0.0
    assert localizer.pose[:2] == pytest.approx(before[:2], abs=4.0)


def test_a_robot_that_is_pushed_while_its_wheels_stand_is_followed():
    rng = np.random.default_rng(3)
    rows, localizer = driven(120)
    truth, before, odom = rows[-1]
    for k in range(20):
        pushed = se2.compose(truth, se2.pose(0.015 * (k + 1), 0.0, 0.0))
        estimate = localizer.step(scan_in(ROOM, pushed, rng, (120 + k) * PERIOD_NS), odom)
    assert np.abs(se2.between(pushed, estimate.T_map_base)).max() < 0.05
    assert np.trace(estimate.covariance) > np.trace(before.covariance)


@pytest.mark.parametrize('odom', [[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [50.0, 0.0, 0.0]])
def test_nonsense_of_the_odometry_is_refused_and_counted(odom):
    rng = np.random.default_rng(2)
    rows, localizer = driven(60)
    truth, before, last = rows[-1]
    scan = scan_in(ROOM, truth, rng, 60 * PERIOD_NS)
    estimate = localizer.step(scan, np.array(odom))
    assert localizer.rejected == 1
    assert np.abs(se2.between(before.T_map_base, estimate.T_map_base)).max() < 0.04
    assert np.isfinite(estimate.covariance).all()
    assert np.isfinite(estimate.T_map_odom).all()
    if not np.isfinite(odom).all():
        later = localizer.step(scan_in(ROOM, truth, rng, 61 * PERIOD_NS), last)
        assert np.abs(se2.between(before.T_map_base, later.T_map_base)).max() < 0.04


def test_a_first_odometry_that_is_not_finite_is_refused():
    localizer = at_start()
    estimate = localizer.step(scan_in(ROOM, START), np.full(3, np.nan))
    assert localizer.rejected == 1
    np.testing.assert_allclose(estimate.T_map_base, START)
    assert np.isfinite(estimate.T_map_odom).all()


@pytest.mark.parametrize('value', [np.nan, np.inf, 0.0, -1.0, 1e9])
def test_a_scan_of_nothing_leaves_the_odometry(value):
    rows, localizer = driven(60)
    _, before, odom = rows[-1]
    blind = Scan.create(60 * PERIOD_NS, np.full(181, value), -1.57, 0.0175, 0.05, 8.0)
    ahead = se2.pose(0.1, 0.0, 0.05)
    estimate = localizer.step(blind, se2.compose(odom, ahead))
    moved = se2.between(before.T_map_base, estimate.T_map_base)
    np.testing.assert_allclose(moved, ahead, atol=0.06)
    assert np.trace(estimate.covariance) > np.trace(before.covariance)
    assert estimate.inlier_ratio == 0.0


def test_without_any_wall_the_odometry_is_followed():
    localizer = at_start()
    odom = np.zeros(3)
    for _ in range(40):
        odom = se2.compose(odom, se2.pose(0.1, 0.0, 0.02))
        estimate = localizer.step(BLIND, odom)
    # The first scan is at the initial pose.
    moved = se2.between(se2.pose(0.1, 0.0, 0.02), odom)
    np.testing.assert_allclose(estimate.T_map_base, se2.compose(START, moved), atol=1e-6)
    assert np.linalg.eigvalsh(estimate.covariance)[-1] > 1e-3


@pytest.mark.parametrize('seed', range(4))
def test_after_dead_reckoning_a_few_points_that_fit_badly_do_not_move_the_pose(seed):
    rng = np.random.default_rng(seed)
    rows, localizer = driven(60)
    odom = rows[-1][2]
    for k in range(200):
        odom = se2.compose(odom, se2.pose(0.05, 0.0, 0.03))
        predicted = localizer.step(replace(BLIND, stamp_ns=(60 + k) * PERIOD_NS), odom)
    assert localizer.config.matching.is_wide(localizer._tracker.uncertainty.since_match)
    scan = scan_in(ELSEWHERE, se2.pose(1.0, 1.5, 0.5), rng, 210 * PERIOD_NS)
    ranges = np.full(scan.ranges_m.size, np.inf)
    ranges[60:100] = scan.ranges_m[60:100]
    estimate = localizer.step(replace(scan, ranges_m=ranges), odom)
    assert 0.0 < estimate.inlier_ratio < localizer.config.matching.min_inlier_ratio
    np.testing.assert_allclose(estimate.T_map_base, predicted.T_map_base, atol=1e-3)


def test_wheel_slip_is_corrected_by_matching():
    """Occasional odometry discontinuities of 0.3 m or 10 degrees."""
    rng = np.random.default_rng(4)
    localizer = at_start()
    most = 0.0
    measured = np.zeros(3)
    last = np.zeros(3)
    for i, (truth, odom) in enumerate(drive(500, rng, START)):
        measured = se2.compose(measured, se2.between(last, odom))
        last = odom
        if i % 100 == 60:
            slip = [0.3, 0.0, 0.0] if i % 200 == 60 else [0.0, 0.0, np.radians(10.0)]
            measured = se2.compose(measured, np.array(slip))
        estimate = localizer.step(scan_in(ROOM, truth, rng, i * PERIOD_NS), measured)
        most = max(most, float(np.hypot(*(estimate.T_map_base - truth)[:2])))
    assert most < 0.1


@pytest.mark.parametrize('turn', [2.6, -2.2, np.pi])
def test_a_turn_that_the_odometry_has_not_seen_is_found_in_the_map(turn):
    """The robot is turned in place between two scans, and drives on."""
    rows, localizer = driven(300)
    truth, _, odom = rows[-1]
    turned = se2.compose(truth, np.array([0.0, 0.0, turn]))
    rows = on(localizer, 40, turned, odom, np.random.default_rng(8))
    assert not any(estimate.is_lost for _, estimate, _ in rows)
    assert worst(rows) < 0.1


def test_odometry_that_is_stuck_for_two_seconds_is_made_up_by_the_walls():
    def stuck(odom):
        last.append(odom)
        return last[200] if 200 < len(last) <= 210 else odom

    last = []
    rows, _ = driven(400, seed=6, odometry=stuck)
    assert worst(rows) < 0.1
    assert not any(estimate.is_lost for _, estimate, _ in rows)


def test_a_robot_that_turns_fast_is_not_lost():
    """A rotation of 23 degrees between two scans."""
    rng = np.random.default_rng(0)
    localizer = at_start()
    for k in range(40):
        turn = se2.pose(0.0, 0.0, 0.4 * k)
        truth = se2.compose(START, turn)
        estimate = localizer.step(scan_in(ROOM, truth, rng, k * PERIOD_NS), turn)
        assert not estimate.is_lost
        assert np.abs(se2.between(truth, estimate.T_map_base)).max() < 0.04


def test_behind_a_hall_without_returns_the_map_continues(rng):
    """Distant walls that come into range point by point do not contradict the map."""
    # Two rooms, each open towards the hall between them.
    hall = np.vstack([ROOM[[0, 2, 3]], np.delete(ROOM, 3, axis=0) + [18.0, 0.0, 18.0, 0.0]])
    localizer = at_start(initial_x_m=2.0, initial_y_m=7.0)
    odom = np.zeros(3)
    for k, x in enumerate(np.arange(2.0, 22.0, 0.1)):
        odom = odom + [0.1 * 1.004, rng.normal(0.0, 1e-4), rng.normal(0.0, 1e-4)]
        truth = np.array([x, 7.0, 0.0])
        estimate = localizer.step(scan_in(hall, truth, rng, k * PERIOD_NS, beams=46), odom)
    assert not estimate.is_lost
    assert estimate.inlier_ratio > 0.9
    assert abs(estimate.T_map_base - truth).max() < 0.3


HALL = np.zeros((242, 402), dtype=np.int8)  # 40 x 24 m, with a few pilasters
HALL[[0, -1]] = HALL[:, [0, -1]] = 100
HALL[:6, 60:66] = HALL[:6, 200:204] = HALL[-8:, 100:104] = 100
HALL[100:104, -9:] = HALL[150:153, :8] = 100
HALL[60:64, -12:] = 100


def along(*corners):
    """Points (K, 2), m, every 5 cm along straight lines between corners."""
    legs = [
        np.linspace(a, b, int(np.hypot(*np.subtract(b, a)) / 0.05) + 1)
        for a, b in pairwise(corners)
    ]
    return np.concatenate(legs)


@pytest.mark.xfail(strict=True, reason='no return of any beam for 20 m: 1.3 m off beyond the hall')
@pytest.mark.parametrize('seed', range(3))
def test_a_hall_that_is_wider_than_the_laser_sees_is_mapped_all_the_same(seed):
    """25 m with bends by odometry alone, then along the walls back to the start."""
    start = se2.pose(2.0, 2.0, np.pi / 2.0)
    world = World.from_patch('hall', GridPatch(GridFrame(-0.1, -0.1, 0.1), HALL), start)
    simulation = Simulation(world, start, RobotConfig(), LaserScannerConfig(), seed)
    across = along((2, 2), (2, 12), (9, 14), (16, 10), (23, 14), (30, 11), (36.5, 12))
    round_it = along((36.5, 12), (36.5, 20), (3, 21), (3, 3))
    back = along((3, 3), (2, 2.5), (2, 12))
    localizer = at_start(initial_yaw_rad=np.pi / 2.0)
    blind = 0
    lost = 0
    off = []
    turned = []
    for look in drive_along(simulation, [across, round_it, back], DriveConfig(0.5)):
        estimate = localizer.step(look.scan, look.T_odom_base)
        sees = np.count_nonzero(look.scan.hit) > 30
        blind += not sees
        lost += sees and estimate.is_lost
        error = se2.between(look.T_world_base, estimate.T_map_base)
        off.append(np.hypot(error[0], error[1]))
        turned.append(abs(error[2]) if sees else 0.0)
    assert blind > 200
    # At the far side of the hall its walls measure the heading.
    assert max(turned[len(turned) // 3 :]) < 0.03
    assert lost < 30, 'walls that are new are a map to hold on to'
    assert np.mean(off[-20:]) < 0.5 * max(off), 'what was known before puts it right'


def test_without_odometry_the_velocity_carries_on():
    """No odometry for the whole drive: a hand-held laser."""
    rows, _ = driven(400, odometry=np.zeros_like)
    assert not any(estimate.is_lost for _, estimate, _ in rows)
    # Until the odometry noise has adapted, the map starts at a wrong place.
    assert worst(rows) < 0.5
    steps = np.array(
        [
            se2.between(a[0], b[0]) - se2.between(a[1].T_map_base, b[1].T_map_base)
            for a, b in pairwise(rows[100:])
        ]
    )
    assert np.sqrt(np.mean(np.square(steps[:, :2]))) < 0.02


def legs_round(at, i):
    """Walls (N, 4) of three people who walk around a position."""
    legs = []
    for k in range(3):
        x, y = at + 1.5 * np.array([np.cos(0.05 * i + 2.0 * k), np.sin(0.05 * i + 2.0 * k)])
        legs += [[x - 0.15, y, x + 0.15, y], [x, y - 0.15, x, y + 0.15]]
    return np.array(legs)


def from_walls(points):
    """Distance of points (N, 2) from the nearest wall of the room."""
    start = ROOM[:, :2]
    along = ROOM[:, 2:] - ROOM[:, :2]
    off = points[:, None] - start
    u = np.clip((off * along).sum(axis=-1) / (along**2).sum(axis=-1), 0.0, 1.0)
    return np.linalg.norm(off - u[..., None] * along, axis=-1).min(axis=1)


def walls_in(localizer):
    """Centres (N, 2) of the wall cells in the localizer's state."""
    state = localizer.state()
    tile, row, col = np.nonzero(state['hits'] > MIN_HIT_RATIO * state['seen'].astype(float))
    size = state['hits'].shape[1]
    cells = state['tiles'][tile] * size + np.column_stack([row, col])
    return float(state['cell_m']) * (cells[:, ::-1] + 0.5)


def test_people_who_walk_through_do_not_become_walls():
    rng = np.random.default_rng(7)
    localizer = at_start()
    most = 0.0
    for i, (truth, odom) in enumerate(drive(500, rng, START)):
        segments = np.vstack([ROOM, legs_round(truth[:2], i)])
        estimate = localizer.step(scan_in(segments, truth, rng, i * PERIOD_NS), odom)
        most = max(most, float(np.hypot(*(estimate.T_map_base - truth)[:2])))
    assert most < 0.1
    assert not estimate.is_lost
    walls = walls_in(localizer)
    # Of some thousand hits on them, those that no later beam has traversed.
    assert np.mean(from_walls(walls) > 0.2) < 0.15


def test_kidnapping_starts_a_new_submap_and_reports_lost():
    rng = np.random.default_rng(8)
    rows, localizer = driven(300)
    before = len(localizer.keyframes)
    there = np.array([1.0, 2.0, 0.5])
    carried = on(localizer, 60, there, rows[-1][2], rng, ELSEWHERE)
    lost = [estimate.is_lost for _, estimate, _ in carried]
    assert not any(estimate.is_lost for _, estimate, _ in rows)
    assert any(lost[:45])
    assert lost[-1], 'where the new map lies is not known'
    assert carried[-1][1].inlier_ratio > 0.9, 'it fits the new map'
    assert carried[-1][1].covariance[0, 0] < 100.0, 'of dead reckoning: lost is the mode alone'
    assert len(localizer.keyframes) > before
    # In the new submap it continues normally.
    steps = [se2.between(a[0], b[0]) for a, b in pairwise(carried[-20:])]
    found = [se2.between(a[1].T_map_base, b[1].T_map_base) for a, b in pairwise(carried[-20:])]
    np.testing.assert_allclose(found, steps, atol=0.06)


def test_what_each_laser_saw_before_a_lift_is_not_compared_with_what_it_sees_after():
    rng = np.random.default_rng(8)
    localizer = at_start(map_tag='first')
    odom = np.zeros(3)

    def step(segments, T_world_base, number):
        for laser in range(2):
            scan = scan_in(segments, T_world_base, rng, number * PERIOD_NS + laser)
            localizer.step(replace(scan, frame=f'laser_{laser}'), odom)
            assert not localizer._tracker.belief.is_doubted

    for number, (truth, moved) in enumerate(drive(100, rng, START)):
        odom = moved
        step(ROOM, truth, number)
    localizer.enter_storey('second')
    for number in range(100, 105):
        step(ELSEWHERE, np.array([1.0, 2.0, 0.5]), number)
    assert localizer._loops.pieces.current == 1


def driven_elsewhere(localizer, start, odom_before=None):
    """Estimates of a drive that starts at another place (3,) than the localizer believes."""
    rng = np.random.default_rng(5)
    before = np.zeros(3) if odom_before is None else odom_before
    stamp_ns = localizer._tracker.prediction._increments.stamp_ns or 0
    for k, (truth, odom) in enumerate(drive(300, rng, np.array(start))):
        scan = scan_in(ROOM, truth, rng, stamp_ns + (k + 1) * PERIOD_NS)
        yield truth, localizer.step(scan, se2.compose(before, odom))


@pytest.mark.parametrize('start', [(8.5, 5.0, -2.0), (4.1, 7.0, 1.5), (5.5, 1.5, 3.0)])
def test_a_carried_robot_sees_through_walls_where_its_scans_fit_the_map_that_grows(start):
    rows, localizer = driven(300)
    carried = list(driven_elsewhere(localizer, start, rows[-1][2]))
    apart = [estimate.is_mapping_apart for _, estimate in carried]
    assert any(apart[:60])
    assert all(apart[60:])
    mapped = [row for row in carried if row[1].destination is Destination.MAP]
    assert not any(np.hypot(*(e.T_map_base - truth)[:2]) > 0.5 for truth, e in mapped)


def test_a_robot_that_stands_is_not_lost_by_one_view_through_walls():
    """Scans through walls from one place are one look, however many they are."""
    rows, localizer = driven(300)
    truth, _, odom = rows[-1]
    rng = np.random.default_rng(8)
    for k in range(300, 400):
        scan = scan_in(ROOM, np.array([8.5, 5.0, -2.0]), rng, k * PERIOD_NS)
        localizer.step(scan, odom)
    rows = on(localizer, 40, truth, odom, rng)
    assert not any(estimate.is_lost for _, estimate, _ in rows)
    assert worst(rows) < 0.1


def test_what_is_mapped_apart_is_not_saved_and_the_pose_of_a_user_leaves_it():
    rng = np.random.default_rng(8)
    rows, localizer = driven(300)
    truth, _, odom = rows[-1]
    carried = on(localizer, 60, np.array([1.0, 2.0, 0.5]), odom, rng, ELSEWHERE)
    assert carried[-1][1].is_mapping_apart
    saved = Localizer.from_state(localizer.state(), LocalizerConfig(**AT_START))
    assert not driven(20, localizer=saved)[0][-1][1].is_lost, 'the room, and no more'
    localizer.set_pose(truth, np.diag([0.01, 0.01, 0.01]))
    back = on(localizer, 10, truth, carried[-1][2], rng)
    assert not any(estimate.is_mapping_apart for _, estimate, _ in back)
    assert worst(back) < 0.1
    assert all(estimate.destination is Destination.MAP for _, estimate, _ in back[-5:])


def test_a_robot_that_was_lost_in_a_crowd_joins_its_map_again():
    rng = np.random.default_rng(2)
    localizer = at_start()
    apart = []
    for k, (truth, odom) in enumerate(drive(1400, rng, START)):
        segments = crowd(truth[:2], rng) if 300 <= k < 340 else ROOM
        estimate = localizer.step(scan_in(segments, truth, rng, k * PERIOD_NS), odom)
        apart.append(estimate.is_mapping_apart)
        if apart[-1] and not estimate.is_lost:
            pytest.fail('apart, and not lost')
    assert not any(apart[:300])
    assert any(apart[300:345])
    assert not apart[-1]
    assert np.hypot(*(estimate.T_map_base - truth)[:2]) < 0.1


def test_a_loaded_map_in_which_the_robot_is_elsewhere_stays_as_it_is(whole_drive):
    """No scan that fits by chance, later, places it: a pose has to be given."""
    _, first = whole_drive
    state = first.state()
    second = Localizer.from_state(state, LocalizerConfig(**AT_START))
    estimates = [estimate for _, estimate in driven_elsewhere(second, (4.1, 7.0, 1.5))]
    assert all(estimate.is_mapping_apart for estimate in estimates[60:])
    assert not any(estimate.destination is Destination.MAP for estimate in estimates)
    after = second.state()
    for name, array in state.items():
        np.testing.assert_array_equal(after[name], array)


@pytest.mark.parametrize('threshold', [1.0, 1000.0])
def test_other_parameters_apply_at_once_and_keep_the_map(threshold):
    rng = np.random.default_rng(8)
    rows, localizer = driven(100)
    frames = list(localizer.keyframes)
    state = {name: array.copy() for name, array in localizer.state().items()}
    matching = replace(localizer.config.matching, noise_m=0.06)
    localizer.adjust(LocalizerConfig(lost_threshold=threshold, matching=matching, initial_x_m=-5.0))
    assert localizer.config.initial_x_m == AT_START['initial_x_m'], 'for a reset'
    assert localizer.keyframes == frames
    for name, array in localizer.state().items():
        np.testing.assert_array_equal(array, state[name])
    carried = on(localizer, 30, np.array([1.0, 2.0, 0.5]), rows[-1][2], rng, ELSEWHERE)
    assert any(estimate.is_lost for _, estimate, _ in carried) == (threshold == 1.0)


def test_the_odds_of_a_join_may_change_while_a_map_is_kept(monkeypatch):
    asked = []
    monkeypatch.setattr(Atlas, 'step', lambda self, join_odds: asked.append(join_odds))
    localizer = Localizer(LocalizerConfig(loop_closure=LoopClosureConfig(join_odds=50.0)))
    localizer.adjust(LocalizerConfig(loop_closure=LoopClosureConfig(join_odds=2000.0)))
    scan, odometry, _ = next(iter(drive_round_the_block()))
    localizer.step(scan, odometry)
    assert asked == [2000.0]


def crowd(at, rng):
    """The room, and a crowd around a position that moves between scans."""
    angles = rng.uniform(-np.pi, np.pi, 30)
    outward = np.column_stack([np.cos(angles), np.sin(angles)])
    middles = at + rng.uniform(0.6, 1.6, 30)[:, None] * outward
    across = 0.2 * outward[:, ::-1] * [-1.0, 1.0]
    return np.vstack([ROOM, np.hstack([middles - across, middles + across])])


@pytest.mark.parametrize('seed', range(8))
def test_a_crowd_does_not_override_odometry(seed):
    """It is lost, and its new submap starts at the dead-reckoned pose."""
    rng = np.random.default_rng(seed)
    rows, localizer = driven(150, seed=seed)
    rows = on(localizer, 10, rows[-1][0], rows[-1][2], rng)
    truth, estimate, odom = rows[-1]
    before = estimate.T_map_base - truth
    for _ in range(40):
        segments = crowd(truth[:2], rng)
        (truth, estimate, odom), *_ = on(localizer, 1, truth, odom, rng, segments)
        if estimate.is_lost:
            break
    assert estimate.is_lost
    off = estimate.T_map_base - truth - before
    assert np.hypot(off[0], off[1]) < 0.05
    assert abs(se2.wrap(off[2])) < 0.02


def test_a_robot_that_is_brought_back_recovers_its_path():
    """Earlier keyframes do not move."""
    rng = np.random.default_rng(8)
    rows, localizer = driven(300)
    on(localizer, 60, np.array([1.0, 2.0, 0.5]), rows[-1][2], rng, ELSEWHERE)
    path = localizer.optimized_trajectory()
    truths = np.array([truth for truth, *_ in rows])
    assert np.hypot(*(path[:300] - truths)[:, :2].T).max() < 0.1


def test_a_pose_that_is_set_is_refined_by_matching():
    rng = np.random.default_rng(9)
    rows, localizer = driven(300)
    truth, _, odom = rows[-1]
    shifts = [(estimate.T_map_base - truth)[:2] for truth, estimate, _ in rows[-20:]]
    localizer.set_pose(truth + [0.1, -0.1, 0.05], np.diag([0.04, 0.04, 0.01]))
    after = on(localizer, 10, truth, odom, rng)
    last_truth, estimate, _ = after[-1]
    off = (estimate.T_map_base - last_truth)[:2] - np.mean(shifts, axis=0)
    assert np.hypot(*off) < 0.04, 'to where it was in its map'
    assert not after[-1][1].is_lost


@pytest.mark.parametrize(
    ('pose', 'covariance'),
    [
        ([np.nan, 0.0, 0.0], np.eye(3)),
        ([0.0, 0.0, np.inf], np.eye(3)),
        ([1e9, 0.0, 0.0], np.eye(3)),
        ([0.0, 0.0, 0.0], np.full((3, 3), np.nan)),
    ],
)
def test_a_pose_that_is_none_is_refused(pose, covariance):
    _, localizer = driven(20)
    before = localizer.pose
    localizer.set_pose(np.array(pose), covariance)
    assert localizer.rejected == 1
    np.testing.assert_array_equal(localizer.pose, before)


def test_after_set_pose_the_map_is_not_updated_until_a_scan_fits():
    rows, localizer = driven(300)
    localizer.set_pose(rows[-1][0] + [40.0, 0.0, 0.0], np.diag([4.0, 4.0, 0.1]))
    tiles = len(localizer.state()['tiles'])
    on(localizer, 20, rows[-1][0], rows[-1][2], np.random.default_rng(1))
    assert len(localizer.state()['tiles']) == tiles


def test_after_a_reset_everything_is_forgotten():
    rows, localizer = driven(200)
    localizer.reset()
    assert not localizer.keyframes
    assert localizer.optimized_trajectory().shape == (0, 3)
    estimate = localizer.step(scan_in(ROOM, START), rows[-1][2])
    np.testing.assert_allclose(estimate.T_map_base, START)


def test_a_map_is_taken_over_by_another_localizer(whole_drive):
    """In a saved map the robot is delocalized until scans fit, then it tracks."""
    _, first = whole_drive
    state = {name: array.copy() for name, array in first.state().items()}
    second = Localizer.from_state(state, LocalizerConfig(**AT_START))
    rows, _ = driven(200, seed=8, localizer=second)
    lost = [estimate.is_lost for _, estimate, _ in rows]
    assert lost[0]
    assert not any(lost[10:])
    assert worst(rows[10:]) < 0.08


@pytest.mark.parametrize('scans', [0, 1])
def test_a_pose_that_is_set_before_the_robot_moves_needs_no_drive_to_be_confirmed(scans):
    localizer = Localizer(LocalizerConfig())
    rng = np.random.default_rng(1)
    for k in range(8):
        if k == scans:
            localizer.set_pose(START, np.diag([0.25, 0.25, 0.07]))
        estimate = localizer.step(scan_in(ROOM, START, rng, k * PERIOD_NS), np.zeros(3))
    assert estimate.destination is Destination.MAP


def test_after_set_pose_in_a_loaded_map_localization_continues(whole_drive):
    _, first = whole_drive
    second = Localizer.from_state(first.state())
    rng = np.random.default_rng(8)
    elsewhere = np.array([8.0, 8.0, np.pi / 2.0])
    second.set_pose(elsewhere + [0.15, -0.1, 0.05], np.diag([0.04, 0.04, 0.01]))
    rows = []
    for k, (truth, odom) in enumerate(drive(300, rng, elsewhere)):
        estimate = second.step(scan_in(ROOM, truth, rng, k * PERIOD_NS), odom)
        rows.append((truth, estimate, odom))
    assert not any(estimate.is_lost for _, estimate, _ in rows[10:])
    assert worst(rows[10:]) < 0.1


def test_the_error_of_a_pose_that_was_set_is_not_taken_for_noise_of_the_odometry(whole_drive):
    rows, first = whole_drive
    localizer = deepcopy(first)
    truth, _, odom = rows[-1]
    on(localizer, 1, truth, odom, np.random.default_rng(1))
    before = localizer._tracker.prediction._model._share.copy()
    localizer.set_pose(truth + [0.3, -0.2, 0.1], np.diag([0.1, 0.1, 0.02]))
    after = on(localizer, 3, truth, odom, np.random.default_rng(1))
    assert np.hypot(*errors_of(after)[-1][:2]) < 0.06
    assert (localizer._tracker.prediction._model._share < 1.5 * before).all()


def test_a_robot_outside_of_a_loaded_map_stays_lost(whole_drive):
    _, first = whole_drive
    second = Localizer.from_state(first.state(), LocalizerConfig(**AT_START))
    hits = second.state()['hits'].copy()
    second.step(scan_in(ELSEWHERE, np.array([1.0, 2.0, 0.5])), np.zeros(3))
    rng = np.random.default_rng(1)
    rows = on(second, 20, np.array([1.0, 2.0, 0.5]), np.zeros(3), rng, ELSEWHERE, turn=0.3)
    assert all(estimate.is_lost for _, estimate, _ in rows)
    np.testing.assert_array_equal(second.state()['hits'], hits)
    # After set_pose with the true pose it is not lost.
    second.set_pose(START, np.diag([0.01, 0.01, 0.01]))
    rows = on(second, 10, START, rows[-1][2], rng)
    assert not rows[-1][1].is_lost
    assert np.hypot(*errors_of(rows)[-1][:2]) < 0.06


def test_without_mapping_the_map_stays_as_it_is(whole_drive):
    _, first = whole_drive
    state = {name: array.copy() for name, array in first.state().items()}
    second = Localizer.from_state(state, LocalizerConfig(**AT_START, mode='localization'))
    rows, _ = driven(300, seed=8, localizer=second)
    assert not rows[-1][1].is_lost
    assert worst(rows[10:]) < 0.08
    after = second.state()
    assert after.keys() == state.keys()
    for name, array in state.items():
        np.testing.assert_array_equal(after[name], array)
    assert not second.keyframes


@pytest.mark.parametrize('slip', [(0.0, 0.0), (0.3, 0.2)])
def test_a_killed_localizer_resumes_in_the_occupancy_map(slip):
    """Two metres without a localizer, while the wheels slip."""
    rng = np.random.default_rng(0)
    config = LocalizerConfig(**AT_START)
    localizer = Localizer(config)
    last = None
    rows = []
    grid = OccupancyGrid(OccupancyConfig(resolution_m=0.05))
    off = se2.pose(slip[0], 0.0, slip[1])
    for k, (truth, odom) in enumerate(drive(600, rng, START)):
        scan = scan_in(ROOM, truth, rng, k * PERIOD_NS)
        if k < 400:
            estimate = localizer.step(scan, odom)
            grid.add_scan(scan, estimate.T_map_base)
            last = OdometryAnchor(scan.stamp_ns, estimate.T_map_odom, odom)
        elif k >= 450:
            if k == 450:
                began = odom
                began_slipped = se2.compose(odom, off)
                localizer = Localizer.in_occupancy_map(grid.known_area(), config)
                localizer.resume(last, began_slipped)
            slipped = se2.compose(began_slipped, se2.between(began, odom))
            rows.append((truth, localizer.step(scan, slipped), odom))
    assert not rows[-1][1].is_lost
    assert worst(rows[10:]) < 0.1


@pytest.mark.parametrize(('guess', 'is_right'), [((2.0, 2.0, 0.0), True), ((4.1, 6.0, 1.6), False)])
def test_a_guessed_start_pose_is_confirmed_by_the_way_alone(guess, is_right):
    """A localizer begins in a map in which the robot may be anywhere."""
    rng = np.random.default_rng(0)
    grid = OccupancyGrid(OccupancyConfig(resolution_m=0.05))
    poses = list(drive(260, rng, START))
    scans = [scan_in(ROOM, T, rng, k * PERIOD_NS) for k, (T, _) in enumerate(poses)]
    for scan, (truth, _) in zip(scans, poses, strict=True):
        grid.add_scan(scan, truth)
    x, y, yaw = guess
    config = LocalizerConfig(initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw)
    localizer = Localizer.in_occupancy_map(grid.known_area(), config, is_guess=True)
    for k, (scan, (truth, odom)) in enumerate(zip(scans, poses, strict=True)):
        estimate = localizer.step(scan, odom)
        off_m = np.hypot(*(estimate.T_map_base - truth)[:2])
        assert estimate.is_lost or (off_m < 0.1 and k > 100)
        assert estimate.destination is not Destination.MAP or off_m < 0.1
    assert estimate.is_lost != is_right


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('cell_m', np.array(0.1)),
        ('tiles', np.zeros((3, 3), dtype=np.int64)),
        ('means', np.full((1, 64, 64, 2), np.nan, dtype=np.float32)),
        ('hits', None),
    ],
)
def test_a_state_that_is_none_is_refused_in_words(whole_drive, name, value):
    state = whole_drive[1].state()
    del state[name]
    if value is not None:
        state[name] = value
    with pytest.raises(InputError, match='expected'):
        Localizer.from_state(state)


def test_a_state_with_more_hits_than_observations_in_one_cell_is_refused(whole_drive):
    state = whole_drive[1].state()
    hits = state['hits'].copy()
    hits.flat[0] = state['seen'].flat[0] + 1
    with pytest.raises(InputError, match='hits: more than observations'):
        Localizer.from_state({**state, 'hits': hits})


def is_loop_found(localizer):
    """Whether the last keyframes are tied to the first ones round the block."""
    return any(edge.b - edge.a > 50 for edge in localizer._loops.graph.edges)


def test_a_loop_that_is_closed_while_the_robot_slides_into_the_old_map_is_closed_well():
    """At the start the pose slides onto the old walls before the loop is closed."""
    localizer = at_start(initial_x_m=3.0, initial_y_m=1.2)
    corrections = 0
    away = []
    for scan, odom, truth in drive_round_the_block():
        estimate = localizer.step(scan, odom)
        corrections += estimate.correction is not None
        away.append(np.hypot(*se2.between(truth, estimate.T_map_base)[:2]))
    assert corrections >= 1
    assert away[-1] < 0.5


@pytest.fixture(scope='module')
def round_the_block():
    """True pose, estimate and odometry at each scan, and the localizer."""
    localizer = at_start(initial_x_m=3.15, initial_y_m=1.2)  # pose of the first scan
    rows = []
    for scan, odom, truth in drive_round_the_block():
        rows.append((truth, localizer.step(scan, odom), odom))
    return rows, localizer


def test_a_loop_is_closed_while_the_robot_drives(round_the_block):
    """The map drifts round the block by systematic errors; the loop closure corrects it."""
    rows, localizer = round_the_block
    off = np.hypot(*errors_of(rows)[:, :2].T)
    closed = [k for k, (_, estimate, _) in enumerate(rows) if estimate.correction is not None]
    assert off[: closed[0]].max() > 0.3, 'without drift there is nothing to close'
    assert off[closed[-1] :].max() < 0.25
    path = localizer.optimized_trajectory()
    assert path.shape == (len(rows), 3)
    corrected = np.hypot(*(path - np.array([truth for truth, *_ in rows]))[:, :2].T)
    assert corrected.max() < 0.8 * off.max()
    assert corrected.mean() < 0.8 * off.mean()


def test_the_path_at_the_end_holds_the_loop_that_is_being_closed_and_the_pose_follows():
    localizer = at_start(initial_x_m=3.15, initial_y_m=1.2)
    for scan, odom, _ in drive_round_the_block():
        localizer.step(scan, odom)
        if is_loop_found(localizer) and localizer._loops.graph.is_moving:
            break
    before = localizer.pose
    path = localizer.optimized_trajectory()
    assert np.hypot(*(localizer.pose - before)[:2]) > 0.1, 'nothing was closed'
    np.testing.assert_allclose(path[-1], localizer.pose, atol=0.01)


def test_the_map_is_rendered_again_the_nearest_part_first(round_the_block):
    """As after a loop closure: the map near the robot is rendered at once, the rest later."""
    rows, localizer = round_the_block
    localizer = deepcopy(localizer)
    walls = walls_in(localizer)
    near = np.hypot(*(walls - localizer.pose[:2]).T) < 6.0

    def known():
        """Which of the former walls are rendered again."""
        return wall_distances(localizer._local.map, walls) < 0.1

    localizer.set_pose(localizer.pose, 1e-4 * np.eye(3))
    assert known()[near].mean() > 0.95
    assert known().mean() < 0.5
    for k in range(80):
        blind = replace(BLIND, stamp_ns=(len(rows) + k) * PERIOD_NS)
        localizer.step(blind, rows[-1][2])
    assert known().mean() > 0.98


def test_the_heading_is_held_along_corridors():
    """Drive until the loop round the block is closed."""
    localizer = at_start(initial_x_m=3.15, initial_y_m=1.2)
    off = []
    for scan, odom, truth in drive_round_the_block():
        estimate = localizer.step(scan, odom)
        if is_loop_found(localizer) and estimate.correction is not None:
            break
        off.append(se2.pose_difference(estimate.T_map_base, truth)[2])
    assert len(off) > 600
    assert np.sqrt(np.mean(np.square(off))) < 0.01


SMOOTH = np.array([[-1.0, -1.2, 60.0, -1.2], [60.0, 1.2, -1.0, 1.2], [-1.0, 1.2, -1.0, -1.2]])


@pytest.mark.parametrize('step_m', [0.01, 0.02, 0.04, 0.1, 0.2])
def test_along_a_smooth_corridor_odometry_decides(step_m):
    """Without information along the corridor, the pattern of the beams gives none, either."""
    rng = np.random.default_rng(0)
    localizer = Localizer()
    truth = np.zeros(3)
    odom = np.zeros(3)
    for k in range(round(10.0 / step_m)):
        truth = se2.compose(truth, se2.pose(step_m, 0.0, 0.0))
        odom = se2.compose(odom, se2.pose(1.01 * step_m, 0.0, 0.0))
        estimate = localizer.step(scan_in(SMOOTH, truth, rng, k * PERIOD_NS), odom)
    assert 8.0 < estimate.T_map_base[0] < 10.5
    assert abs(estimate.T_map_base[1]) < 0.1


def test_where_the_map_would_become_too_large_a_new_one_begins():
    rng = np.random.default_rng(8)
    localizer = at_start(local_map=LocalMapConfig(resolution_m=0.01))
    rows = on(localizer, 3, START, np.zeros(3), rng)
    truth, _, odom = rows[-1]
    for leap in range(1, 4):
        # As far as odometry can have come while only the scans were missing.
        odom = se2.compose(odom, np.array([240.0, 240.0, 0.0]))
        stamp = localizer._tracker.prediction._increments.stamp_ns + 1000 * PERIOD_NS
        scan = replace(scan_in(ROOM, truth, rng, stamp), odometry_silence_s=0.0)
        estimate = localizer.step(scan, odom)
        assert (localizer.rejected, estimate.is_lost) == ((0, False) if leap < 3 else (1, True))
    after = on(localizer, 10, truth, odom, rng)
    assert localizer.rejected == 1
    assert after[-1][1].inlier_ratio > 0.7, 'it fits the new map'
    steps = [se2.between(a[0], b[0]) for a, b in pairwise(after)]
    found = [se2.between(a[1].T_map_base, b[1].T_map_base) for a, b in pairwise(after)]
    np.testing.assert_allclose(found, steps, atol=0.06)
