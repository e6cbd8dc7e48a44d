"""A map assembled from published local maps."""

from contextlib import suppress
from itertools import permutations

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.shared import MapReceiver


def patch(x, y, value, size=4, resolution=0.1):
    return GridPatch(GridFrame(x, y, resolution), np.full((size, size), value, dtype=np.int8))


def test_a_window_is_laid_over_the_map_and_the_map_grows():
    receiver = MapReceiver()
    receiver.replace(patch(0.0, 0.0, 0))
    merged = receiver.paste(patch(-0.2, 0.2, 100))
    assert merged.shape == (6, 6)
    assert merged.frame.origin_x == pytest.approx(-0.2)
    assert merged.frame.origin_y == pytest.approx(0.0)
    np.testing.assert_array_equal(merged.cells[0], [-1, -1, 0, 0, 0, 0])
    np.testing.assert_array_equal(merged.cells[5], [100, 100, 100, 100, -1, -1])


def test_the_first_window_is_the_map_and_a_new_map_replaces_all():
    receiver = MapReceiver()
    assert receiver.paste(patch(1.0, 1.0, 0)).shape == (4, 4)
    receiver.replace(patch(0.0, 0.0, 0, size=2))
    assert receiver.patch is not None
    assert receiver.patch.shape == (2, 2)


@pytest.mark.parametrize(('x', 'y'), [(0.0, 5.0), (5.0, 0.0), (0.0, -5.0), (-5.0, 0.0)])
def test_a_window_far_off_in_one_direction_is_refused(x, y):
    receiver = MapReceiver()
    receiver.replace(patch(0.0, 0.0, 0))
    with pytest.raises(InputError, match='expected it on or beside the map'):
        receiver.paste(patch(x, y, 0))


@pytest.mark.parametrize('other', [patch(0.05, 0.0, 0), patch(0.0, 0.0, 0, resolution=0.2)])
def test_a_window_off_the_lattice_is_refused(other):
    receiver = MapReceiver()
    receiver.replace(patch(0.0, 0.0, 0))
    with pytest.raises(InputError, match='lattice'):
        receiver.paste(other)


@pytest.mark.parametrize(('x', 'y'), [(0.01, 0.0), (0.0, 0.01)])
def test_a_window_may_be_less_than_a_hundredth_of_a_cell_off_the_lattice(x, y):
    receiver = MapReceiver()
    receiver.replace(patch(0.0, 0.0, 0, resolution=1.0))
    assert receiver.paste(patch(0.99 * x, 0.99 * y, 0, resolution=1.0)).shape == (4, 4)
    with pytest.raises(InputError, match='lattice'):
        receiver.paste(patch(x, y, 0, resolution=1.0))


def square(value, size=2):
    return np.full((size, size), value, dtype=np.int8)


def test_updates_and_whole_maps_give_the_same_map_in_any_order():
    """Each topic keeps its order, and may overtake the other one."""
    grown = patch(-0.2, 0.0, 50, size=6)
    last = grown.with_part(1, 1, square(60)).with_part(4, 4, square(70))
    whole = [(10, patch(0.0, 0.0, 0)), (30, grown)]
    updates = [(20, 1, 1, square(100)), (40, 1, 1, square(60)), (50, 4, 4, square(70))]
    for turns in set(permutations('wwuuu')):
        receiver = MapReceiver()
        topics = {'w': iter(whole), 'u': iter(updates)}
        for turn in turns:
            message = next(topics[turn])
            if turn == 'w':
                receiver.replace(message[1], message[0])
            else:
                with suppress(InputError):
                    receiver.update(*message)
        assert receiver.patch is not None
        np.testing.assert_array_equal(receiver.patch.cells, last.cells, err_msg=str(turns))


def test_an_update_that_does_not_fit_is_dropped_until_a_whole_map_comes():
    receiver = MapReceiver()
    assert not receiver.update(1, 0, 0, square(100)), 'no map yet'
    receiver.replace(patch(0.0, 0.0, 0), 2)
    with pytest.raises(InputError, match='expected it inside the map'):
        receiver.update(3, 3, 3, square(100))
    assert receiver.patch is not None and not receiver.patch.cells.any()
    receiver.replace(patch(0.0, 0.0, 50, size=6), 3)
    assert (receiver.patch.cells == 50).all()
    assert receiver.update(4, 3, 3, square(100))
    assert (receiver.patch.cells == 100).sum() == 4


def test_updates_from_before_a_clock_that_is_set_back_are_not_made_again():
    receiver = MapReceiver()
    receiver.replace(patch(0.0, 0.0, 0), 100)
    assert receiver.update(110, 0, 0, square(100))
    receiver.replace(patch(0.0, 0.0, 0), 5)
    assert receiver.patch is not None and not receiver.patch.cells.any()
    assert receiver.update(6, 0, 0, square(100))


def test_updates_without_a_stamp_are_made_in_the_order_in_which_they_come():
    receiver = MapReceiver()
    receiver.replace(patch(0.0, 0.0, 0), 100)
    for value in (100, 50):
        assert receiver.update(0, 0, 0, square(value))
    assert receiver.patch is not None
    assert (receiver.patch.cells == 50).sum() == 4
    receiver.replace(patch(0.0, 0.0, 0), 101)
    assert not receiver.patch.cells.any()
