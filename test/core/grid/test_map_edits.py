"""Erased parts of a map stay erased when it is rendered again, and edits can be saved."""

import numpy as np
import pytest
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.correction import CorrectableGrid
from thinmap_ros.core.grid.edits import (
    MAX_ERASURES,
    Erasures,
    KeepOut,
    MapEdits,
    split_edits,
    touched_cells,
)
from thinmap_ros.core.grid.mapper import Mapper
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.grid.patch import UNKNOWN
from thinmap_ros.core.stage import Destination, LocalizedScan, Trajectory

POSES = [se2.pose(2.0 + 0.3 * k, 2.0, 0.0) for k in range(8)]
SCANS = [scan_in(ROOM, T, None, k + 1) for k, T in enumerate(POSES)]
# Off the edges of cells, as well after it has moved.
PART = np.array([[3.03, 1.53], [3.97, 1.53], [3.97, 2.47], [3.03, 2.47]])
SHIFT = np.array([0.0, 0.4, 0.0])


def within(patch, corners):
    return touched_cells(corners, patch.frame, patch.shape)


def part_of(grid):
    """Cells of the part, in a window that holds it."""
    window = grid.window(3.5, 2.0, 1.6)
    return window.cells[within(window, PART)]


def add(mapper, numbers, shift=(0.0, 0.0, 0.0), trajectory=None):
    for k in numbers:
        mapper.step(LocalizedScan(SCANS[k], POSES[k] + shift, Destination.MAP, trajectory))
        trajectory = None


def known_in(mapper, corners):
    """How many cells of a polygon are known, and how many it has."""
    patch = mapper.whole_map().patch
    cells = within(patch, corners)
    return np.count_nonzero(patch.cells[cells] != UNKNOWN), np.count_nonzero(cells)


def test_an_erased_part_is_unknown_and_nothing_else_changes():
    mapper = Mapper()
    add(mapper, range(4))
    before = mapper.whole_map().patch
    known, count = known_in(mapper, PART)
    assert known == count
    mapper.erase(PART, 4)
    after = mapper.whole_map().patch
    assert known_in(mapper, PART) == (0, count) and before is not after
    outside = ~within(before, PART)
    np.testing.assert_array_equal(after.cells[outside], before.cells[outside])
    add(mapper, [4])
    assert known_in(mapper, PART)[0] > 0.8 * count, 'the laser shows it again'


def test_what_was_erased_does_not_come_back_with_a_correction_and_moves_with_the_map():
    mapper = Mapper()
    add(mapper, range(4), SHIFT)
    mapper.erase(PART + SHIFT[:2], 4)
    assert mapper.correct(Trajectory(np.arange(1, 5), np.array(POSES[:4]), 5))
    mapper.finish()
    known, count = known_in(mapper, PART)
    assert known == 0
    assert known_in(mapper, PART + [0.0, 1.2])[0] > 0.9 * count, 'beside it all is known'
    assert mapper.edits.erasures.items[0].corners == pytest.approx(PART)


def test_a_correction_keeps_what_was_seen_since():
    """It equals a map in which the scans from before had never seen the part."""
    mapper = Mapper()
    add(mapper, range(4), SHIFT)
    mapper.erase(PART + SHIFT[:2], 4)
    add(mapper, range(4, 8), SHIFT)
    assert mapper.correct(Trajectory(np.arange(1, 9), np.array(POSES), 9))
    mapper.finish()
    patch = mapper.whole_map().patch
    fresh = Mapper()
    add(fresh, range(4, 8))
    np.testing.assert_array_equal(part_of(mapper.grid.shown), part_of(fresh.grid.shown))
    cells = within(patch, PART)
    whole = Mapper()
    add(whole, range(8))
    np.testing.assert_array_equal(patch.cells[~cells], whole.whole_map().patch.cells[~cells])


def test_a_correction_in_progress_is_completed_before_a_part_is_erased():
    mapper = Mapper()
    add(mapper, range(4), SHIFT)
    mapper.correct(Trajectory(np.arange(1, 5), np.array(POSES[:4]), 5))
    mapper.erase(PART, 4)
    assert not mapper.grid.is_rerendering and known_in(mapper, PART)[0] == 0


