import heapq
import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.oblique_doors import oblique_door, pass_door

from thinmap_ros.core.grid.fields import nearest_true
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.grid_search import path_collides
from thinmap_ros.core.planning.wavefront import (
    WavefrontConfig,
    cost_of_cells,
    find_path,
    navigation_function,
    plan,
    trace_gradient_path,
)

PLAIN = WavefrontConfig(robot_radius_m=0.25, inflation_cost=0.0)


def patch_of(drawing):
    """Grid from rows, top down: '.' free, '#' occupied, '?' unknown.

    Cells of 10 cm, corner at (1, 2).
    """
    states = {'.': 0, '#': 100, '?': -1}
    cells = np.array([[states[c] for c in row] for row in reversed(drawing)], dtype=np.int8)
    return GridPatch(GridFrame(1.0, 2.0, 0.1), cells)


def room(rows, cols):
    cells = np.zeros((rows, cols), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    return cells


def patch(cells):
    return GridPatch(GridFrame(0.0, 0.0, 0.1), cells)


def reference(cost, goal):
    """The same upwind equation, and steps over corners, with Python's heap."""
    rows, cols = cost.shape
    field = np.full(cost.shape, np.inf)
    done = set()
    field[goal] = 0.0
    heap = [(0.0, goal)]
    while heap:
        _, (row, col) = heapq.heappop(heap)
        if (row, col) in done:
            continue
        done.add((row, col))
        for r, c in ((row + 1, col), (row - 1, col), (row, col + 1), (row, col - 1)):
            if not (0 <= r < rows and 0 <= c < cols) or (r, c) in done or math.isinf(cost[r, c]):
                continue
            padded = np.pad(field, 1, constant_values=np.inf)
            a = min(padded[r, c + 1], padded[r + 2, c + 1])
            b = min(padded[r + 1, c], padded[r + 1, c + 2])
            f = cost[r, c]
            value = (
                (a + b + math.sqrt(2 * f * f - (a - b) ** 2)) / 2
                if abs(a - b) < f
                else min(a, b) + f
            )
            if value < field[r, c]:
                field[r, c] = value
                heapq.heappush(heap, (value, (r, c)))
        for r, c in itertools.product((row - 1, row + 1), (col - 1, col + 1)):
            if 0 <= r < rows and 0 <= c < cols and math.isinf(cost[row, c] + cost[r, col]):
                value = field[row, col] + math.sqrt(2) * cost[r, c]
                is_only_way = math.isinf(cost[row, c]) and math.isinf(cost[r, col])
                if is_only_way and (r, c) not in done and value < field[r, c]:
                    field[r, c] = value
                    heapq.heappush(heap, (value, (r, c)))
    return field


@given(st.integers(2, 12), st.integers(2, 12), st.integers(0, 2**32 - 1))
def test_the_wave_equals_the_plain_reference(rows, cols, seed):
    rng = np.random.default_rng(seed)
    cost = np.where(rng.random((rows, cols)) < 0.3, np.inf, rng.uniform(1.0, 4.0, (rows, cols)))
    goal = (int(rng.integers(rows)), int(rng.integers(cols)))
    cost[goal] = 1.0
    np.testing.assert_allclose(navigation_function(cost, goal), reference(cost, goal), rtol=1e-12)


@given(st.integers(3, 14), st.integers(3, 14), st.integers(0, 2**32 - 1))
def test_a_path_goes_down_over_open_cells_to_the_goal_and_never_jumps(rows, cols, seed):
    rng = np.random.default_rng(seed)
    cost = np.where(rng.random((rows, cols)) < 0.3, np.inf, rng.uniform(1.0, 4.0, (rows, cols)))
    goal = (int(rng.integers(rows)), int(rng.integers(cols)))
    start = (int(rng.integers(rows)), int(rng.integers(cols)))
    cost[goal] = 1.0
    field = navigation_function(cost, goal)
    if np.isinf(field[start]):
        return
    path = trace_gradient_path(field, start[1] + 0.5, start[0] + 0.5, *goal)
    cells = np.floor(path[:, ::-1]).astype(int)
    heights = field[cells[:, 0], cells[:, 1]]
    assert np.isfinite(heights).all()
    assert (np.diff(heights) <= 0.0).all()
    assert (np.hypot(*np.diff(path, axis=0).T) <= 1.5).all()
    np.testing.assert_array_equal(path[-1], [goal[1] + 0.5, goal[0] + 0.5])


def test_stopping_at_the_start_does_not_change_the_path():
    rng = np.random.default_rng(5)
    cost = np.where(rng.random((60, 60)) < 0.2, np.inf, 1.0)
    cost[5, 5] = cost[20, 18] = 1.0
    whole = navigation_function(cost, (5, 5))
    partial = navigation_function(cost, (5, 5), (20, 18))
    assert partial[20, 18] == whole[20, 18]
    assert np.isinf(partial).sum() > np.isinf(whole).sum()


@pytest.mark.parametrize('angle_deg', [0, 10, 30, 45, 70, 90, 135, 200])
def test_in_the_open_a_path_is_straight_in_every_direction(angle_deg):
    free = np.zeros((200, 200), dtype=np.int8)
    goal = 10.0 + 7.0 * np.array(
        [math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))]
    )
    path = plan(patch(free), (10.0, 10.0), tuple(goal), PLAIN)
    length = np.hypot(*np.diff(path, axis=0).T).sum()
    assert length <= 1.02 * 7.0
    np.testing.assert_allclose(path[[0, -1]], [[10.0, 10.0], goal])


