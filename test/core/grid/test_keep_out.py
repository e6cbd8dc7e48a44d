"""Keep-out areas: their cells, where a robot may not be, and how they follow a corrected map."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.edits import (
    MAX_AREAS,
    MAX_CORNERS,
    KeepOut,
    KeepOutArea,
    inside,
    moved_corners,
    touched_cells,
)
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.wavefront import WavefrontConfig, find_path
from thinmap_ros.core.se2 import compose, invert, pose, transform_points

FRAME = GridFrame(-1.0, -2.0, 0.1)
SHAPE = (60, 50)
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
AWAY = pose(3.0, 3.0, 0.0)
numbers = st.floats(-3.0, 5.0).map(lambda number: round(number, 3))
polygons = st.lists(st.tuples(numbers, numbers), min_size=3, max_size=8).map(np.array)


def room():
    """Free cells, 5 x 6 m."""
    return GridPatch(FRAME, np.zeros(SHAPE, dtype=np.int8))


def from_line(points, corners):
    """Distance (N,) of points (N, 2) to the line of a polygon."""
    ends = np.roll(corners, -1, axis=0)
    away = [from_edge(points, a, b) for a, b in zip(corners, ends, strict=True)]
    return np.min(away, axis=0)


def from_edge(points, begin, end):
    """Distance (N,) of points (N, 2) to the line between two points."""
    along = end - begin
    share = (points - begin) @ along / max(float(along @ along), 1e-12)
    return np.hypot(*(points - begin - np.clip(share, 0.0, 1.0)[:, None] * along).T)


@given(polygons)
def test_the_cells_of_a_polygon_are_those_inside_and_on_its_line(corners):
    cells = touched_cells(corners, FRAME, SHAPE)
    centres = FRAME.centres_of(np.argwhere(np.ones(SHAPE, dtype=bool)))
    within = inside(centres, corners).reshape(SHAPE)
    line = from_line(centres, corners).reshape(SHAPE)
    half_m = 0.5 * FRAME.resolution
    near_line = line < 1e-9
    assert (cells | near_line)[within].all()
    assert not (cells & ~within)[line > half_m * (np.sqrt(2.0) + 0.36)].any()
    assert cells[line < 0.6 * half_m].all(), 'a line goes through these'


@pytest.mark.parametrize('angle_deg', [0.0, 30.0, 45.0, 80.0, 90.0, 135.0])
def test_no_way_leads_through_a_wall(angle_deg):
    angle = np.deg2rad(angle_deg)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    middle = np.array([1.5, 1.0])
    wall = middle + 5.0 * np.array([along, -along])
    laid = KeepOut().with_area(wall, is_wall=True).laid_on(room(), AWAY)
    config = WavefrontConfig(robot_radius_m=0.1)
    ends = [tuple((middle + side * 0.8 * across).tolist()) for side in (1.0, -1.0)]
    assert find_path(room(), *ends, config) is not None
    assert find_path(laid, *ends, config) is None


def test_an_area_is_a_wall_on_the_map_and_none_for_a_robot_inside():
    keep_out = KeepOut().with_area(SQUARE, is_wall=False)
    laid = keep_out.laid_on(room(), AWAY)
    assert np.array_equal(laid.occupied, keep_out.cells(FRAME, SHAPE))
    assert laid.is_replaced and not room().occupied.any()
    assert not keep_out.laid_on(room(), AWAY).is_replaced, 'as the last time'
    left = keep_out.laid_on(room(), pose(0.5, 0.5, 0.0))
    assert not left.occupied.any() and left.is_replaced
    again = keep_out.laid_on(room(), AWAY)
    assert np.array_equal(again.occupied, laid.occupied) and again.is_replaced


def test_a_map_without_areas_stays_the_same_object():
    patch = room()
    keep_out = KeepOut()
    keep_out.laid_on(patch, AWAY)
    assert keep_out.laid_on(patch, AWAY) is patch


def test_a_path_leads_around_an_area_and_out_of_it():
    config = WavefrontConfig(robot_radius_m=0.2)
    keep_out = KeepOut().with_area(SQUARE, is_wall=False)
    start = (-0.7, 0.5)
    goal = (2.0, 0.5)
    straight = find_path(room(), start, goal, config)
    around = find_path(keep_out.laid_on(room(), pose(*start, 0.0)), start, goal, config)
    assert inside(straight.points, SQUARE).any()
    assert not inside(around.points, SQUARE).any()
    assert from_line(around.points, SQUARE).min() > 0.15
    out = find_path(keep_out.laid_on(room(), pose(0.5, 0.5, 0.0)), (0.5, 0.5), goal, config)
    assert out is not None


def test_areas_and_walls_that_are_none_are_refused():
    keep_out = KeepOut()
    for corners, is_wall, said in [
        (SQUARE[:2], False, 'of 2 corners: expected 3 to 200'),
        (SQUARE[:1], True, 'of 1 corner: expected 2'),
        (np.tile(SQUARE, (MAX_CORNERS, 1)), False, 'of 800 corners'),
        (SQUARE * np.nan, False, 'nan: expected a number'),
        (SQUARE * 1e7, False, '1e.07: expected|10000000.0: expected'),
        (SQUARE * 300.0, False, 'outline of 1200 m: expected at most 1000 m'),
    ]:
        with pytest.raises(InputError, match=said):
            keep_out.with_area(corners, is_wall)
    with pytest.raises(InputError, match=r'area 3: expected the id of one \(none\)'):
        keep_out.without(3)
    many = KeepOut([KeepOutArea(k + 1, SQUARE) for k in range(MAX_AREAS)])
    with pytest.raises(InputError, match='101 keep-out areas: expected at most 100'):
        many.with_area(SQUARE, is_wall=False)
    far = keep_out.with_area(SQUARE, is_wall=False).with_area(SQUARE + 900.0, is_wall=False)
    with pytest.raises(InputError, match='expected at most 16777216 cells'):
        far.bounds(FRAME)


def test_ids_are_given_once():
    keep_out = KeepOut().with_area(SQUARE, is_wall=False).with_area(SQUARE[:2], is_wall=True)
    assert [str(area) for area in keep_out.areas] == ['keep-out area 1', 'virtual wall 2']
    keep_out = keep_out.without(2).with_area(SQUARE, is_wall=False)
    assert [area.id for area in keep_out.areas] == [1, 3]
    assert not keep_out.without(0).areas and keep_out.without(0).next_id == 4


def test_a_goal_inside_is_told():
    keep_out = KeepOut().with_area(SQUARE, is_wall=False).with_area(SQUARE[:2], is_wall=True)
    keep_out.require_open(np.array([[1.5, 0.5], [0.5, 0.0 - 1e-3]]))
    with pytest.raises(InputError, match=r'0\.50, 0\.25 is in keep-out area 1: expected'):
        keep_out.require_open(np.array([[1.5, 0.5], [0.5, 0.25]]))


@given(st.floats(-3.0, 3.0), st.floats(-2.0, 2.0))
def test_an_area_stays_at_its_place_in_a_corrected_map(turn, shift):
    before = np.array([[0.0, -1.0, 0.2], [9.0, 9.0, 1.0]])
    T = pose(shift, 1.0, turn)
    after = np.array([compose(T, before[0]), before[1]])
    keep_out = KeepOut().with_area(SQUARE, is_wall=False).moved(before, after)
    moved = keep_out.areas[0].corners
    assert moved == pytest.approx(transform_points(T, SQUARE), abs=1e-9)
    assert moved_corners(moved, after, before) == pytest.approx(SQUARE, abs=1e-9)
    assert transform_points(invert(T), moved) == pytest.approx(SQUARE, abs=1e-9)
    nowhere = np.empty((0, 3))
    assert keep_out.moved(nowhere, nowhere) is keep_out
