"""Paths planned in a window of the map are those of the whole map."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning import paths
from thinmap_ros.core.planning.paths import plan_short_path
from thinmap_ros.core.planning.wavefront import Obstacles, WavefrontConfig, plan

CONFIG = WavefrontConfig()
NO_CELLS = np.zeros((0, 2), dtype=np.int64)


def hall(rows=400, cols=400):
    """Of 40 x 40 m, between walls."""
    cells = np.zeros((rows, cols), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    return cells


def patch_of(cells):
    return GridPatch(GridFrame(-3.0, 5.0, 0.1), cells)


def length_of(path):
    return math.inf if path is None else float(np.hypot(*np.diff(path, axis=0).T).sum())


def window_sizes(monkeypatch):
    """Sizes of the maps in which paths are looked for, in the order of the searches."""
    sizes = []
    find_path = paths.find_path

    def spy(patch, *arguments):
        sizes.append(patch.shape)
        return find_path(patch, *arguments)

    monkeypatch.setattr(paths, 'find_path', spy)
    return sizes


@given(st.integers(0, 2**32 - 1))
def test_a_path_is_as_long_as_that_on_the_whole_map(seed):
    rng = np.random.default_rng(seed)
    cells = hall()
    for row, col in rng.integers(0, 380, (60, 2)):
        height, width = rng.permutation([2, int(rng.integers(20, 90))])
        cells[row : row + height, col : col + width] = 100
    patch = patch_of(cells)
    start = rng.uniform((2.0, 10.0), (32.0, 40.0))
    goal = start + rng.uniform(-9.0, 9.0, 2)
    found = plan_short_path(patch, tuple(start), tuple(goal), CONFIG, None, NO_CELLS)
    expected = plan(patch, tuple(start), tuple(goal), CONFIG)
    assert (found is None) == (expected is None)
    if found is not None:
        assert length_of(found) == pytest.approx(length_of(expected), rel=1e-6)


def test_a_near_goal_is_planned_in_a_small_part_of_the_map(monkeypatch):
    sizes = window_sizes(monkeypatch)
    path = plan_short_path(patch_of(hall()), (10.0, 20.0), (13.0, 24.0), CONFIG, None, NO_CELLS)
    assert length_of(path) == pytest.approx(5.0, rel=0.02)
    assert len(sizes) == 1
    assert math.prod(sizes[0]) < 0.2 * 400 * 400


def test_where_the_detour_leaves_the_window_the_whole_map_is_searched(monkeypatch):
    cells = hall()
    # A wall of 30 m between start and goal: the path leads around its end.
    cells[0:300, 200:202] = 100
    sizes = window_sizes(monkeypatch)
    path = plan_short_path(patch_of(cells), (16.0, 10.0), (18.5, 10.0), CONFIG, None, NO_CELLS)
    assert len(sizes) == 2
    assert length_of(path) > 45.0


def test_obstacle_points_and_the_recent_path_count_in_the_window(monkeypatch):
    patch = patch_of(hall())
    sizes = window_sizes(monkeypatch)
    column = np.column_stack([np.full(81, 12.0), np.linspace(16.0, 24.0, 81)])
    start = (10.0, 20.0)
    goal = (14.0, 20.0)
    path = plan_short_path(patch, start, goal, CONFIG, Obstacles(column, 0.24), NO_CELLS)
    assert length_of(path) > 8.5
    assert np.hypot(*(path[:, None] - column[None]).transpose(2, 0, 1)).min() > 0.2
    assert len(sizes) == 1
    # A robot that stands in a gap of unknown space leaves it over its recent path.
    cells = hall()
    cells[140:160, 120:150] = -1
    trail = np.column_stack([np.full(40, 150), np.arange(120, 160)])
    there = patch_of(cells)
    assert plan_short_path(there, (10.5, 20.05), goal, CONFIG, None, NO_CELLS) is None
    assert plan_short_path(there, (10.5, 20.05), goal, CONFIG, None, trail) is not None
