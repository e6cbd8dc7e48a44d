"""Walls of a map as they are drawn."""

import numpy as np
import pytest

from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.view.wall_lines import block_maximum, drawn_cells, reduced, reduction

VALUES = {'?': -1, '.': 0, '#': 100}


def drawn(*rows, resolution=0.1):
    cells = np.array([[VALUES[letter] for letter in row] for row in rows], dtype=np.int8)
    free, occupied = drawn_cells(GridPatch(GridFrame(0.0, 0.0, resolution), cells))
    assert not (free & occupied).any()
    letters = np.full(cells.shape, '?')
    letters[free] = '.'
    letters[occupied] = '#'
    return [''.join(row) for row in letters]


def test_cells_behind_the_face_of_a_wall_are_left_out():
    assert drawn('?##..', '?##..', '??#..') == ['??#..', '??#..', '??#..']


def test_a_wall_at_the_edge_of_the_map_is_one_line():
    assert drawn('##..', '##..') == ['?#..', '?#..']


def test_corners_of_a_room_stay_closed():
    room = ['?????', '?####', '?####', '?##..', '?##..']
    assert drawn(*room) == ['?????', '?????', '??###', '??#..', '??#..']


def test_the_inside_of_a_wall_is_solid():
    assert drawn(*3 * ['.#???#.']) == 3 * ['.#####.']


@pytest.mark.parametrize(('unknown', 'is_solid'), [(5, True), (6, False)])
def test_unknown_space_of_more_than_half_a_metre_stays(unknown, is_solid):
    (row,) = drawn('.#' + unknown * '?' + '#.')
    assert row == '.#' + unknown * ('#' if is_solid else '?') + '#.'


def test_a_gap_in_front_of_a_wall_is_free():
    assert drawn(*3 * ['..?#.']) == 3 * ['...#.']


def test_walls_seen_from_both_sides_and_free_cells_stay():
    rows = ['...#..', '...##.', '...#..']
    assert drawn(*rows) == rows


def test_a_frontier_is_not_closed():
    rows = 3 * ['...???']
    assert drawn(*rows) == rows


def test_thick_known_walls_keep_their_inside():
    rows = 5 * ['.' + 8 * '#' + '.']
    assert drawn(*rows) == rows


def test_a_large_map_is_reduced_so_that_walls_stay():
    assert reduction((10, 1100)) == 1
    assert reduction((10, 1101)) == 2
    cells = drawn_cells(
        GridPatch(GridFrame(0.0, 0.0, 0.1), np.array([[0, 0, 0, 0, 100]] * 3, dtype=np.int8))
    )
    free, occupied = reduced(cells, 2)
    assert free.tolist() == [[True, True, False]] * 2
    assert occupied.tolist() == [[False, False, True]] * 2
    assert block_maximum(np.arange(6).reshape(2, 3), 2).tolist() == [[4, 5]]
