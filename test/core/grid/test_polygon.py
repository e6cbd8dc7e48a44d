"""Maps that are limited to a polygon."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core.grid.edits import inside, masked_outside
from thinmap_ros.core.grid.patch import GridFrame, GridPatch

SQUARE = np.array([[1.0, 1.0], [3.0, 1.0], [3.0, 3.0], [1.0, 3.0]])
ARROW = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 1.0], [0.0, 4.0]])


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
    result = masked_outside(patch, SQUARE)
    assert (result.cells[10:30, 10:30] == cells[10:30, 10:30]).all()
    outside = np.ones_like(cells, dtype=np.bool_)
    outside[10:30, 10:30] = False
    assert (result.cells[outside] == 100).all()
    assert (cells == before).all()