def test_round_a_wall_a_path_is_hardly_longer_than_the_string_pulled_tight():
    cells = room(120, 120)
    cells[40, :80] = 100
    path = plan(patch(cells), (2.0, 2.0), (2.0, 6.0), PLAIN)
    # Close around the end of the wall (x = 8.0, y = 4.0 to 4.1), at 0.25 m,
    # plus half a cell.
    around = 2.0 * math.hypot(8.2 - 2.0, 2.05)
    assert np.hypot(*np.diff(path, axis=0).T).sum() <= 1.05 * around


def test_no_point_of_a_path_is_nearer_to_an_obstacle_than_the_radius():
    rng = np.random.default_rng(1)
    cells = room(150, 150)
    cells[rng.integers(0, 150, 60), rng.integers(0, 150, 60)] = 100
    cells[10:20, 10:20] = cells[130:140, 130:140] = 0
    path = plan(patch(cells), (1.5, 1.5), (13.5, 13.5), PLAIN)
    centres = (np.argwhere(cells == 100)[:, ::-1] + 0.5) * 0.1
    nearest = np.hypot(*(path[:, None] - centres[None]).transpose(2, 0, 1)).min()
    assert nearest >= 0.25 - 0.05 * math.sqrt(2.0)


def test_where_there_is_room_a_path_keeps_off_the_walls():
    cells = room(40, 100)
    near = WavefrontConfig(inflation_cost=0.0)
    far = WavefrontConfig(inflation_radius_m=1.0, inflation_cost=5.0)
    start = (0.5, 0.5)
    goal = (9.5, 0.5)
    middle = [np.median(plan(patch(cells), start, goal, config)[:, 1]) for config in (near, far)]
    assert middle[0] == pytest.approx(0.5, abs=0.1)
    assert middle[1] > 0.9


def test_a_gap_as_wide_as_the_robot_is_passed_and_a_narrower_one_is_not():
    for free_cells, passes in ((5, True), (4, False)):
        cells = room(60, 60)
        cells[30] = 100
        cells[30, 25 : 25 + free_cells] = 0
        assert (plan(patch(cells), (2.0, 1.0), (2.0, 5.0), PLAIN) is not None) is passes


def test_unknown_space_is_forbidden_or_costly_as_configured():
    cells = room(60, 60)
    cells[30, :] = cells[31, :] = cells[32, :] = -1
    goals = ((2.0, 1.0), (2.0, 5.0))
    assert plan(patch(cells), *goals, WavefrontConfig(allow_unknown=False)) is None
    assert plan(patch(cells), *goals, WavefrontConfig(allow_unknown=True)) is not None


def test_costly_unknown_space_is_avoided_if_there_is_another_path():
    cells = room(60, 100)
    cells[25:35, :70] = -1
    path = plan(
        patch(cells), (2.0, 1.0), (2.0, 5.0), WavefrontConfig(allow_unknown=True, unknown_cost=20.0)
    )
    assert path[:, 0].max() > 7.0


