"""Views: windows along the path, as keyframes come, and what they hold."""

from dataclasses import replace

import numpy as np
import pytest
from support.driven_pieces import KEYFRAME_M, driven_piece

from thinmap_ros.core import se2
from thinmap_ros.core.places import views
from thinmap_ros.core.places.views import ViewBuilder, views_of


@pytest.fixture(scope='module')
def frames():
    return driven_piece(1, 1).piece.keyframes


def test_a_view_begins_every_few_metres(frames):
    made = views_of(frames)
    assert [view.number for view in made] == list(range(len(made)))
    apart = np.diff([view.path_m for view in made])
    assert np.all(np.abs(apart - views.SPACING_M) <= 2.0 * KEYFRAME_M)
    length = made[-1].path_m + views.WINDOW_M / 2.0
    assert length == pytest.approx(frames[-1].path_m, abs=views.SPACING_M)


def test_a_view_holds_the_scans_of_its_window(frames):
    for view in views_of(frames)[:-1]:
        first, middle, last = view.frames
        assert first < middle < last
        spread = frames[last].path_m - frames[first].path_m
        assert views.WINDOW_M - 2.0 * KEYFRAME_M <= spread <= views.WINDOW_M + KEYFRAME_M
        np.testing.assert_array_equal(view.T_piece_view, frames[middle].T_map_base)


def test_views_come_as_the_piece_grows(frames):
    builder = ViewBuilder()
    early = [view.number for frame in frames[:20] for view in builder.add(frame)]
    assert early == list(range(len(early)))
    assert len(early) >= 2
    late = [view for frame in frames[20:] for view in builder.add(frame)]
    together = views_of(frames)
    made = len(early) + len(late) + len(builder.finish())
    assert made == len(together)
    for view in late:
        np.testing.assert_array_equal(view.walls, together[view.number].walls)


def test_a_view_does_not_reach_over_a_gap(frames):
    """After known ground, which makes no keyframes, the path continues elsewhere."""
    moved = [
        replace(frame, T_map_base=frame.T_map_base + (50.0, 0.0, 0.0)) for frame in frames[30:]
    ]
    for view in views_of([*frames[:30], *moved]):
        assert (view.frames[0] < 30) == (view.frames[2] < 30)


def test_a_short_path_is_one_view_and_a_few_scans_are_none(frames):
    assert len(views_of(frames[:3])) == 1
    assert views_of(frames[:2]) == []
    assert views_of([]) == []


def test_walls_are_walls_and_free_places_are_free(frames):
    piece = driven_piece(1, 1).piece
    for view in piece.views:
        walls = se2.transform_points(view.T_piece_view, view.walls)
        free = se2.transform_points(view.T_piece_view, view.free)
        cells = piece.patch.frame.cells_of(walls)
        near = [
            piece.patch.occupied[max(r - 2, 0) : r + 3, max(c - 2, 0) : c + 3] for r, c in cells
        ]
        assert np.mean([part.any() for part in near]) > 0.95
        rows, cols = piece.patch.frame.cells_of(free).T
        assert piece.patch.occupied[rows, cols].mean() < 0.05
        assert len(view.free) > len(view.walls)


def test_each_cell_of_the_lattice_has_one_wall_point(frames):
    for view in views_of(frames):
        cells = np.floor(view.walls / views.LATTICE_M).astype(int)
        assert len(np.unique(cells, axis=0)) == len(cells)
