"""A grid drawn anew at corrected poses."""

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.history import GridHistory
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.scan import Scan

POSES = np.array([se2.pose(0.3 * k, 0.0, 0.0) for k in range(12)])


def scan(stamp_ns):
    return Scan.create(stamp_ns, np.full(181, 3.0), -1.57, 0.0174, 0.05, 8.0)


def filled(poses, stamps):
    history = GridHistory()
    for T, stamp in zip(poses, stamps, strict=True):
        history.add(scan(stamp), T)
    return history


def test_what_is_drawn_anew_is_what_was_drawn():
    history, grid = filled(POSES, range(12)), OccupancyGrid()
    for k, T in enumerate(POSES):
        grid.update(scan(k), T)
    drawn = history.draw(OccupancyGrid())
    np.testing.assert_array_equal(drawn.patch().cells, grid.patch().cells)
    np.testing.assert_array_equal(history.past.poses(), POSES)


def test_scans_go_with_the_last_named_one_before_them():
    """Scan 4 is moved to the side and scan 8 is turned.

    Those after each go with it, those before the first as well.
    """
    history = filled(POSES, range(100, 112))
    moved = np.array([POSES[4] + [0.0, 1.0, 0.0], POSES[8] + [0.0, 0.0, 0.5]])
    history.past.correct(np.array([104, 108]), moved, since_ns=112)
    after = history.past.poses()
    np.testing.assert_allclose(after[:8], POSES[:8] + [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(after[8], moved[1], atol=1e-12)
    np.testing.assert_allclose(
        se2.between(after[8], after[10]), se2.between(POSES[8], POSES[10]), atol=1e-12
    )


def test_scans_that_came_after_the_correction_stay():
    history = filled(POSES, range(12))
    history.past.correct(np.array([0, 5]), POSES[[0, 5]] + [0.0, 0.0, 1.0], since_ns=9)
    np.testing.assert_array_equal(history.past.poses()[9:], POSES[9:])
    assert not np.allclose(history.past.poses()[8], POSES[8])


def test_unknown_stamps_and_stamps_that_step_back_are_borne():
    stamps = [0, 1, 2, 3, 2, 4, 5, 6, 7, 8, 9, 10]
    history = filled(POSES, stamps)
    history.past.correct(np.array([77]), POSES[:1] + 5.0, since_ns=100)
    np.testing.assert_array_equal(history.past.poses(), POSES)
    history.past.correct(np.array([2]), POSES[[4]] + [1.0, 0.0, 0.0], since_ns=100)
    np.testing.assert_allclose(history.past.poses(), POSES + [1.0, 0.0, 0.0], atol=1e-12)


def test_a_robot_that_stands_still_is_kept_once():
    history = filled(np.zeros((50, 3)), range(50))
    assert len(history.past.poses()) == 1


def test_of_a_place_that_is_seen_again_and_again_the_newest_scans_are_kept():
    laps = 30
    history = filled(np.tile(POSES, (laps, 1)), range(12 * laps))
    kept = history.past.scans()
    assert len(kept) == len(history.past.poses()) <= 12 * 4
    assert min(s.stamp_ns for s in kept) >= 12 * (laps - 5)
    stamps = [s.stamp_ns for s in kept]
    assert stamps == sorted(stamps)
    drawn = history.draw(OccupancyGrid())
    once = filled(POSES, range(12)).draw(OccupancyGrid())
    np.testing.assert_array_equal(drawn.patch().cells >= 0, once.patch().cells >= 0)


def test_places_are_those_after_a_correction():
    """Two halves of a way turn out to be one: when more is seen there, the newer scans are left."""
    there = np.array([se2.pose(0.01 + k, 0.1, 0.1) for k in range(8)])
    away = there + [0.0, 50.0, 0.0]
    history = filled(np.concatenate([there] * 4 + [away] * 4), range(64))
    before = history.past.poses()
    history.past.correct(np.array([0, 32]), there[[0, 0]], since_ns=64)
    after = history.past.poses()
    assert len(after) == len(before) == len(history.past.scans()) == 64, (
        'one pose for each that there was'
    )
    for k, T in enumerate(there):
        history.add(scan(64 + k), T)
    assert len(history.past.scans()) == 32
    assert min(s.stamp_ns for s in history.past.scans()) == 40
