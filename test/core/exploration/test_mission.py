"""Budgets, the distance that is counted against them, and a polygon to stay in."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core.exploration.mission import Budget, Odometer, fenced, inside
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import GridPatch

SQUARE = np.array([[1.0, 1.0], [3.0, 1.0], [3.0, 3.0], [1.0, 3.0]])
ARROW = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 1.0], [0.0, 4.0]])


def test_noise_at_a_standstill_is_no_distance_but_a_slow_robot_gets_on():
    odometer = Odometer()
    rng = np.random.default_rng(1)
    for _ in range(500):
        odometer.add(np.append(rng.normal(0.0, 0.002, 2), 0.0))
    assert odometer.distance_m == 0.0
    for x in np.arange(0.0, 2.0, 0.005):
        odometer.add(np.array([x, 0.0, 0.0]))
    assert odometer.distance_m == pytest.approx(2.0, abs=0.05)


def test_the_start_is_the_first_pose():
    odometer = Odometer()
    assert odometer.start is None
    odometer.add(np.array([1.0, 2.0, 0.5]))
    odometer.add(np.array([2.0, 2.0, 0.5]))
    assert odometer.start is not None
    assert odometer.start.tolist() == [1.0, 2.0, 0.5]


@pytest.mark.parametrize(
    ('used', 'word'),
    [
        ((9.0, 4.0, 19.0), ''),
        ((10.0, 0.0, 0.0), 'time'),
        ((0.0, 5.0, 0.0), 'distance'),
        ((0.0, 0.0, 21.0), 'area'),
    ],
)
def test_each_limit_ends_it_and_says_which(used, word):
    reason = Budget(10.0, 5.0, 20.0).used_up(*used)
    assert (reason == '') if not word else reason.startswith(word)


def test_without_limits_nothing_is_ever_used_up():
    assert Budget().used_up(1e9, 1e9, 1e9) == ''


@given(st.floats(0.0, 4.0), st.floats(0.0, 4.0))
def test_square_against_its_sides(x, y):
    if min(abs(v - edge) for v in (x, y) for edge in (1.0, 3.0)) > 1e-9:
        assert inside(np.array([[x, y]]), SQUARE)[0] == (1.0 < x < 3.0 and 1.0 < y < 3.0)


def test_a_dent_is_outside_and_the_direction_of_the_polygon_does_not_matter():
    points = np.array([[2.0, 0.5], [2.0, 2.0], [0.5, 2.0], [3.5, 2.0], [5.0, 0.5]])
    expected = [True, False, True, True, False]
    assert inside(points, ARROW).tolist() == inside(points, ARROW[::-1]).tolist() == expected


def test_outside_the_fence_all_is_wall_and_inside_nothing_changes():
    cells = np.random.default_rng(3).choice(np.array([-1, 0, 100], dtype=np.int8), size=(40, 50))
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), cells)
    before = cells.copy()
    result = fenced(patch, SQUARE)
    assert (result.cells[10:30, 10:30] == cells[10:30, 10:30]).all()
    outside = np.ones_like(cells, dtype=np.bool_)
    outside[10:30, 10:30] = False
    assert (result.cells[outside] == 100).all()
    assert (cells == before).all()
