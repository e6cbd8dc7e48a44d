"""Pose graphs and loops: drift is spread over the path, and a wrong loop moves nothing."""

from copy import deepcopy
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares
from slam_room import ROOM, drive, drive_round_the_block, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.slam.localizer import Localizer, LocalizerConfig
from thinmap_ros.core.slam.loops import LoopConfig, Loops
from thinmap_ros.core.slam.pose_graph import Measured, relax
from thinmap_ros.core.slam.scan_matching import MatchConfig
from thinmap_ros.sim.lms200 import Lms200Config
from thinmap_ros.sim.pioneer import PioneerConfig
from thinmap_ros.sim.runner import Simulation
from thinmap_ros.sim.tours import drive as drive_along
from thinmap_ros.sim.world import World

STEP = np.diag(1.0 / np.square([0.05, 0.05, 0.02]))
START = np.array([2.0, 2.0, 0.0])


def ring(rng, number=40):
    """True poses round a circle, drifting estimates, and what was measured from one to the next."""
    angles = np.linspace(0.0, 2.0 * np.pi, number, endpoint=False)
    truth = np.column_stack(
        [5.0 * np.cos(angles), 5.0 * np.sin(angles), se2.wrap(angles + np.pi / 2.0)]
    )
    steps = [se2.between(a, b) + rng.normal(0.003, 0.004, 3) for a, b in pairwise(truth)]
    poses = [truth[0]]
    for step in steps:
        poses.append(se2.compose(poses[-1], step))
    measured = [Measured(i, i + 1, step, STEP, False) for i, step in enumerate(steps)]
    return truth, np.array(poses), measured


def worst(poses, truth):
    return float(np.hypot(*(poses - truth)[:, :2].T).max())


def test_a_closed_loop_spreads_the_drift(rng):
    truth, poses, measured = ring(rng)
    loop = Measured(len(truth) - 1, 0, se2.between(truth[-1], truth[0]), 100.0 * STEP, True)
    relaxed = relax(poses, [*measured, loop])
    assert worst(poses, truth) > 0.4
    assert worst(relaxed, truth) < 0.5 * worst(poses, truth)
    assert np.hypot(*(relaxed[-1] - truth[-1])[:2]) < 0.1
    np.testing.assert_array_equal(relaxed[0], poses[0])


def test_the_minimum_is_that_of_a_general_solver(rng):
    truth, poses, measured = ring(rng, 12)
    measured.append(Measured(11, 0, se2.between(truth[-1], truth[0]), STEP, False))
    roots = [np.linalg.cholesky(m.information).T for m in measured]

    def residuals(x):
        p = np.vstack([poses[0], x.reshape(-1, 3)])
        off = [se2.between(p[m.a], p[m.b]) - m.T_a_b for m in measured]
        off = [np.array([e[0], e[1], se2.wrap(float(e[2]))]) for e in off]
        return np.concatenate([root @ e for root, e in zip(roots, off, strict=True)])

    best = least_squares(residuals, poses[1:].ravel(), xtol=1e-14, ftol=1e-14).x.reshape(-1, 3)
    np.testing.assert_allclose(relax(poses, measured)[1:], best, atol=1e-4)


def test_a_wrong_loop_among_right_ones_moves_little(rng):
    truth, poses, measured = ring(rng)
    right = [
        Measured(39 - i, i, se2.between(truth[39 - i], truth[i]), 100.0 * STEP, True)
        for i in range(3)
    ]
    wrong = Measured(5, 25, np.zeros(3), 100.0 * STEP, True)
    with_wrong = relax(poses, [*measured, *right, wrong])
    without = relax(poses, [*measured, *right])
    assert worst(with_wrong, without) < 0.1


def test_without_measurements_nothing_moves():
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 3.0]])
    np.testing.assert_array_equal(relax(poses, []), poses)
    np.testing.assert_array_equal(relax(poses[:1], []), poses[:1])


def loops_in_a_room(drift, steps=1300):
    """Loops along a drive, true poses of keyframes; drift (3,): what given poses err a metre."""
    rng = np.random.default_rng(2)
    loops, truths, drifting, last = Loops(LoopConfig(), MatchConfig()), [], START, START
    for k, (truth, _) in enumerate(drive(steps, rng, START)):
        step = se2.between(last, truth)
        ahead = float(np.hypot(step[0], step[1]))
        drifting, last = se2.compose(drifting, step + ahead * drift), truth
        scan = scan_in(ROOM, truth, rng, k)
        loops.follow(
            scan, np.ascontiguousarray(scan.points_base()), drifting, np.zeros(3), news=False
        )
        loops.work_off()
        truths.append(truth)
    return loops, np.array([truths[frame.scan.stamp_ns] for frame in loops.keyframes])


def test_loops_in_a_room_straighten_a_path_that_drifts():
    """Poses drift by 1 cm and 0.3 degrees a metre: matches with earlier visits correct them."""
    loops, truths = loops_in_a_room(np.array([0.01, 0.003, 0.005]))
    before = np.array([k.T_map_base for k in loops.keyframes])
    after = loops.relaxed()
    assert len(loops.matched) > 10
    assert worst(before, truths) > 0.3
    assert worst(after[: len(truths)], truths) < 0.5 * worst(before, truths)


def test_where_the_map_agrees_it_stays_as_it_is():
    """Where old and new agree earlier scans stand for new ones; else all are kept and matched."""
    (once, _), (again, _) = (loops_in_a_room(np.zeros(3), steps) for steps in (1300, 5200))
    assert len(again.keyframes) < 1.3 * len(once.keyframes)
    assert len(again.matched) < 4 * len(again.keyframes)
    stamps, poses = again.past()
    assert len(stamps) == len(poses) > 3 * len(once.past()[0])
    drifting, _ = loops_in_a_room(np.array([0.01, 0.003, 0.005]), 2600)
    assert len(drifting.keyframes) > 1.3 * len(again.keyframes)
    assert np.bincount([m.b for m in drifting.matched]).max() > 1


