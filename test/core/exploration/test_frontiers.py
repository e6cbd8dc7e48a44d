"""Frontiers.

Incremental detection equals detection in the whole map; assignment, observation, exhaustion.
"""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.field_of_view import box_of_scan
from thinmap_ros.core.exploration.frontiers import OpenBorders
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan

FRAME = GridFrame(0.0, 0.0, 0.1)
HERE = np.array([[0.5, 1.0], [1.5, 2.0]])
ALL_ROUND = np.array([0.0, 2.0 * math.pi])


def patch_of(cells, frame=FRAME):
    return GridPatch(frame, cells.astype(np.int8))


def half_known():
    """A walled room of 4 x 3 m, known up to x = 2 m: one frontier, 2.8 m long."""
    cells = np.full((30, 40), -1)
    cells[:, :20] = 0
    cells[[0, -1], :20] = 100
    cells[:, 0] = 100
    return cells


def borders_of(cells, shortest_m=0.4):
    borders = OpenBorders(shortest_m)
    borders.update(patch_of(cells), HERE)
    return borders


def test_the_border_is_where_free_cells_touch_unknown_ones():
    borders = borders_of(half_known())
    expected = np.zeros((30, 40), dtype=np.bool_)
    expected[1:29, 19] = True
    assert (borders.mask == expected).all()
    cells, numbers, count = borders.stretches()
    assert (len(cells), count, set(numbers)) == (28, 1, {0})


def test_short_borders_are_missing_beams():
    cells = half_known()
    cells[4:, 20] = 100  # leaves a gap of three cells beside the upper wall
    assert len(borders_of(cells).stretches()[0]) == 0
    assert len(borders_of(cells, shortest_m=0.3).stretches()[0]) == 3


def test_a_speck_between_beams_is_no_border():
    cells = half_known()
    cells[10:15, 8:10] = -1
    assert not borders_of(cells).mask[5:20, 4:15].any()


def test_updates_near_the_robot_give_what_a_new_look_at_the_whole_map_gives():
    rng = np.random.default_rng(7)
    world = rng.choice(np.array([0, 0, 0, 0, 100]), size=(80, 90))
    known = np.full(world.shape, -1)
    local = OpenBorders(0.4)
    for _ in range(60):
        row = rng.integers(8, 72)
        col = rng.integers(8, 82)
        known[row - 6 : row + 7, col - 6 : col + 7] = world[row - 6 : row + 7, col - 6 : col + 7]
        local.update(patch_of(known), np.array([[col - 10, row - 10], [col + 11, row + 11]]) * 0.1)
        whole = borders_of(known)
        assert (local.mask == whole.mask).all()
        assert (local.free == whole.free).all()
        assert local.known_cells == np.count_nonzero(local.free)


def test_what_a_scan_can_have_changed_lies_in_its_box():
    ranges = np.array([2.0, 3.0, np.inf, np.nan, 1.0])
    scan = Scan.create(0, ranges, -0.5 * math.pi, 0.25 * math.pi, 0.05, 8.0)
    low, high = box_of_scan(scan, se2.pose(10.0, 20.0, 0.0))
    assert low.tolist() == pytest.approx([9.5, 20.0 - 3.0 / math.sqrt(2.0) - 0.5], abs=1e-6)
    assert high.tolist() == pytest.approx([18.5, 21.5], abs=1e-6)


@pytest.mark.parametrize('heading', [0.0, 0.5 * math.pi, 1.0])
def test_a_laser_whose_range_has_no_end_may_have_changed_all_that_there_is(heading):
    scan = Scan.create(0, np.full(181, np.inf), -0.5 * math.pi, math.pi / 180.0, 0.05, np.inf)
    box = box_of_scan(scan, se2.pose(1.0, 1.0, heading))
    assert np.isfinite(box).all()
    borders = OpenBorders(0.4)
    borders.update(patch_of(half_known()), np.array([[0.0, 0.0], [0.1, 0.1]]))
    borders.update(patch_of(half_known()), box)
    assert (borders.mask == borders_of(half_known()).mask).all()


def test_now_and_then_the_whole_map_is_looked_at_again():
    borders = borders_of(half_known())
    corrected = half_known()
    corrected[5:25, 10] = 100
    for _ in range(99):
        borders.update(patch_of(corrected), np.array([[3.0, 0.0], [3.5, 0.5]]))
    assert borders.free[10, 10]
    borders.update(patch_of(corrected), np.array([[3.0, 0.0], [3.5, 0.5]]))
    assert not borders.free[10, 10]