def test_keep_out_areas_move_with_the_map_once():
    mapper = Mapper()
    mapper.keep_out = KeepOut().with_area(PART + SHIFT[:2], is_wall=False)
    add(mapper, range(4), SHIFT)
    mapper.correct(Trajectory(np.arange(1, 5), np.array(POSES[:4]), 5))
    assert mapper.keep_out.areas[0].corners == pytest.approx(PART + SHIFT[:2])
    mapper.finish()
    add(mapper, range(4, 8))
    mapper.finish()
    assert mapper.keep_out.areas[0].corners == pytest.approx(PART)


def test_a_part_far_away_is_erased_without_cost_or_trace():
    mapper = Mapper()
    add(mapper, range(4))
    before = mapper.whole_map().patch
    mapper.erase(PART + 500.0, 4)
    np.testing.assert_array_equal(mapper.whole_map().patch.cells, before.cells)
    assert len(mapper.grid.shown.tiles()) < 100
    empty = Mapper()
    empty.erase(PART, 0)
    assert empty.whole_map().patch.shape == (1, 1)


def test_too_many_or_no_parts_are_refused():
    mapper = Mapper()
    with pytest.raises(InputError, match='part to erase of 2 corners: expected 3 to 200'):
        mapper.erase(PART[:2], 1)
    for _ in range(MAX_ERASURES):
        mapper.erase(PART, 1)
    with pytest.raises(InputError, match='map with 200 erased parts: expected no more'):
        mapper.erase(PART, 1)


def edited():
    keep_out = KeepOut().with_area(PART, is_wall=False).with_area(PART[:2], is_wall=True)
    erasures = Erasures()
    erasures.add(PART + 1.0, 7)
    return MapEdits(keep_out.without(1), erasures)


def test_edits_are_saved_and_restored():
    mapper = Mapper()
    add(mapper, range(4))
    edits = edited()
    mapper.replace(CorrectableGrid(mapper.grid.shown, erasures=edits.erasures), edits.keep_out)
    other = Mapper()
    other.restore(mapper.state())
    area = other.keep_out.areas[0]
    assert (area.id, area.is_wall, other.keep_out.next_id) == (2, True, 3)
    assert area.corners == pytest.approx(PART[:2])
    assert other.edits.erasures.items[0].stamp_ns == 7
    assert other.edits.erasures.items[0].corners == pytest.approx(PART + 1.0)
    # As earlier versions saved it.
    other.restore(mapper.grid.shown.state())
    assert not other.edits


def test_scans_of_an_earlier_session_are_from_before_or_after_by_their_stamps():
    erasures = Erasures()
    erasures.add(PART, 4)
    scans = list(zip(SCANS, POSES, strict=True))
    grid = CorrectableGrid(OccupancyGrid(), scans=scans, erasures=erasures)
    grid.apply_correction(np.arange(1, 9), np.array(POSES), 9)
    grid.finish()
    fresh = Mapper()
    add(fresh, range(4, 8))
    np.testing.assert_array_equal(part_of(grid.shown), part_of(fresh.grid.shown))


@pytest.mark.parametrize(
    ('name', 'value', 'said'),
    [
        ('keep_out', [[1, 0, 4], [1, 0, 4]], 'keep_out: 1 occurs twice'),
        ('keep_out', [[2, 1, 1]], 'keep_out_xy: expected 1 corners'),
        ('keep_out', [[9, 1, 2]], 'ids below next_id'),
        ('keep_out', [[2, 0, 2]], 'keep-out area of 2 corners'),
        ('erased', [[7, 3]], 'erased_xy: expected 3 corners'),
    ],
)
def test_damaged_edits_are_refused(name, value, said):
    state = {**edited().state(), name: np.array(value)}
    with pytest.raises(InputError, match=f'saved edits: .*{said}'):
        split_edits(state)