@pytest.fixture(scope='module')
def round_trip():
    rng = np.random.default_rng(3)
    localizer = Localizer(LocalizerConfig(start_x_m=2.0, start_y_m=2.0))
    rows = [(t, localizer.step(scan_in(ROOM, t, rng), odom)) for t, odom in drive(900, rng, START)]
    return np.array([t for t, _ in rows]), np.array([e.T_map_base for _, e in rows]), localizer


def test_the_corrected_path_has_every_step_and_is_no_worse(round_trip):
    truth, live, localizer = round_trip
    final = localizer.corrected_path()
    assert final.shape == live.shape
    off = [np.sqrt(np.mean(np.square(path - truth)[:, :2].sum(axis=1))) for path in (live, final)]
    assert off[1] < off[0] + 0.005
    assert off[1] < 0.02


def test_the_kept_scans_come_with_their_poses(round_trip):
    truth, _, localizer = round_trip
    kept = localizer.keyframes
    assert 10 < len(kept) < 200
    for scan, T in [(frame.scan, frame.T_map_base) for frame in kept]:
        on_walls = se2.transform_points(T, scan.points_base())
        assert np.isfinite(on_walls).all()
        assert np.hypot(*(truth[:, :2] - T[:2]).T).min() < 0.05


def test_a_single_wrong_match_does_not_bend_a_way_that_was_come_blindly(round_trip):
    *_, localizer = deepcopy(round_trip)
    before, loops = localizer.corrected_path(), localizer._loops
    middle = len(loops.keyframes) // 2
    loops._leaps[middle] = np.array([2.0, 2.0, 0.05])
    T = se2.between(loops.keyframes[2].T_map_base, loops.keyframes[-2].T_map_base)
    loops.matched.append(
        Measured(2, len(loops.keyframes) - 2, T + [3.0, 0.0, 0.0], 100.0 * STEP, True)
    )
    assert np.hypot(*(localizer.corrected_path() - before)[:, :2].T).max() < 0.05


def test_before_any_scan_there_is_no_path():
    assert Localizer().corrected_path().shape == (0, 3)
    assert Localizer().keyframes == []


def test_a_loop_is_closed_while_the_robot_drives():
    """Wheels wear as they go: round the block the map has drifted; back there, all is put right."""
    # The first scan is made after the first step.
    localizer = Localizer(LocalizerConfig(start_x_m=3.15, start_y_m=1.2))
    rows, closed = [], []
    for scan, odom, truth in drive_round_the_block():
        estimate = localizer.step(scan, odom)
        rows.append((truth, estimate.T_map_base))
        if estimate.correction is not None:
            closed.append(len(rows))
    off = np.array([np.hypot(*(T - t)[:2]) for t, T in rows])
    assert closed
    assert off[: closed[0] - 1].max() > 0.3, 'without drift there is nothing to close'
    assert off[closed[-1] :].max() < 0.25
    assert len(localizer.corrected_path()) == len(rows)
    again = np.array([k.T_map_base for k in localizer.keyframes])
    assert np.isfinite(again).all()


HALL = np.zeros((242, 402), dtype=np.int8)  # 40 x 24 m, with a few pilasters
HALL[[0, -1]] = HALL[:, [0, -1]] = 100
HALL[:6, 60:66] = HALL[:6, 200:204] = HALL[-8:, 100:104] = 100
HALL[100:104, -9:] = HALL[150:153, :8] = 100
HALL[60:64, -12:] = 100


def along(*corners):
    """Points (K, 2) every 5 cm along straight lines from corner to corner, m."""
    legs = [
        np.linspace(a, b, int(np.hypot(*np.subtract(b, a)) / 0.05) + 1)
        for a, b in pairwise(corners)
    ]
    return np.concatenate(legs)


@pytest.mark.parametrize('seed', range(3))
def test_a_hall_that_is_wider_than_the_laser_sees_is_mapped_all_the_same(seed):
    """Across it by odometry alone, 25 m with bends, then along its walls back to where it began."""
    start = se2.pose(2.0, 2.0, np.pi / 2.0)
    world = World.from_patch('hall', GridPatch(GridFrame(-0.1, -0.1, 0.1), HALL), start)
    simulation = Simulation(world, start, PioneerConfig(), Lms200Config(), seed)
    across = along((2, 2), (2, 12), (9, 14), (16, 10), (23, 14), (30, 11), (36.5, 12))
    round_it = along((36.5, 12), (36.5, 20), (3, 21), (3, 3))
    back = along((3, 3), (2, 2.5), (2, 12))
    localizer = Localizer(LocalizerConfig(start_x_m=2.0, start_y_m=2.0, start_yaw_rad=np.pi / 2.0))
    blind, lost, off, turned = 0, 0, [], []
    for look in drive_along(simulation, [across, round_it, back], 0.5):
        estimate = localizer.step(look.scan, look.T_odom_base)
        sees = np.count_nonzero(look.scan.hit) > 30
        blind, lost = blind + (not sees), lost + (sees and estimate.lost)
        off.append(np.hypot(*se2.between(look.T_world_base, estimate.T_map_base)[:2]))
        turned.append(abs(se2.between(look.T_world_base, estimate.T_map_base)[2]) if sees else 0.0)
    assert blind > 200
    assert max(turned[len(turned) // 3 :]) < 0.03, (
        'beyond the hall its walls tell how the robot is turned'
    )
    assert lost < 30, 'walls that are new are a map to hold on to'
    assert np.mean(off[-20:]) < 0.5 * max(off), 'what was known before puts it right'