def test_a_start_too_near_to_a_wall_escapes_but_not_through_the_wall():
    cells = room(60, 60)
    cells[30, :] = 100
    assert plan(patch(cells), (2.05, 2.85), (2.0, 1.0), PLAIN) is not None
    assert plan(patch(cells), (2.05, 2.85), (2.0, 5.0), PLAIN) is None


@pytest.mark.parametrize('angle_deg', [0.0, 10.0, 22.5, 30.0, 45.0])
@pytest.mark.parametrize('resolution', [0.05, 0.1])
@pytest.mark.parametrize('noise', [0.0, 0.2])
def test_the_planner_passes_the_doors_that_the_graph_passes(angle_deg, resolution, noise):
    for offset_m, radius_m in itertools.product((0.0, 0.012, 0.025, 0.037), (0.25, 0.3, 0.35)):
        grid, point = oblique_door(angle_deg, offset_m, resolution, noise)
        is_through, path = pass_door(grid, point, radius_m)
        assert (path is not None) is is_through
        assert path is None or not path_collides(grid, path, radius_m)


def test_a_step_over_a_corner_leads_from_centre_to_centre():
    cost = np.full((4, 4), np.inf)
    cost[:2, :2] = cost[2:, 2:] = 1.0
    path = trace_gradient_path(navigation_function(cost, (3, 3)), 0.5, 0.5, 3, 3).tolist()
    k = path.index([1.5, 1.5])
    assert path[k + 1] == [2.5, 2.5]


def test_a_start_beside_a_diagonal_wall_of_single_cells_does_not_escape_through_it():
    cells = room(60, 60)
    cells[np.arange(1, 59), np.arange(1, 59)] = 100
    across = (1.5, 4.5)
    assert plan(patch(cells), (3.05, 2.95), across, PLAIN) is None
    trail = np.array([[30, 29], [29, 30], [31, 29], [29, 31]])
    assert find_path(patch(cells), (3.05, 2.95), across, PLAIN, trail=trail) is None


def test_a_goal_too_near_to_a_wall_moves_a_little_and_no_more():
    cells = room(60, 60)
    path = plan(patch(cells), (3.0, 3.0), (3.05, 0.15), PLAIN)
    assert 0.2 <= path[-1, 1] <= 0.45
    assert (
        plan(patch(cells), (3.0, 3.0), (3.05, 0.15), WavefrontConfig(goal_search_radius_m=0.05))
        is None
    )


@pytest.mark.parametrize('goal', [(50.0, 3.0), (-4.0, 3.0)])
def test_a_goal_off_the_map_is_refused(goal):
    assert plan(patch(room(60, 60)), (3.0, 3.0), goal, PLAIN) is None


def test_the_map_s_own_origin_counts():
    drawing = ['#' * 30] + ['#' + '.' * 28 + '#'] * 20 + ['#' * 30]
    path = plan(patch_of(drawing), (1.6, 2.9), (3.4, 3.1), PLAIN)
    np.testing.assert_allclose(path[-1], [3.4, 3.1])
    assert np.hypot(*np.diff(path, axis=0).T).sum() < 1.05 * math.hypot(1.8, 0.2) + 0.05


def test_intrinsic_cost_falls_to_nothing_at_the_stated_distance():
    config = WavefrontConfig(robot_radius_m=0.25, inflation_radius_m=0.8, inflation_cost=3.0)
    cost = cost_of_cells(patch(room(60, 60)), config)
    column = cost[:30, 30]
    assert np.isinf(column[:3]).all()
    assert 1.0 < column[3] <= 4.0
    assert (np.diff(column[3:]) <= 0.0).all()
    assert (column[8:] == 1.0).all()


def test_planning_leaves_the_map_as_it_was():
    cells = room(40, 40)
    before = cells.copy()
    plan(patch(cells), (0.15, 0.15), (3.0, 3.0), PLAIN)
    np.testing.assert_array_equal(cells, before)


def test_nearest_true_cell():
    allowed = np.zeros((10, 10), dtype=np.bool_)
    allowed[2, 2] = allowed[9, 9] = True
    assert nearest_true(allowed, (0, 2), 3.0) == (2, 2)
    assert nearest_true(allowed, (0, 2), 1.9) is None
    assert nearest_true(allowed, (-2, 2), 4.0) == (2, 2)
    assert nearest_true(allowed, (-30, 2), 4.0) is None
