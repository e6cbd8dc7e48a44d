"""Rectangles of cells: their parts, changes and margins."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch, bounds_of


def patch_of(rows, cols, value=0, origin=(0.0, 0.0)):
    return GridPatch(GridFrame(*origin, 0.05), np.full((rows, cols), value, dtype=np.int8))


def test_a_part_is_replaced_and_the_old_map_is_left_alone():
    patch = patch_of(120, 120)
    part = np.full((3, 4), UNKNOWN, dtype=np.int8)
    found = patch.with_part(117, 10, part)
    assert (found.cells[117:, 10:14] == UNKNOWN).all()
    assert (found.cells != patch.cells).sum() == 12
    for row, col in ((118, 10), (0, 117), (-1, 0), (0, -1)):
        with pytest.raises(InputError, match='update of 3 x 4 cells'):
            patch.with_part(row, col, part)


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 8)), max_size=5))
def test_bounds_hold_all_chosen_cells_and_no_line_without_one(cells):
    chosen = np.zeros((7, 9), dtype=np.bool_)
    for cell in cells:
        chosen[cell] = True
    bounds = bounds_of(chosen)
    if not cells:
        assert bounds is None
        return
    row, col, end_row, end_col = bounds
    inside = chosen[row:end_row, col:end_col]
    assert inside.sum() == chosen.sum()
    edges = (inside[0], inside[-1], inside[:, 0], inside[:, -1])
    assert all(edge.any() for edge in edges)


def test_the_changed_part_makes_the_newer_map_of_the_older_one():
    before = patch_of(20, 30)
    after = before.with_part(3, 5, np.full((2, 4), 100, dtype=np.int8))
    bounds = after.changes_since(before)
    assert bounds == (3, 5, 5, 9)
    part = after.part(bounds)
    assert (part.frame.origin_x, part.frame.origin_y) == pytest.approx((0.25, 0.15))
    rebuilt = before.with_part(*before.offset_of(part), part.cells)
    np.testing.assert_array_equal(rebuilt.cells, after.cells)
    assert after.changes_since(after) is None


def test_a_map_is_padded_by_what_hangs_over():
    patch = patch_of(10, 10)
    other = patch_of(10, 10, 100, (-0.1, 0.15))
    margins = patch.overhang_of(other)
    assert margins == (0, 2, 3, 0)
    padded = patch.padded(margins)
    assert padded.shape == (13, 12) and padded.overhang_of(other) == (0, 0, 0, 0)
    assert padded.offset_of(patch) == (0, 2)
    assert (padded.cells == UNKNOWN).sum() == 13 * 12 - 100
    np.testing.assert_array_equal(padded.cells[:10, 2:], patch.cells)
