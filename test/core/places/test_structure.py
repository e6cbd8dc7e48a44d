"""Walls that contradict a place: another storey, and a place that looks like another one."""

import math

import numpy as np
import pytest
from support.driven_pieces import driven_piece
from support.rooms import room
from support.storeys import piece_of, storey

from thinmap_ros.core.grid.moved import MapMotion
from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.places.piece import MapPiece
from thinmap_ros.core.places.place_odds import JOIN_ODDS
from thinmap_ros.core.places.recognition import Recognition, decide, recognize
from thinmap_ros.core.places.structure import structure_evidence
from thinmap_ros.core.topology.graph import TopologicalMap


def fed(query, known):
    recognition = Recognition(known)
    for view in query.views:
        recognition.add(view, query.landmarks.around(view))
    return recognition


@pytest.mark.parametrize('moved_m', [0.7, 1.6])
def test_another_storey_is_not_joined_though_its_views_fit(moved_m):
    known = piece_of(storey())
    query = piece_of(storey(moved_m))
    recognition = fed(query, known)
    decision = decide(recognition, query, known)
    assert decision.placement.log_odds > math.log(JOIN_ODDS) + 20.0
    assert not decision.is_joined
    assert decision.log_odds < 0.0
    assert not recognize(known, query).is_joined


@pytest.mark.parametrize('seed', range(2))
def test_cupboards_that_have_moved_are_no_other_storey(seed):
    known = piece_of(storey(cupboards=6, seed=seed))
    query = piece_of(storey(cupboards=6, seed=seed + 10))
    decision = recognize(query, known)
    assert decision.is_joined
    off = decision.placement.T_map_piece
    assert np.hypot(off[0], off[1]) < 0.2
    assert abs(off[2]) < 0.02


def test_a_place_with_other_walls_is_no_rival():
    known = driven_piece(4, 1).piece
    query = driven_piece(4, 2).piece
    recognition = fed(query, known)
    by_views = recognition.placement()
    rival = recognition.hypotheses[1]
    assert structure_evidence(query, known, rival.motion(recognition.views)) < -10.0
    assert recognition.placement(query).log_odds > by_views.log_odds + 10.0
    assert recognition.placement(query, by_views.log_odds + 100.0).log_odds == by_views.log_odds


def test_rooms_without_any_view_are_compared_as_a_whole():
    known = MapPiece([], room([]), TopologicalMap())
    query = MapPiece([], room([(2.5, 1.2, 2.6, 3.4)]), TopologicalMap())
    assert not query.views
    motion = MapMotion.rigid(np.zeros(3))
    assert structure_evidence(known, known, motion, math.inf) > 0.5
    assert structure_evidence(query, known, motion, math.inf) < 0.0


def test_walls_where_the_other_map_is_unknown_tell_nothing():
    known = piece_of(storey())
    query = piece_of(storey(1.6))
    motion = MapMotion.rigid(np.zeros(3))
    assert structure_evidence(query, known, motion, math.inf) < -20.0
    assert structure_evidence(query, known, motion, 0.0) == 0.0
    unseen = np.where(known.patch.free, UNKNOWN, known.patch.cells)
    walls_only = MapPiece(
        known.keyframes, GridPatch(known.patch.frame, unseen.astype(np.int8)), known.graph
    )
    assert structure_evidence(query, walls_only, motion, math.inf) > 0.0


@pytest.mark.parametrize(
    ('own', 'other', 'moved_m', 'is_joined'),
    [
        ('first', 'first', 1.6, True),
        ('first', 'second', 0.0, False),
        ('first', '', 0.0, True),
        ('first', '', 1.6, False),
    ],
)
def test_the_tags_of_storeys_decide_before_walls(own, other, moved_m, is_joined):
    known = piece_of(storey(), own)
    decision = recognize(piece_of(storey(moved_m), other), known)
    assert decision.is_joined == is_joined
    if own == other:
        assert decision.log_odds > 50.0
