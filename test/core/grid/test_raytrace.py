"""The traversal compared with geometry computed by hand."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from reference_grid import crossed

from thinmap_ros.core.grid.raytrace import cast_rays, fill_segment, line_is_clear


def room(rows=40, cols=60):
    occupied = np.zeros((rows, cols), dtype=np.uint8)
    occupied[0] = 1
    occupied[-1] = 1
    occupied[:, 0] = 1
    occupied[:, -1] = 1
    return occupied


def distance_to_box(x, y, angle, left, bottom, right, top):
    """Intersection of a ray from inside a box with its boundary, by the plain formula."""
    cos = math.cos(angle)
    sin = math.sin(angle)
    along_x = (right - x) / cos if cos > 0 else (left - x) / cos if cos < 0 else math.inf
    along_y = (top - y) / sin if sin > 0 else (bottom - y) / sin if sin < 0 else math.inf
    return min(along_x, along_y)


@given(st.floats(1.5, 58.5), st.floats(1.5, 38.5), st.floats(-math.pi, math.pi))
def test_rays_in_a_room_hit_its_walls_at_the_exact_ranges(x, y, angle):
    (found,) = cast_rays(room(), x, y, np.array([angle]), 100.0)
    assert math.isclose(
        found, distance_to_box(x, y, angle, 1, 1, 59, 39), rel_tol=1e-9, abs_tol=1e-7
    )


def test_a_ray_ends_at_its_range_and_at_the_rim_of_the_map():
    empty = np.zeros((10, 10), dtype=np.uint8)
    assert np.isinf(cast_rays(empty, 5.0, 5.0, np.array([0.0, 2.0]), 100.0)).all()
    assert np.isinf(cast_rays(room(), 30.5, 20.5, np.array([0.0]), 28.0)).all()
    assert cast_rays(room(), 30.5, 20.5, np.array([0.0]), 29.0)[0] == 28.5


def test_a_ray_from_within_a_wall_has_length_zero():
    assert cast_rays(room(), 0.5, 5.5, np.array([0.3]), 10.0)[0] == 0.0


cells = st.tuples(st.integers(0, 19), st.integers(0, 19))


@given(st.integers(0, 2**32 - 1), cells, cells)
def test_a_line_is_clear_just_where_finely_sampled_points_on_it_are(seed, a, b):
    free = np.random.default_rng(seed).random((20, 20)) > 0.1
    points = np.linspace(np.add(a, 0.5), np.add(b, 0.5), 2003)
    off_lattice = np.abs(points - np.round(points))
    # A point on a boundary belongs to either cell; through a corner the line visits one of two
    # cells.
    inside = off_lattice.min(axis=1) > 1e-6
    through_corner = bool((off_lattice.max(axis=1) < 0.01).any())
    sampled = all(free[int(r), int(c)] for r, c in points[inside])
    found = line_is_clear(free, *a, *b)
    assert found == sampled or (through_corner and sampled)


def test_a_line_is_blocked_by_a_wall_and_by_the_rim():
    free = np.ones((9, 9), dtype=np.bool_)
    assert line_is_clear(free, 0, 0, 8, 5)
    free[:, 4] = False
    assert not line_is_clear(free, 2, 0, 3, 8)
    assert line_is_clear(free, 0, 0, 8, 3)
    assert not line_is_clear(free, 2, 2, 2, 9)


places = st.tuples(st.floats(1.0, 18.99), st.floats(1.0, 23.99))


@given(places, places)
def test_a_filled_segment_joins_its_ends_through_the_cells_that_it_crosses(start, end):
    sheet = np.zeros((25, 20), dtype=np.int16)
    fill_segment(sheet.ravel(), 20, start, end, 7)
    filled = {tuple(cell) for cell in np.argwhere(sheet == 7).tolist()}
    ends = [(math.floor(y), math.floor(x)) for x, y in (start, end)]
    assert filled.issuperset(ends)
    assert len(filled) == np.count_nonzero(sheet)
    # Cells that differ are cut by less than the rounding error: the segment passes their
    # corners.
    for row, col in filled ^ crossed(start, end).union(ends):
        assert distance_to_segment(col, row, start, end) < 1e-6


def distance_to_segment(col, row, start, end):
    """Smallest distance of a cell's corners from a segment, in cells."""
    corners = np.array(
        [[col, row], [col + 1, row], [col, row + 1], [col + 1, row + 1]], dtype=float
    )
    along = np.subtract(end, start)
    share = np.clip((corners - start) @ along / max(along @ along, 1e-300), 0.0, 1.0)
    return np.linalg.norm(corners - start - share[:, None] * along, axis=1).min()
