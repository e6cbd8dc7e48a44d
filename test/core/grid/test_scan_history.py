"""Scan history: corrected poses, and the choice of stored scans."""

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.grid.correction import PoseHistory

POSES = np.array([se2.pose(0.3 * k, 0.0, 0.0) for k in range(12)])


def filled(poses, stamps):
    history = PoseHistory()
    for T, stamp in zip(poses, stamps, strict=True):
        history.add_pose(stamp, T, stamp)
    return history


def test_scans_move_with_the_last_named_one_before_them():
    """Scan 4 is shifted and scan 8 is rotated.

    Later scans move with each of them, and scans before the first one, too.
    """
    history = filled(POSES, range(100, 112))
    moved = np.array([POSES[4] + [0.0, 1.0, 0.0], POSES[8] + [0.0, 0.0, 0.5]])
    history.apply_correction(np.array([104, 108]), moved, since_ns=112)
    after = history.kept_poses()
    np.testing.assert_allclose(after[:8], POSES[:8] + [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(after[8], moved[1], atol=1e-12)
    np.testing.assert_allclose(
        se2.between(after[8], after[10]), se2.between(POSES[8], POSES[10]), atol=1e-12
    )


def test_scans_whose_poses_are_right_already_stay():
    history = filled(POSES, range(12))
    history.apply_correction(np.array([0, 5]), POSES[[0, 5]] + [0.0, 0.0, 1.0], since_ns=9)
    np.testing.assert_array_equal(history.kept_poses()[9:], POSES[9:])
    assert not np.allclose(history.kept_poses()[8], POSES[8])


def test_unknown_stamps_and_stamps_that_step_back_are_borne():
    stamps = [0, 1, 2, 3, 2, 4, 5, 6, 7, 8, 9, 10]
    history = filled(POSES, stamps)
    history.apply_correction(np.array([77]), POSES[:1] + 5.0, since_ns=100)
    np.testing.assert_array_equal(history.kept_poses(), POSES)
    history.apply_correction(np.array([-3, 2]), POSES[[0, 4]] + [1.0, 0.0, 0.0], since_ns=100)
    np.testing.assert_allclose(history.kept_poses(), POSES + [1.0, 0.0, 0.0], atol=1e-12)


def test_named_scans_may_come_in_any_order():
    history = filled(POSES, range(12))
    other = filled(POSES, range(12))
    stamps = np.array([7, 2, 10])
    moved = POSES[stamps] + [[0.0, 1.0, 0.1], [0.5, 0.0, 0.0], [0.0, 0.0, -0.3]]
    history.apply_correction(stamps, moved, since_ns=12)
    other.apply_correction(stamps[[1, 0, 2]], moved[[1, 0, 2]], since_ns=12)
    np.testing.assert_array_equal(history.kept_poses(), other.kept_poses())
    np.testing.assert_allclose(history.kept_poses()[stamps], moved, atol=1e-12)


def test_a_robot_that_stands_still_is_kept_once():
    history = filled(np.zeros((50, 3)), range(50))
    assert history.kept() == [0]


@pytest.mark.parametrize('step', [(0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, 0.0, 0.3)])
def test_a_robot_that_moves_in_any_way_is_kept_at_each_pose(step):
    poses = np.outer(np.arange(5), step)
    assert filled(poses, range(5)).kept() == [0, 1, 2, 3, 4]


def test_of_a_place_that_is_seen_again_and_again_the_newest_scans_are_kept():
    laps = 30
    history = filled(np.tile(POSES, (laps, 1)), range(12 * laps))
    kept = history.kept()
    assert len(kept) == len(history.kept_poses()) <= 12 * 4
    assert min(kept) >= 12 * (laps - 5)
    assert kept == sorted(kept)


def test_a_robot_that_turns_on_the_spot_keeps_four_scans_of_each_of_eight_directions():
    turning = np.array([se2.pose(0.5, 0.5, 0.3 * k) for k in range(200)])
    kept = filled(turning, range(200)).kept()
    assert len(kept) == 4 * 8


def test_places_are_those_after_a_correction():
    """Two halves of a path are corrected onto each other: the newest scans are kept."""
    there = np.array([se2.pose(0.01 + k, 0.1, 0.1) for k in range(8)])
    away = there + [0.0, 50.0, 0.0]
    history = filled(np.concatenate([there] * 4 + [away] * 4), range(64))
    history.apply_correction(np.array([0, 32]), there[[0, 0]], since_ns=64)
    assert history.kept() == list(range(64))
    for k, T in enumerate(there):
        history.add_pose(64 + k, T, 64 + k)
    assert len(history.kept()) == 32
    assert min(history.kept()) == 40


def test_poses_before_the_corrections_are_those_of_the_first_since_they_were_accepted():
    """Poses after a correction are stored as if there had been no correction."""
    history = filled(POSES[:6], range(6))
    history.apply_correction(np.array([0]), POSES[[0]] + [0.0, 1.0, 0.0], since_ns=6)
    for k in (6, 7):
        history.add_pose(k, POSES[k] + [0.0, 1.0, 0.0], k)
    history.apply_correction(np.array([0]), POSES[[0]] + [0.0, 3.0, 0.0], since_ns=8)
    history.add_pose(8, POSES[8] + [0.0, 3.0, 0.0], 8)
    moved = history.accept_corrections()
    np.testing.assert_allclose(moved.before, POSES[:9], atol=1e-12)
    np.testing.assert_allclose(moved.after, POSES[:9] + [0.0, 3.0, 0.0], atol=1e-12)
    again = history.accept_corrections()
    np.testing.assert_array_equal(again.before, again.after)


@pytest.mark.parametrize('stamps', [[], [77]])
def test_a_correction_that_names_no_scan_changes_nothing(stamps):
    for poses in (POSES, POSES[:0]):
        history = filled(poses, range(len(poses)))
        history.apply_correction(
            np.array(stamps, dtype=np.int64), POSES[: len(stamps)] + 1.0, since_ns=99
        )
        np.testing.assert_array_equal(history.kept_poses(), poses)
        np.testing.assert_array_equal(history.accept_corrections().before, poses)


def test_scans_of_several_lasers_are_stored_beside_each_other():
    history = PoseHistory()
    for k in range(12):
        for frame in ('front', 'rear'):
            history.add_pose(k, POSES[0] if k % 2 else POSES[4], (k, frame), frame)
    of = [[k for k, own in history.kept() if own == frame] for frame in ('front', 'rear')]
    assert of[0] == of[1] and len(of[0]) == 8, 'four of each place'


def test_scans_of_an_unknown_laser_are_those_of_the_first_that_is_known():
    """Those of a session make room for new ones at their place."""
    history = PoseHistory()
    for k in range(8):
        history.add_pose(k, POSES[0] if k % 2 else POSES[4], k)
    for k in range(8, 16):
        history.add_pose(k, POSES[0] if k % 2 else POSES[4], k, 'laser')
    assert history.kept() == list(range(8, 16))
