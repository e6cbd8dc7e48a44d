"""Pose graphs and loops: drift is spread over the path, and a wrong loop moves nothing."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares
from slam_room import ROOM, drive, drive_round_the_block, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.localizer import Localizer, LocalizerConfig
from thinmap_ros.core.slam.loops import LoopConfig, Loops
from thinmap_ros.core.slam.pose_graph import Measured, relax
from thinmap_ros.core.slam.scan_matching import MatchConfig

STEP = np.diag(1.0 / np.square([0.05, 0.05, 0.02]))
START = np.array([2.0, 2.0, 0.0])


def ring(rng, number=40):
    """True poses round a circle, drifting estimates, and what was measured from each to the next."""
    angles = np.linspace(0.0, 2.0 * np.pi, number, endpoint=False)
    truth = np.column_stack([5.0 * np.cos(angles), 5.0 * np.sin(angles), se2.wrap(angles + np.pi / 2.0)])
    steps = [se2.between(a, b) + rng.normal(0.003, 0.004, 3) for a, b in pairwise(truth)]
    poses = [truth[0]]
    for step in steps:
        poses.append(se2.compose(poses[-1], step))
    return truth, np.array(poses), [Measured(i, i + 1, step, STEP, False) for i, step in enumerate(steps)]


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
    right = [Measured(39 - i, i, se2.between(truth[39 - i], truth[i]), 100.0 * STEP, True) for i in range(3)]
    wrong = Measured(5, 25, np.zeros(3), 100.0 * STEP, True)
    with_wrong = relax(poses, [*measured, *right, wrong])
    without = relax(poses, [*measured, *right])
    assert worst(with_wrong, without) < 0.1


def test_without_measurements_nothing_moves():
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 3.0]])
    np.testing.assert_array_equal(relax(poses, []), poses)
    np.testing.assert_array_equal(relax(poses[:1], []), poses[:1])


def loops_in_a_room(drift):
    """Loops along a drive, and the true poses of the keyframes; drift (3,): what the given poses err a metre."""
    rng = np.random.default_rng(2)
    loops, truths, drifting, last = Loops(LoopConfig(), MatchConfig()), [], START, START
    for truth, _ in drive(1300, rng, START):
        step = se2.between(last, truth)
        ahead = float(np.hypot(step[0], step[1]))
        drifting, last = se2.compose(drifting, step + ahead * drift), truth
        scan = scan_in(ROOM, truth, rng)
        loops.follow(scan, np.ascontiguousarray(scan.points_base()), drifting, leapt=False)
        loops.work_off()
        if len(loops.keyframes) > len(truths):
            truths.append(truth)
    return loops, np.array(truths)


def test_loops_in_a_room_straighten_a_path_that_drifts():
    """Poses that drift by 1 cm and 0.3 degrees a metre: the matches with earlier visits pull them together."""
    loops, truths = loops_in_a_room(np.array([0.01, 0.003, 0.005]))
    before = np.array([k.T_map_base for k in loops.keyframes])
    after = loops.relaxed()
    assert len(loops.matched) > 10
    assert worst(before, truths) > 0.3
    assert worst(after, truths) < 0.5 * worst(before, truths)


def test_where_the_map_agrees_few_matches_are_asked_for():
    def matches(loops):
        return np.bincount([m.b for m in loops.matched])

    right, drifting = (matches(loops_in_a_room(drift)[0]) for drift in (np.zeros(3), np.array([0.01, 0.003, 0.005])))
    assert right.sum() > 10
    assert (right[:-1] + right[1:]).max() == 1, 'one visit, and not of two keyframes in a row'
    assert drifting.max() > 1


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


def test_before_any_scan_there_is_no_path():
    assert Localizer().corrected_path().shape == (0, 3)
    assert Localizer().keyframes == []


def test_a_loop_is_closed_while_the_robot_drives():
    """Wheels that wear to one side: round the block the map has drifted; coming back, all of it is put right."""
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
