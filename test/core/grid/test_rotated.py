"""Maps with a yaw in their origin."""

import math

import numpy as np
import pytest
from scipy import ndimage

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.moved import aligned_patch

RESOLUTION_M = 0.05


def room():
    """A closed room with unknown cells around it."""
    cells = np.full((60, 80), -1, dtype=np.int8)
    cells[10:50, 10:70] = 100
    cells[11:49, 11:69] = 0
    return cells


def test_without_yaw_the_cells_stay_as_they_are():
    patch = aligned_patch(se2.pose(1.0, 2.0, 0.0), RESOLUTION_M, room())
    np.testing.assert_array_equal(patch.cells, room())
    assert (patch.frame.origin_x, patch.frame.origin_y) == (1.0, 2.0)


@pytest.mark.parametrize('quarters', [1, 2, 3, -1])
def test_a_quarter_turn_is_exact(quarters):
    yaw = quarters * math.pi / 2
    patch = aligned_patch(se2.pose(1.0, 2.0, yaw), RESOLUTION_M, room())
    # Counter-clockwise; row 0 has the lowest y.
    np.testing.assert_array_equal(patch.cells, np.rot90(room()[::-1], quarters)[::-1])


@pytest.mark.parametrize('yaw', [0.1, 0.5, -0.8, 2.0])
def test_a_cell_is_where_its_centre_is(yaw):
    cells = room()
    T = se2.pose(-3.0, 4.0, yaw)
    patch = aligned_patch(T, RESOLUTION_M, cells)
    for row, col in [(30, 40), (12, 12), (5, 5), (10, 30), (30, 69)]:
        centre = se2.compose(T, np.array([(col + 0.5) * 0.05, (row + 0.5) * 0.05, 0.0]))[:2]
        found = patch.cells[tuple(patch.frame.cells_of(centre[None])[0])]
        assert found == cells[row, col]


@pytest.mark.parametrize('yaw', [0.1, 0.5, -0.8, 2.0])
def test_walls_keep_no_gaps_and_areas_their_size(yaw):
    patch = aligned_patch(se2.pose(0.0, 0.0, yaw), RESOLUTION_M, room())
    labels = ndimage.label(patch.cells != 100)[0]
    inside = labels[patch.cells == 0]
    outside = labels[patch.cells == -1]
    assert not set(inside) & set(outside), 'the room stays closed'
    assert (patch.cells == 0).sum() == pytest.approx((room() == 0).sum(), rel=0.03)


def test_a_long_strip_whose_bounds_are_too_large_is_refused():
    cells = np.zeros((1, 1_000_000), dtype=np.int8)
    with pytest.raises(InputError, match=r'rotated by 0\.785 rad'):
        aligned_patch(se2.pose(0.0, 0.0, math.pi / 4), RESOLUTION_M, cells)
