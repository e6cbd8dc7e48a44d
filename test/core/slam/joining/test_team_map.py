"""The maps of several robots: which are searched, which are joined, and the map of all."""

from dataclasses import replace

import numpy as np
import pytest
from support.driven_pieces import driven_piece, true_transform

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.slam.joining import team as team_map
from thinmap_ros.core.slam.joining.team import WORLD, LinkSearch, RobotMap, Team, merged

ROBOTS = {'/a': (1, 1), '/b': (1, 2), '/c': (1, 3), '/foreign': (3, 1)}


def receive(team, *names):
    for name in names:
        piece = driven_piece(*ROBOTS[name]).piece
        team.maps[name] = RobotMap(piece.patch, piece.graph)


def search_all(team):
    """Run all searches; returns the pairs in their order."""
    pairs = []
    while (search := team.next_search()) is not None:
        pairs.append((search.a, search.b))
        team.found(search, *search.run())
    return pairs


@pytest.fixture(scope='module')
def three():
    team = Team()
    receive(team, '/a', '/b', '/foreign')
    pairs = search_all(team)
    return team, pairs


def assert_at(T, a, b, metres=0.15):
    truth = true_transform(driven_piece(*ROBOTS[a]), driven_piece(*ROBOTS[b]))
    off = se2.between(truth, T)
    assert np.hypot(*off[:2]) < metres and abs(off[2]) < 0.02


def test_maps_of_one_building_are_joined_and_others_are_not(three):
    team, pairs = three
    assert pairs == [('/a', '/b'), ('/a', '/foreign'), ('/b', '/foreign')]
    places = team.places()
    assert list(places) == ['/a', '/b']
    np.testing.assert_array_equal(places['/a'], 0.0)
    assert_at(places['/b'], '/a', '/b')
    assert team.log_odds[frozenset(('/a', '/foreign'))] < np.log(100_000.0)


def test_only_pairs_with_a_changed_map_are_searched_again():
    team = Team()
    receive(team, '/a', '/b', '/foreign')
    search_all(team)
    assert team.next_search() is None
    receive(team, '/foreign')
    assert search_all(team) == [('/a', '/foreign'), ('/b', '/foreign')]


def test_a_link_stays_as_long_as_the_maps_do_not_contradict_it(three):
    team, _ = three
    before = team.links.between('/a', '/b')
    receive(team, '/b')
    search_all(team)
    assert team.links.between('/a', '/b').T_a_b is before.T_a_b


@pytest.mark.parametrize(('log_odds', 'is_left'), [(12.0, True), (1000.0, False)])
def test_a_place_is_left_for_a_surer_one(three, monkeypatch, log_odds, is_left):
    # As in a building that looks alike: scans match at the wrong place, too.
    monkeypatch.setattr(team_map, '_FEWEST_LINKS', 0)
    team, _ = three
    right = team.links.between('/a', '/b')
    wrong = replace(right, T_a_b=right.T_a_b + (50.0, 0.0, 0.0), log_odds=log_odds)
    maps = (team.maps['/a'], team.maps['/b'])
    link, _ = LinkSearch('/a', '/b', *maps, wrong, None, 100_000.0).run()
    assert link.contradicts(wrong) == is_left
    assert link.contradicts(right) != is_left


def moved(patch, metres):
    frame = patch.frame
    return GridPatch(type(frame)(frame.origin_x + metres, frame.origin_y, 0.05), patch.cells)


def test_a_map_that_was_corrected_takes_its_link_along():
    team = Team()
    receive(team, '/a', '/b')
    search_all(team)
    piece = driven_piece(*ROBOTS['/b']).piece
    team.maps['/b'] = RobotMap(moved(piece.patch, 0.5))
    search_all(team)
    there = se2.compose(team.places()['/b'], np.array([0.5, 0.0, 0.0]))
    assert_at(there, '/a', '/b')


def test_a_robot_that_maps_another_place_is_separated():
    team = Team()
    receive(team, '/a', '/b')
    search_all(team)
    piece = driven_piece(*ROBOTS['/foreign']).piece
    team.maps['/b'] = RobotMap(moved(piece.patch, 300.0))
    search = team.next_search()
    (dropped,) = team.found(search, *search.run())
    assert {dropped.a, dropped.b} == {'/a', '/b'}
    assert team.places() == {}


def test_given_poses_are_refined_by_scans():
    team = Team()
    receive(team, '/a', '/b')
    first = driven_piece(*ROBOTS['/a'])
    second = driven_piece(*ROBOTS['/b'])
    team.give(WORLD, '/a', first.T_world_piece)
    team.give(WORLD, '/b', second.T_world_piece + (0.3, -0.3, 0.04))
    search = team.next_search()
    assert search.guess is not None
    team.found(search, *search.run())
    places = team.places()
    assert_at(se2.between(places['/a'], places['/b']), '/a', '/b')
    assert np.hypot(*(places['/a'] - first.T_world_piece)[:2]) < 0.4


def test_what_a_person_separates_stays_separate_until_a_person_joins_it():
    team = Team()
    receive(team, '/a', '/b')
    search_all(team)
    team.separate('/b')
    assert team.places() == {}
    receive(team, '/a', '/b')
    assert team.next_search() is None
    truth = true_transform(driven_piece(*ROBOTS['/a']), driven_piece(*ROBOTS['/b']))
    team.give('/a', '/b', truth)
    assert set(team.places()) == {'/a', '/b'}


def test_the_joint_map_holds_all_and_its_ids_stay(three):
    team, _ = three
    places = team.places()
    one = merged(team.maps, {'/a': places['/a']}, None)
    assert one.graph.nodes.keys() == team.maps['/a'].graph.nodes.keys()
    both = merged(team.maps, places, one)
    again = merged(team.maps, places, both)
    kept = one.graph.nodes.keys() & both.graph.nodes.keys()
    assert len(kept) > 0.7 * len(one.graph.nodes)
    assert again.graph.nodes.keys() == both.graph.nodes.keys()
    assert again.next_id == both.next_id
    for name, T in places.items():
        own = team.maps[name].patch
        points = se2.transform_points(T, own.frame.centres_of(np.argwhere(own.free)))
        rows, cols = both.patch.frame.cells_of(points).T
        assert both.patch.free[rows, cols].mean() > 0.9


def test_a_map_alone_in_a_given_world_is_turned_into_it():
    piece = driven_piece(*ROBOTS['/a']).piece
    robot = RobotMap(piece.patch)
    T = np.array([5.0, 7.0, 0.6])
    turned = merged({'/a': robot}, {'/a': T}, None)
    points = piece.patch.frame.centres_of(np.argwhere(piece.patch.occupied))
    rows, cols = turned.patch.frame.cells_of(se2.transform_points(T, points)).T
    assert turned.patch.occupied[rows, cols].all()
    assert len(turned.graph.nodes) > 0