def test_a_map_that_grows_on_all_sides_keeps_what_was_exhausted():
    borders = borders_of(half_known())
    gone = np.argwhere(borders.mask)[:10]
    borders.exhaust(gone, (1.95, 0.15))
    grown = np.pad(half_known(), ((5, 3), (4, 6)), constant_values=-1)
    borders.update(patch_of(grown, FRAME.with_origin_at(-5, -4)), HERE)
    moved = gone + np.round((FRAME.as_array() - borders.frame.as_array())[1::-1] / 0.1).astype(int)
    assert not borders.mask[moved[:, 0], moved[:, 1]].any()
    assert borders.mask.sum() == 18


def test_each_border_cell_belongs_to_the_nearest_node_in_sight():
    cells = half_known()
    cells[15, 5:20] = 100
    borders = borders_of(cells)
    nodes = np.array([[8, 17], [22, 17]])
    found, _, _ = borders.stretches()
    owners = borders.owners(found, nodes, 3.0)
    assert (owners == (found[:, 0] > 15)).all()
    # The nearer one behind the wall does not count, and neither does one that is too far.
    behind = borders.owners(found, nodes[:1], 3.0)
    assert set(behind[found[:, 0] > 15]) == {-1}
    assert (borders.owners(found, nodes, 0.25) == -1).sum() > 0


def test_the_place_to_look_from_can_be_stood_on_and_is_near_the_border():
    borders = borders_of(half_known())
    found, _, _ = borders.stretches()
    allowed = np.zeros_like(borders.free)
    allowed[3:27, 3:17] = True
    place = borders.place_to_look(found, allowed, 3.0, (1.0, 2.0))
    assert place is not None
    row, col = FRAME.cells_of(place[None])[0]
    assert allowed[row, col]
    # Nearly the shortest path from the frontier; among such places the nearest to the robot.
    assert 1.0 < place[0] < 1.65
    assert abs(place[1] - 2.0) < 0.1
    assert borders.place_to_look(found, allowed, 0.1, (1.0, 2.0)) is None


def test_three_close_looks_in_plain_sight_exhaust_a_border():
    borders = borders_of(half_known())
    for look in range(3):
        assert borders.mask[15, 19], look
        borders.examine((1.5, 1.5), 1.0, ALL_ROUND)
    assert not borders.mask[12:19, 19].any()
    beyond = np.hypot(np.arange(30) - 15.0, 4.0) > 10.0
    assert borders.mask[1:29, 19][beyond[1:29]].all()


@pytest.mark.parametrize('hidden', [True, False])
def test_looking_elsewhere_or_past_a_wall_is_no_look(hidden):
    cells = half_known()
    if hidden:
        cells[:, 17] = 100
    borders = borders_of(cells)
    before = borders.mask.copy()
    away = np.array([0.5 * math.pi + 0.3, 1.5 * math.pi - 0.3])
    for _ in range(5):
        borders.examine((1.5, 1.5), 2.0, ALL_ROUND if hidden else away)
    assert (borders.mask == before).all()


def test_a_long_border_is_given_up_in_part_only():
    borders = borders_of(half_known())
    borders.exhaust(np.argwhere(borders.mask), (1.55, 0.55))
    left = np.flatnonzero(borders.mask[:, 19])
    assert left.min() == pytest.approx(5 + 13, abs=2)
    assert left.max() == 28


def test_a_map_that_is_replaced_is_processed_everywhere_and_forgotten_where_it_ends():
    borders = borders_of(half_known())
    smaller = half_known()[5:, 3:35].copy()
    smaller[20:, 10:16] = 0
    smaller[5:10, 17] = 100
    frame = FRAME.with_origin_at(5, 3)
    nowhere = np.array([[9.0, 9.0], [9.1, 9.1]])
    borders.update(GridPatch(frame, smaller.astype(np.int8), is_replaced=True), nowhere)
    expected = OpenBorders(0.4)
    expected.update(patch_of(smaller, frame), HERE)
    at = (slice(5, 30), slice(3, 35))
    assert (borders.free[at] == expected.free).all()
    assert (borders.mask[at] == expected.mask).all()
    assert borders.known_cells == expected.known_cells
    outside = np.ones(borders.free.shape, dtype=np.bool_)
    outside[at] = False
    assert not borders.free[outside].any()
    assert not borders.mask[outside].any()
    assert borders.passable[outside].all()
    revision = borders.revision
    borders.update(GridPatch(frame, smaller.astype(np.int8), is_replaced=True), nowhere)
    assert borders.revision == revision
