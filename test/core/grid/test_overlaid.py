"""A map laid over another one, at any pose and with other cells."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.moved import overlaid
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch


def room(rows, cols, cell_m=0.1, origin=(0.0, 0.0)):
    cells = np.zeros((rows, cols), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    return GridPatch(GridFrame(*origin, cell_m), cells)


def state_at(patch, points):
    cells = patch.frame.cells_of(points)
    inside = ((cells >= 0) & (cells < patch.shape)).all(axis=1)
    found = np.full(len(points), UNKNOWN)
    found[inside] = patch.cells[tuple(cells[inside].T)]
    return found


@settings(max_examples=40, deadline=None)
@given(
    st.floats(-6.0, 6.0),
    st.floats(-6.0, 6.0),
    st.floats(-3.1, 3.1),
    st.sampled_from([0.05, 0.1, 0.2]),
)
def test_what_the_base_knows_stays_and_the_rest_is_that_of_the_other(x, y, theta, cell_m):
    base = room(40, 60, origin=(-2.0, 1.0))
    other = room(30, 30, cell_m, origin=(0.3, -0.4))
    T = se2.pose(x, y, theta)
    result = overlaid(base, other, T)
    own = base.frame.centres_of(np.argwhere(base.cells > -2))
    np.testing.assert_array_equal(state_at(result, own), base.cells.ravel())
    free = other.frame.centres_of(np.argwhere(other.free))
    there = se2.transform_points(T, free)
    outside = state_at(base, there) == UNKNOWN
    assert (state_at(result, there[outside]) != UNKNOWN).all()
    walls = se2.transform_points(T, other.frame.centres_of(np.argwhere(other.occupied)))
    outside = state_at(base, walls) == UNKNOWN
    assert (state_at(result, walls[outside]) >= 65).all()


def test_the_lattice_of_the_base_is_kept():
    base = room(20, 20)
    result = overlaid(base, room(20, 20), np.array([-3.0, -1.0, 0.4]))
    assert result.is_aligned_with(base)


def test_a_map_far_away_is_an_error():
    with pytest.raises(InputError, match=r'joined map: .* cells: expected'):
        overlaid(room(20, 20), room(20, 20), np.array([9000.0, 9000.0, 0.0]))
