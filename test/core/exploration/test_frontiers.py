"""Frontiers: incremental detection equals detection in the whole map; hidden area."""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.space import (
    FrontierMap,
    box_of_scan,
    depth_behind_m,
    hidden_area_m2,
)
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.scan import Scan

FRAME = GridFrame(0.0, 0.0, 0.1)
HERE = np.array([[0.5, 1.0], [1.5, 2.0]])
NOWHERE = np.array([[9.0, 9.0], [9.1, 9.1]])


def patch_of(cells, frame=FRAME):
    return GridPatch(frame, cells.astype(np.int8))


def half_known():
    """A walled room of 4 x 3 m, known up to x = 2 m: one frontier, 2.8 m long."""
    cells = np.full((30, 40), -1)
    cells[:, :20] = 0
    cells[[0, -1], :20] = 100
    cells[:, 0] = 100
    return cells


def frontiers_of(cells):
    frontiers = FrontierMap()
    frontiers.update(patch_of(cells), HERE)
    return frontiers


def test_a_frontier_is_where_free_cells_touch_unknown_ones():
    frontiers = frontiers_of(half_known())
    expected = np.zeros((30, 40), dtype=np.bool_)
    expected[1:29, 19] = True
    assert (frontiers.mask == expected).all()
    (cluster,) = frontiers.clusters(0.4)
    assert len(cluster) == frontiers.remaining(cluster) == 28
    assert frontiers.middle_of(cluster) == pytest.approx((1.95, 1.45), abs=0.06)


def test_short_frontiers_are_missing_beams():
    cells = half_known()
    cells[4:, 20] = 100  # leaves a gap of three cells beside the upper wall
    assert frontiers_of(cells).clusters(0.4) == []
    assert len(frontiers_of(cells).clusters(0.3)[0]) == 3


def test_a_speck_between_beams_is_no_frontier():
    cells = half_known()
    cells[10:15, 8:10] = -1
    assert not frontiers_of(cells).mask[5:20, 4:15].any()


def test_what_two_robots_have_changed_is_found_at_once():
    known = np.full((60, 200), -1)
    frontiers = FrontierMap()
    frontiers.update(patch_of(known))
    known[10:30, 5:25] = 0
    known[10:30, 170:190] = 0
    here, there = (np.array([[x, 0.5], [x + 3.0, 3.5]]) for x in (0.2, 16.7))
    frontiers.update(patch_of(known), here, there)
    assert (frontiers.mask == frontiers_of(known).mask).all()
    assert frontiers.free_cells == 800


def test_updates_near_the_robot_equal_detection_in_the_whole_map():
    rng = np.random.default_rng(7)
    world = rng.choice(np.array([0, 0, 0, 0, 100]), size=(80, 90))
    known = np.full(world.shape, -1)
    local = FrontierMap()
    for _ in range(60):
        row = rng.integers(8, 72)
        col = rng.integers(8, 82)
        known[row - 6 : row + 7, col - 6 : col + 7] = world[row - 6 : row + 7, col - 6 : col + 7]
        local.update(patch_of(known), np.array([[col - 10, row - 10], [col + 11, row + 11]]) * 0.1)
        whole = frontiers_of(known)
        assert (local.mask == whole.mask).all()
        assert (local.free == whole.free).all()
        assert local.free_cells == np.count_nonzero(local.free)


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
    frontiers = FrontierMap()
    frontiers.update(patch_of(half_known()), np.array([[0.0, 0.0], [0.1, 0.1]]))
    frontiers.update(patch_of(half_known()), box)
    assert (frontiers.mask == frontiers_of(half_known()).mask).all()


def test_the_whole_map_is_processed_now_and_then():
    frontiers = frontiers_of(half_known())
    corrected = half_known()
    corrected[5:25, 10] = 100
    for _ in range(99):
        frontiers.update(patch_of(corrected), np.array([[3.0, 0.0], [3.5, 0.5]]))
    assert frontiers.free[10, 10]
    frontiers.update(patch_of(corrected), np.array([[3.0, 0.0], [3.5, 0.5]]))
    assert not frontiers.free[10, 10]


def test_a_map_that_grows_on_all_sides_keeps_its_frontiers():
    frontiers = frontiers_of(half_known())
    grown = np.pad(half_known(), ((5, 3), (4, 6)), constant_values=-1)
    frontiers.update(patch_of(grown, FRAME.with_origin_at(-5, -4)), NOWHERE)
    expected = frontiers_of(half_known())
    centres = frontiers.frame.centres_of(np.argwhere(frontiers.mask))
    assert np.allclose(centres, FRAME.centres_of(np.argwhere(expected.mask)))
    assert frontiers.free_cells == expected.free_cells


def test_the_hidden_area_is_what_is_unknown_in_line_of_sight():
    cells = half_known()
    frontiers = frontiers_of(cells)
    place = frontiers.middle_of(np.argwhere(frontiers.mask))
    # A half disc of 1 m, without the walls that are not known yet.
    assert hidden_area_m2(frontiers, place, 1.0) == pytest.approx(0.5 * math.pi, rel=0.15)
    cells[:, 22] = 100
    assert hidden_area_m2(frontiers_of(cells), place, 1.0) < 0.5


@pytest.mark.parametrize('behind', [0, 100])
def test_the_depth_of_the_unknown_ends_at_the_next_known_cell(behind):
    cells = half_known()
    (frontier,) = frontiers_of(cells).clusters(0.4)
    assert depth_behind_m(frontiers_of(cells), frontier) == pytest.approx(1.0), 'nothing is known'
    cells[:, 23:] = behind
    assert depth_behind_m(frontiers_of(cells), frontier) == pytest.approx(0.3)
    cells[:20, 23:] = -1
    assert depth_behind_m(frontiers_of(cells), frontier) == pytest.approx(1.0), 'a doorway counts'


def test_behind_an_oblique_frontier_the_depth_is_that_straight_behind_it():
    cells = np.full((60, 60), -1)
    row, col = np.indices(cells.shape)
    cells[row + col < 50] = 0
    cells[row + col > 57] = 100
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    frontiers = frontiers_of(cells)
    (frontier,) = frontiers.clusters(0.4)
    assert depth_behind_m(frontiers, frontier) == pytest.approx(0.8 / math.sqrt(2.0), abs=0.11)


def test_a_map_that_is_replaced_is_processed_everywhere_and_forgotten_where_it_ends():
    frontiers = frontiers_of(half_known())
    smaller = half_known()[5:, 3:35].copy()
    smaller[20:, 10:16] = 0
    smaller[5:10, 17] = 100
    frame = FRAME.with_origin_at(5, 3)
    frontiers.update(GridPatch(frame, smaller.astype(np.int8), is_replaced=True), NOWHERE)
    expected = FrontierMap()
    expected.update(patch_of(smaller, frame), HERE)
    assert frontiers.frame == expected.frame
    assert (frontiers.free == expected.free).all()
    assert (frontiers.mask == expected.mask).all()
    assert (frontiers.passable == expected.passable).all()
    assert frontiers.free_cells == expected.free_cells == np.count_nonzero(frontiers.free)
