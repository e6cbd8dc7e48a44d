"""Recent path: traversable cells on it, also for a planner whose map has a false obstacle."""

import numpy as np
import pytest

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.planning.obstacles import RecentPath
from thinmap_ros.core.planning.path_follower import SpeedConfig
from thinmap_ros.core.planning.travel_times import TravelTimes
from thinmap_ros.core.planning.wavefront import WavefrontConfig, find_path, plan

FRAME = GridFrame(-1.0, 2.0, 0.1)


@pytest.mark.parametrize('seed', range(10))
def test_its_cells_are_those_that_it_led_over_each_beside_the_one_before(seed):
    rng = np.random.default_rng(seed)
    trail = RecentPath()
    way = np.cumsum(rng.normal(0.05, 0.1, (200, 2)), axis=0) + (0.0, 4.0)
    for x, y in way:
        trail.add_pose(np.array([x, y, 0.0]))
    shape = (150, 60)
    cells = trail.cells(FRAME, shape)
    assert ((cells >= 0) & (cells < shape)).all()
    inside = (way[:, 0] < 5.0) & (way[:, 1] < 17.0) & (way[:, 0] > -1.0) & (way[:, 1] > 2.0)
    gone_over = set(map(tuple, FRAME.cells_of(way[inside]).tolist()))
    # Steps of less than 3 cm may be skipped.
    assert len(gone_over - set(map(tuple, cells.tolist()))) <= 0.05 * len(gone_over)
    if inside.all():
        assert (np.abs(np.diff(cells, axis=0)).sum(axis=1) <= 1).all()


def test_a_discontinuity_resets_it_and_old_points_are_forgotten():
    trail = RecentPath(length_m=60.0)
    for x in np.arange(0.0, 99.0, 0.05):
        trail.add_pose(np.array([x, 3.0, 0.0]))
    cells = trail.cells(FRAME, (100, 1000))
    assert cells[:, 1].min() > 100
    trail.add_pose(np.array([3.0, 3.0, 0.0]))
    assert len(trail.cells(FRAME, (100, 1000))) == 1
    assert len(RecentPath().cells(FRAME, (100, 1000))) == 0


@pytest.mark.parametrize('step_m', [0.031, 0.05, 0.1, 0.4])
@pytest.mark.parametrize('path_m', [19.0, 39.0, 41.0, 79.0, 83.0, 300.0])
def test_of_a_long_path_it_keeps_the_last_metres_however_often_it_hears_of_a_pose(path_m, step_m):
    trail = RecentPath(length_m=20.0)
    way = np.arange(0.0, path_m, step_m)
    for x in way:
        trail.add_pose(np.array([x, 3.0, 0.0]))
    kept = np.unique(trail.cells(FRAME, (100, 10_000))[:, 1])
    assert (np.diff(kept) == 1).all()
    assert kept[-1] == FRAME.cells_of(np.array([[way[-1], 3.0]]))[0, 1]
    assert 0.1 * (kept[-1] - kept[0]) == pytest.approx(min(way[-1], 20.0), abs=step_m + 0.1)


def test_a_navigator_and_an_explorer_know_the_same_way_back():
    cells = np.zeros((20, 1000), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    cells[:, 20] = 100
    cells[8:11, 20] = 0  # a gap that looks too narrow, through which the robot has come
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), cells)
    navigator = Navigator(NavigatorConfig())
    travel = TravelTimes(WavefrontConfig(), SpeedConfig())
    for step, x in enumerate(np.arange(1.0, 91.0, 0.05)):
        pose = np.array([x, 0.95, 0.0])
        navigator.step(pose, patch, None, 0.1)
        if step % 2 == 0:
            travel.add_pose(pose)
    travel.update(patch.free, ~patch.occupied, patch.frame, pose)
    home = (1.5, 0.95)
    assert np.isfinite(travel.seconds[tuple(patch.frame.cells_of(np.array([home]))[0])])
    navigator.set_goal(*home)
    assert navigator.step(pose, patch, None, 0.1).state == 'driving'


def test_a_pose_that_is_not_finite_leaves_no_trail():
    trail = RecentPath()
    for x in (np.nan, 0.0, np.inf, 0.1):
        trail.add_pose(np.array([x, 3.0, 0.0]))
    cells = trail.cells(FRAME, (100, 1000))
    been = FRAME.cells_of(np.array([[0.0, 3.0], [0.1, 3.0]]))
    assert np.unique(cells, axis=0).tolist() == been.tolist()


def test_the_recent_path_is_traversable_despite_a_false_obstacle_but_not_a_real_one():
    cells = np.zeros((60, 80), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    cells[:28, 40] = 100
    cells[33:, 40] = 100
    trail = RecentPath()
    for x in np.arange(2.0, 6.0, 0.05):
        trail.add_pose(np.array([x, 3.05, 0.0]))
    frame = GridFrame(0.0, 0.0, 0.1)
    config = WavefrontConfig()
    back = trail.cells(frame, cells.shape)
    start = (6.0, 3.05)
    goal = (2.0, 3.05)
    assert plan(GridPatch(frame, cells), start, goal, config) is not None
    cells[28, 40] = 100
    assert plan(GridPatch(frame, cells), start, goal, config) is None
    path = find_path(GridPatch(frame, cells), start, goal, config, trail=back).points
    assert np.abs(path[:, 1] - 3.05)[np.abs(path[:, 0] - 4.05) < 0.1].max() < 0.1
    cells[28:33, 40] = 100
    assert find_path(GridPatch(frame, cells), start, goal, config, trail=back) is None
