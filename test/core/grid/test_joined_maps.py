"""Maps of other robots in the map of one, at the places where they are known to lie."""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.shared import JoinedMaps, TileMessage, TileSender

FRAME = GridFrame(0.0, 0.0, 0.1)
QUARTER = se2.pose(5.0, 1.0, math.pi / 2)


def own_map():
    """A map of 2 x 2 m whose right half is unknown."""
    cells = np.zeros((20, 20), dtype=np.int8)
    cells[:, 10:] = -1
    return GridPatch(FRAME, cells)


def other_map(fill=0):
    return GridPatch(GridFrame(0.03, 0.07, 0.1), np.full((20, 30), fill, dtype=np.int8))


class Sender:
    def __init__(self, patch):
        self.tiles = TileSender(patch.frame)
        self.tiles.update(patch)

    def since(self, version=0):
        return self.tiles.changes_after(version)


def known_m2(patch):
    return float(np.count_nonzero(patch.cells >= 0)) * patch.frame.resolution**2


def test_without_others_the_map_is_the_same_object():
    own = own_map()
    assert JoinedMaps().completed(own) is own


def test_a_map_counts_once_its_place_is_known():
    joined = JoinedMaps()
    own = own_map()
    assert joined.add('b', 1, Sender(other_map()).since()) is None
    assert joined.completed(own) is own
    joined.is_moved = False
    joined.place({'b': QUARTER})
    completed = joined.completed(own)
    assert joined.is_moved
    # The other map lies at x 3 to 5, y 1 to 4, beyond this one.
    assert known_m2(completed) == pytest.approx(2.0 + 6.0, abs=0.3)
    row, col = completed.frame.cells_of(np.array([[4.0, 3.5]]))[0]
    assert completed.cells[row, col] == 0
    assert joined.completed(own) is completed
    joined.is_moved = False
    joined.place({})
    assert joined.completed(own) is own
    assert joined.is_moved


def test_known_cells_stay_and_changes_are_told_in_the_own_map():
    joined = JoinedMaps()
    joined.place({'b': QUARTER})
    own = own_map()
    sender = Sender(other_map())
    joined.add('b', 1, sender.since())
    joined.completed(own)
    joined.take_changes()
    joined.is_moved = False
    wall = other_map()
    wall.cells[:16, :16] = 100
    sender.tiles.update(wall)
    joined.add('b', 1, sender.since(1))
    assert joined.completed(own).occupied.any()
    assert not joined.is_moved
    (box,) = joined.take_changes()
    # Of the one tile that has changed, from (0.03, 0.07) m to 1.6 m on.
    assert box == pytest.approx(np.array([[5.0 - 1.67, 1.03], [5.0 - 0.07, 2.63]]))
    assert joined.take_changes() == []


def test_missing_tiles_are_named_and_another_session_is_another_map():
    joined = JoinedMaps()
    joined.place({'b': se2.pose(2.0, 0.0, 0.0)})
    sender = Sender(other_map())
    sender.tiles.update(other_map(fill=100))
    assert joined.add('b', 1, sender.since(1)) == 0
    assert joined.add('b', 1, sender.since()) is None
    assert joined.completed(own_map()).occupied.sum() == pytest.approx(600, abs=60)
    joined.add('b', 2, Sender(other_map()).since())
    assert not joined.completed(own_map()).occupied.any()


def test_a_place_that_moves_by_less_than_a_cell_changes_nothing():
    joined = JoinedMaps()
    joined.place({'b': QUARTER})
    joined.add('b', 1, Sender(other_map()).since())
    own = own_map()
    first = joined.completed(own)
    joined.is_moved = False
    joined.place({'b': QUARTER + (0.02, 0.0, 0.005)})
    assert joined.completed(own) is first
    joined.place({'b': QUARTER + (0.0, 0.0, 0.05)})
    assert joined.is_moved
    assert joined.completed(own) is not first


def test_tiles_far_apart_are_refused_and_nothing_is_lost():
    joined = JoinedMaps()
    joined.place({'b': se2.pose(2.0, 0.0, 0.0)})
    joined.add('b', 1, Sender(other_map()).since())
    own = own_map()
    before = known_m2(joined.completed(own))
    frame = other_map().frame
    far = TileMessage(1, 2, frame, {(1 << 20, -(1 << 20)): bytes(64), (0, 0): bytes(64)})
    with pytest.raises(InputError, match=r'expected [0-9]+ at most'):
        joined.add('b', 1, far)
    assert known_m2(joined.completed(own)) == before
