"""Pieces of one building are joined, right, and those of two are not; and why."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.driven_pieces import driven_piece, true_transform

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.places.piece import MapPiece, landmarks_around
from thinmap_ros.core.places.place_odds import JOIN_ODDS
from thinmap_ros.core.places.recognition import Recognition, ViewJudge, decide, recognize
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build

BUILDINGS = range(1, 7)


def fed(query, known, count=None):
    recognition = Recognition(known)
    for view in query.views[:count]:
        recognition.add(view, query.landmarks.around(view))
    return recognition


@pytest.mark.parametrize('building', BUILDINGS)
def test_two_drives_through_a_building_are_joined_right(building):
    known = driven_piece(building, 1)
    query = driven_piece(building, 2)
    decision = recognize(query.piece, known.piece)
    assert decision.is_joined
    assert decision.log_odds > math.log(JOIN_ODDS)
    off = se2.between(true_transform(known, query), decision.placement.T_map_piece)
    assert np.hypot(off[0], off[1]) < 0.15
    assert abs(off[2]) < 0.01
    assert off @ np.linalg.solve(decision.placement.covariance, off) < 16.0


@pytest.mark.parametrize('building', BUILDINGS)
def test_drives_through_two_buildings_are_not_joined(building):
    known = driven_piece(building, 1).piece
    query = driven_piece(building + 10, 1).piece
    for one, other in ((known, query), (query, known)):
        decision = recognize(one, other)
        assert not decision.is_joined
        assert decision.views == len(one.views)
        assert decision.log_odds < 3.0


def test_odds_grow_with_the_path_and_a_few_metres_are_not_enough():
    known = driven_piece(1, 1).piece
    query = driven_piece(1, 2).piece
    odds = [fed(query, known, count).placement() for count in (2, 5, 8)]
    logs = [-math.inf if each is None else each.log_odds for each in odds]
    assert logs == sorted(logs)
    assert logs[0] < 0.0 < logs[-1]


def test_the_join_odds_decide():
    known = driven_piece(2, 1).piece
    query = driven_piece(2, 2).piece
    recognition = fed(query, known, 7)
    log_odds = recognition.placement().log_odds
    assert decide(recognition, query, known, math.exp(log_odds - 0.1)).is_joined
    assert not decide(recognition, query, known, math.exp(log_odds + 0.1)).is_joined


def test_views_may_be_fed_as_the_piece_grows():
    """With the landmarks of the graph of the moment; what comes later does not matter."""
    known = driven_piece(1, 1).piece
    query = driven_piece(1, 2).piece
    recognition = Recognition(known)
    for view in query.views[:9]:
        recognition.add(view, landmarks_around(query.graph, view))
    assert decide(recognition, query, known).is_joined


def test_both_maps_must_be_sure():
    """The map fits into the piece no more: its rooms were seen to be solid."""
    known = driven_piece(1, 1).piece
    query = driven_piece(1, 2).piece
    recognition = fed(query, known)
    assert decide(recognition, query, known).is_joined
    cells = np.where(query.patch.free, 100, query.patch.cells).astype(np.int8)
    solid = MapPiece(query.keyframes, GridPatch(query.patch.frame, cells), query.graph)
    decision = decide(recognition, solid, known)
    assert decision.placement.log_odds > math.log(JOIN_ODDS)
    assert not decision.is_joined
    assert decision.log_odds < decision.placement.log_odds


def test_a_map_in_which_a_view_fits_everywhere_is_no_evidence():
    """Among pillars 40 cm apart, walls are found again at any place."""
    cells = np.zeros((300, 300), dtype=np.int8)
    cells[::4, ::4] = 100
    query = driven_piece(1, 1).piece
    pillars = MapPiece([], GridPatch(query.patch.frame, cells), query.graph)
    judge = ViewJudge(pillars, np.random.default_rng(0))
    own = ViewJudge(query, np.random.default_rng(0))
    for view in (replace(view, free=np.empty((0, 2))) for view in query.views):
        rough, fits = pillars.field.refined_widely(
            view, pillars.field.random_poses(40, np.random.default_rng(view.number))
        )
        evidence = judge.evidence(view, rough[int(fits.argmax())])
        assert evidence.found > 0.6
        assert evidence.log_ratio < 3.0
        assert own.evidence(view, view.T_piece_view).log_ratio > 4.0


def test_a_map_that_bends_is_followed():
    """The pieces drift apart by more than a view tolerates: each view has a pose of its own."""
    known = driven_piece(1, 1)
    query = driven_piece(1, 2, drift=0.02)
    recognition = fed(query.piece, known.piece)
    hypothesis = recognition.placement().hypothesis
    assert recognition.placement().log_odds > math.log(JOIN_ODDS)
    offsets = [
        se2.compose(T, se2.invert(query.piece.views[k].T_piece_view))
        for k, T in hypothesis.poses.items()
    ]
    assert len(offsets) == len(query.piece.views)
    assert np.hypot(*np.ptp(np.array(offsets)[:, :2], axis=0)) > 0.8


def test_a_map_without_landmarks_or_free_space_is_no_place():
    query = driven_piece(1, 2).piece
    patch = GridPatch(query.patch.frame, np.full((50, 50), -1, dtype=np.int8))
    empty = MapPiece([], patch, build(patch, None, TopologyConfig()))
    for one, other in ((query, empty), (empty, query)):
        decision = recognize(one, other)
        assert not decision.is_joined
        assert decision.placement is None
        assert decision.log_odds == -math.inf


def test_the_same_pieces_give_the_same_decision():
    pair = (driven_piece(2, 2).piece, driven_piece(2, 1).piece)
    first, second = (recognize(*pair) for _ in range(2))
    assert first.log_odds == second.log_odds
    np.testing.assert_array_equal(first.placement.T_map_piece, second.placement.T_map_piece)
