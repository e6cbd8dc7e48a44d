"""Whole maps laid on each other: a copy is found, what is symmetric or foreign is not joined."""

import math

import numpy as np
import pytest
from support.rooms import FLAT, KITCHEN, STUDY, room, turned

from thinmap_ros.core import se2
from thinmap_ros.core.places.alignment import align, fitted
from thinmap_ros.core.places.piece import MapPiece
from thinmap_ros.core.places.place_odds import JOIN_ODDS
from thinmap_ros.core.topology.graph import TopologicalMap

T_KNOWN_QUERY = np.array([1.3, -0.7, 0.65])


def piece(patch):
    return MapPiece([], patch, TopologicalMap())


def query_of(patch):
    """The same map in a frame of its own, which lies at T_KNOWN_QUERY in that of the first."""
    return piece(turned(patch, se2.invert(T_KNOWN_QUERY)))


@pytest.mark.parametrize('boxes', [KITCHEN, STUDY])
def test_a_room_of_ten_square_metres_is_found_again(boxes):
    known = room(boxes)
    query = query_of(known)
    alignment = align(query, piece(known))
    assert alignment.log_odds > math.log(JOIN_ODDS)
    fit = fitted(query, piece(known), alignment.T_known_query)
    off = se2.pose_difference(fit.T_known_query, T_KNOWN_QUERY)
    assert np.hypot(off[0], off[1]) < 0.05
    assert abs(off[2]) < 0.02
    assert off @ np.linalg.solve(fit.covariance, off) < 16.0
    assert fit.found > 0.9
    assert not fit.is_contrary


def test_either_of_two_maps_may_be_the_known_one():
    large = piece(room(KITCHEN, FLAT))
    small = query_of(room(KITCHEN))
    forth = align(small, large)
    back = align(large, small)
    assert back.log_odds == forth.log_odds
    np.testing.assert_allclose(back.T_known_query, se2.invert(forth.T_known_query))


def test_an_empty_room_fits_both_ways_round():
    known = room([])
    alignment = align(query_of(known), piece(known))
    assert alignment.log_odds < 3.0
    turn = se2.wrap(alignment.second[2] - alignment.T_known_query[2])
    assert abs(turn) == pytest.approx(math.pi, abs=0.1)


def test_two_rooms_of_one_size_are_not_one():
    alignment = align(query_of(room(KITCHEN)), piece(room(STUDY)))
    assert alignment.log_odds < math.log(JOIN_ODDS) / 2.0


def test_maps_that_tell_nothing_or_are_large_are_left_to_the_views():
    small = piece(room(KITCHEN))
    large = piece(room([], (60.0, 4.0)))
    solid = turned(room([], (0.2, 0.2)), np.zeros(3))
    assert not solid.free.any()
    assert align(small, large) is None
    assert align(piece(solid), small) is None


@pytest.mark.parametrize('off', [(0.4, -0.3, 0.1), (-0.5, 0.5, -0.1)])
def test_a_rough_pose_is_refined(off):
    known = room(KITCHEN)
    fit = fitted(query_of(known), piece(known), T_KNOWN_QUERY + off)
    np.testing.assert_allclose(fit.T_known_query, T_KNOWN_QUERY, atol=0.03)


def test_a_wrong_pose_contradicts_the_maps():
    known = room(KITCHEN)
    wrong = se2.compose(T_KNOWN_QUERY, np.array([0.3, 1.5, 0.8]))
    assert fitted(query_of(known), piece(known), wrong).is_contrary
