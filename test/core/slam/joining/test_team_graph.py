"""Maps of several robots bend until their keyframes agree."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.driven_pieces import driven_piece, true_transform

from thinmap_ros.core import se2
from thinmap_ros.core.slam.graph.loop_closure import LoopClosureConfig
from thinmap_ros.core.slam.joining import team
from thinmap_ros.core.slam.joining.messages import SentEdge
from thinmap_ros.core.slam.joining.pieces import RobotKeyframes
from thinmap_ros.core.slam.joining.team import RobotMap, TeamGraph, merged

DRIVES = {'/a': (1, 1), '/b': (1, 2), '/c': (1, 3)}
DRIFT = 0.01  # m of error per metre of path


def keyframes(name, drift=0.0, session=1, count=None):
    driven = driven_piece(*DRIVES[name], drift=drift)
    frames = list(driven.piece.keyframes)[:count]
    edges = [SentEdge(e.a, e.b, e.information) for e in driven.edges if e.b < len(frames)]
    return RobotKeyframes(session, frames, edges)


def place(name):
    """True pose (3,) of a map in that of the first."""
    return true_transform(driven_piece(*DRIVES['/a']), driven_piece(*DRIVES[name]))


def truth(name):
    frames = driven_piece(*DRIVES[name]).piece.keyframes
    return np.array([se2.compose(place(name), frame.T_map_base) for frame in frames])


def rms(poses, name):
    return float(np.sqrt(np.mean(np.sum((poses - truth(name)[: len(poses)])[:, :2] ** 2, axis=1))))


def rigid_rms(robot, name):
    return rms(np.array([se2.compose(place(name), own) for own in robot.poses]), name)


@pytest.fixture(scope='module')
def pair():
    maps = {'/a': keyframes('/a'), '/b': keyframes('/b', DRIFT)}
    places = {name: place(name) for name in maps}
    graph = TeamGraph()
    return graph, maps, places, graph.bend(maps, places)


def test_a_bent_map_is_straightened_by_the_other_one(pair):
    graph, maps, _, bend = pair
    assert graph.count_links() > 10
    np.testing.assert_array_equal(bend.poses['/a'][0], maps['/a'].poses[0])
    assert rms(bend.poses['/b'], '/b') < 0.5 * rigid_rms(maps['/b'], '/b')
    assert rms(bend.poses['/a'], '/a') < 0.1


def test_the_place_of_a_map_is_that_where_its_robot_is(pair):
    _, maps, places, bend = pair
    now = bend.present_places(places)
    there = se2.compose(now['/b'], maps['/b'].poses[-1])
    np.testing.assert_allclose(there, bend.poses['/b'][-1], atol=1e-9)
    elsewhere = {**places, '/b': places['/b'] + (5.0, 0.0, 0.0)}
    np.testing.assert_array_equal(bend.present_places(elsewhere)['/b'], elsewhere['/b'])
    assert bend.present_places({'/c': place('/c')}).keys() == {'/c'}


def test_maps_that_have_not_changed_stay_where_they_are(pair):
    graph, maps, places, bend = pair
    count = graph.count_links()
    again = graph.bend(maps, places)
    assert graph.count_links() == count
    for name in maps:
        np.testing.assert_allclose(again.poses[name], bend.poses[name], atol=0.01)


def test_a_map_that_grows_goes_on_where_it_was_bent():
    graph = TeamGraph()
    first = keyframes('/a')
    places = {'/a': place('/a'), '/b': place('/b')}
    graph.bend({'/a': first, '/b': keyframes('/b', DRIFT, count=60)}, places)
    count = graph.count_links()
    grown = keyframes('/b', DRIFT)
    bend = graph.bend({'/a': first, '/b': grown}, places)
    assert graph.count_links() > count
    assert rms(bend.poses['/b'], '/b') < 0.5 * rigid_rms(grown, '/b')


@pytest.mark.parametrize('is_moved', [False, True])
def test_another_map_or_another_place_begins_again(is_moved):
    graph = TeamGraph()
    places = {'/a': place('/a'), '/b': place('/b')}
    first = keyframes('/a')
    graph.bend({'/a': first, '/b': keyframes('/b')}, places)
    count = graph.count_links()
    far = {**places, '/b': place('/b') + (200.0, 0.0, 0.0)}
    few = keyframes('/b', session=2, count=2)
    bend = graph.bend(
        {'/a': first, '/b': keyframes('/b') if is_moved else few}, far if is_moved else places
    )
    assert graph.count_links() < count
    assert bend.poses == {}


def test_three_maps_are_one_graph_and_one_without_keyframes_stays_rigid():
    maps = {'/a': keyframes('/a'), '/b': keyframes('/b', DRIFT), '/c': keyframes('/c')}
    places = {name: place(name) for name in maps} | {'/rigid': place('/b')}
    bend = TeamGraph().bend(maps, places)
    assert bend.poses.keys() == maps.keys()
    assert rms(bend.poses['/b'], '/b') < 0.5 * rigid_rms(maps['/b'], '/b')
    assert rms(bend.poses['/c'], '/c') < 0.1


def test_too_few_matches_bend_nothing(monkeypatch):
    fewest = LoopClosureConfig().min_consistent_matches
    monkeypatch.setattr(team, '_MAX_MATCHES', fewest - 1)
    graph = TeamGraph()
    maps = {'/a': keyframes('/a'), '/b': keyframes('/b', DRIFT)}
    places = {name: place(name) for name in maps}
    assert graph.bend(maps, places).poses == {}
    assert graph.bend(maps, places).poses.keys() == maps.keys(), 'the next matches'


def test_keyframes_that_nothing_connects_bend_nothing():
    maps = {'/a': keyframes('/a'), '/b': replace(keyframes('/b', DRIFT), sent_edges=[])}
    places = {name: place(name) for name in maps}
    graph = TeamGraph()
    assert graph.bend(maps, places).poses == {}
    whole = {**maps, '/b': keyframes('/b', DRIFT)}
    assert graph.bend(whole, places).poses.keys() == maps.keys()


def test_a_corrected_map_is_matched_at_its_corrected_poses():
    graph = TeamGraph()
    places = {'/a': place('/a'), '/b': place('/b')}
    first = keyframes('/a')
    graph.bend({'/a': first, '/b': keyframes('/b', DRIFT)}, places)
    corrected = keyframes('/b')
    bend = graph.bend({'/a': first, '/b': corrected}, places)
    assert rms(bend.poses['/b'], '/b') < rigid_rms(keyframes('/b', DRIFT), '/b') / 3.0


def test_the_joint_map_shows_each_wall_once():
    robots = {}
    for name, drift in (('/a', 0.0), ('/b', DRIFT)):
        piece = driven_piece(*DRIVES[name], drift=drift).piece
        robots[name] = RobotMap(piece.patch, piece.graph, keyframes(name, drift))
    places = {name: place(name) for name in robots}
    bend = TeamGraph().bend({name: robot.keyframes for name, robot in robots.items()}, places)
    rigid = merged(robots, places, None)
    bent = merged(robots, places, None, bend.poses)
    straight = driven_piece(*DRIVES['/b']).piece.patch
    walls = se2.transform_points(
        places['/b'], straight.frame.centres_of(np.argwhere(straight.occupied))
    )
    shares = []
    for found in (rigid, bent):
        rows, cols = found.patch.frame.cells_of(walls).T
        shares.append(found.patch.occupied[rows, cols].mean())
    assert shares[1] > shares[0] + 0.05
    assert math.isclose(bent.patch.frame.resolution, straight.frame.resolution)
    assert len(bent.graph.nodes) > 10
    only = replace(robots['/b'], keyframes=None)
    assert merged({'/b': only}, {'/b': np.zeros(3)}, None, bend.poses).patch is only.patch
