"""Maps of several robots on the same cells as one: evidence adds up, in any order."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thinmap_ros.core.grid.fused import Layer, fused
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch

FRAME = GridFrame(0.0, 0.0, 0.05)
NOWHERE = np.zeros((0, 2))
APART_M = 0.1


def layer(cells, driven=NOWHERE):
    return Layer(GridPatch(FRAME, cells.astype(np.int8)), np.asarray(driven, dtype=np.float64))


def hall():
    """40 x 40 free cells."""
    return np.zeros((40, 40), dtype=np.int8)


def in_each_order(*layers):
    return [fused(order, APART_M) for order in permutations(layers)]


@pytest.mark.parametrize('wall', [70, 80, 95])
def test_a_wall_that_is_less_sure_than_free_ground_goes_in_any_order(wall):
    cells = hall()
    cells[20, 10:20] = wall
    for joint in in_each_order(layer(cells), layer(hall())):
        assert joint.free.all()


def test_equal_evidence_is_undecided_and_a_third_map_decides():
    cells = hall()
    cells[20, 10:20] = 100
    for joint in in_each_order(layer(cells), layer(hall())):
        assert joint.unknown[20, 10:20].all()
        assert joint.free.sum() == joint.cells.size - 10
    for joint in in_each_order(layer(cells), layer(hall()), layer(hall())):
        assert joint.free.all()
    for joint in in_each_order(layer(cells), layer(cells), layer(hall())):
        assert joint.occupied[20, 10:20].all()


@pytest.mark.parametrize('off', [1, 2])
def test_a_thin_wall_at_slightly_different_places_stays_as_thin(off):
    first = hall()
    first[20] = 100
    second = hall()
    second[20 + off] = 100
    joint = fused([layer(first), layer(second)], APART_M)
    np.testing.assert_array_equal(joint.cells, first)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(-1, 100), min_size=16, max_size=16))
def test_what_one_map_alone_knows_stays(values):
    cells = np.array(values, dtype=np.int8).reshape(4, 4)
    unknown = np.full((4, 4), UNKNOWN, dtype=np.int8)
    for joint in in_each_order(layer(cells), layer(unknown)):
        np.testing.assert_array_equal(joint.cells, cells)


def test_what_a_robot_drove_over_is_free_unless_its_own_map_shows_a_wall_there():
    seen = hall()
    seen[18:23, 18:23] = 100
    unknown = np.full((40, 40), UNKNOWN, dtype=np.int8)
    path = [(0.5, 1.0), (1.0, 1.0), (1.5, 1.0)]
    for joint in in_each_order(layer(seen), layer(unknown, path)):
        assert joint.free.all()
    seen[23:] = UNKNOWN
    wall = unknown.copy()
    wall[23] = 100  # 0.175 m beside the path
    for joint in in_each_order(layer(seen), layer(wall, path)):
        assert joint.free[18:23, 18:23].all()
        assert joint.occupied[23].all()


def test_a_wall_between_two_places_of_a_path_that_are_far_apart_stays():
    seen = hall()
    seen[:, 20] = 100
    path = [(0.4, 1.0), (1.6, 1.0)]
    joint = fused([layer(seen), layer(hall() - 1, path)], APART_M)
    assert joint.occupied[:, 20].all()
