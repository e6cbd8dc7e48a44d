"""End node tracker: counted observations, and nodes that move, appear, merge or vanish."""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.end_node_tracker import PRIOR, EndNodeTracker, TrackerConfig
from thinmap_ros.core.exploration.position_probability import bayes_update, distance_index
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.scan import Scan

FRAME = GridFrame(0.0, 0.0, 0.1)
FREE = np.ones((100, 100), dtype=np.bool_)


def scan(range_max_m=8.0, increment_deg=1.0):
    first = -math.radians(90.0) * math.copysign(1.0, increment_deg)
    return Scan.create(0, np.full(181, 5.0), first, math.radians(increment_deg), 0.05, range_max_m)


def tracker(mode='paper', **values):
    return EndNodeTracker(TrackerConfig(mode=mode, **values))


def look(of, pose, open_ids=frozenset(), free=FREE):
    of.look(scan(), se2.pose(*pose), free, FRAME, set(open_ids))


def test_first_look_is_equations_1_to_10():
    nodes = tracker()
    nodes.follow({1: (5.0, 2.0)})
    look(nodes, (2.0, 2.0, 0.0))
    track = nodes.tracks[1]
    assert track.min_distance_m == pytest.approx(3.0)
    assert track.probability == pytest.approx(bayes_update(PRIOR, distance_index(3.0)))


def test_a_robot_that_stands_still_learns_nothing_new():
    nodes = tracker()
    nodes.follow({1: (5.0, 2.0)})
    look(nodes, (2.0, 2.0, 0.0))
    before = nodes.tracks[1].probability
    for turned in np.linspace(-1.0, 1.0, 50):
        look(nodes, (2.0, 2.0, float(turned)))
    assert nodes.tracks[1].probability == before
    look(nodes, (2.6, 2.0, 0.0))
    assert nodes.tracks[1].probability > before


def test_looks_from_all_round_make_a_node_reliable_from_afar():
    nodes = tracker()
    nodes.follow({1: (5.0, 5.0)})
    for bearing in np.radians(np.arange(0.0, 120.0, 20.0)):
        look(nodes, (5.0 - 4.0 * math.cos(bearing), 5.0 - 4.0 * math.sin(bearing), float(bearing)))
    assert nodes.tracks[1].angle_index == 1.0
    assert nodes.tracks[1].min_distance_m == pytest.approx(4.0)
    assert nodes.tracks[1].probability > 0.9


@pytest.mark.parametrize(
    ('pose', 'wall'),
    [((2.0, 2.0, math.pi), False), ((2.0, 2.0, 0.0), True), ((2.0, 9.9, -1.2), False)],
    ids=['behind', 'hidden', 'too far'],
)
def test_what_the_laser_does_not_see_is_not_updated(pose, wall):
    nodes = tracker()
    nodes.follow({1: (9.5, 2.0)})
    free = FREE.copy()
    free[:, 40] = not wall
    look(nodes, pose, free=free)
    assert nodes.tracks[1].probability == PRIOR
    assert nodes.tracks[1].distance_index == 0.0


def test_a_node_that_moves_a_little_keeps_its_evidence_and_one_that_moves_on_loses_it():
    nodes = tracker()
    nodes.follow({1: (5.0, 2.0)})
    look(nodes, (2.0, 2.0, 0.0))
    gathered = nodes.tracks[1].probability
    nodes.follow({1: (5.3, 2.0)})
    assert nodes.tracks[1].probability == gathered
    # In small steps, too: the displacement since the first evidence counts.
    nodes.follow({1: (5.6, 2.0)})
    assert nodes.tracks[1].probability == PRIOR
    assert nodes.tracks[1].min_distance_m == math.inf


def test_a_new_id_nearby_takes_over_the_evidence_and_is_told():
    nodes = tracker()
    nodes.follow({1: (5.0, 2.0), 2: (1.0, 8.0)})
    look(nodes, (2.0, 2.0, 0.0))
    gathered = nodes.tracks[1].probability
    assert nodes.follow({7: (5.2, 2.0), 2: (1.0, 8.0)}) == {1: 7}
    assert set(nodes.tracks) == {2, 7}
    assert nodes.tracks[7].probability == gathered
    assert nodes.tracks[7].node_id == 7


def test_of_two_that_merge_the_nearer_one_lives_on():
    nodes = tracker()
    nodes.follow({1: (5.0, 2.0), 2: (5.5, 2.0)})
    look(nodes, (2.0, 2.0, 0.0))
    nearer = nodes.tracks[2].min_distance_m
    assert nodes.follow({3: (5.4, 2.0)}) == {2: 3}
    assert nodes.tracks[3].min_distance_m == nearer


def test_a_track_is_inherited_once_and_a_far_one_not_at_all():
    nodes = tracker()
    nodes.follow({1: (5.0, 2.0)})
    look(nodes, (2.0, 2.0, 0.0))
    assert nodes.follow({2: (5.1, 2.0), 3: (5.2, 2.0), 4: (6.0, 2.0)}) == {1: 2}
    assert nodes.tracks[3].probability == nodes.tracks[4].probability == PRIOR


def test_what_vanishes_is_forgotten():
    nodes = tracker()
    nodes.follow({1: (5.0, 2.0)})
    look(nodes, (2.0, 2.0, 0.0))
    nodes.follow({})
    assert nodes.tracks == {}
    nodes.follow({1: (5.0, 2.0)})
    assert nodes.tracks[1].probability == PRIOR


def test_an_open_border_keeps_a_node_in_doubt_however_often_it_is_seen():
    nodes = tracker('frontier')
    nodes.follow({1: (5.0, 5.0)})
    for bearing in np.radians(np.arange(0.0, 180.0, 15.0)):
        look(nodes, (5.0 - math.cos(bearing), 5.0 - math.sin(bearing), float(bearing)), {1})
    assert nodes.tracks[1].angle_index == 1.0
    assert nodes.tracks[1].probability <= PRIOR


def test_a_closed_border_settles_a_node_and_an_opened_one_is_as_doubtful_as_at_first():
    nodes = tracker('frontier')
    nodes.follow({1: (9.0, 9.0)})
    look(nodes, (1.0, 1.0, math.pi))
    settled = nodes.tracks[1].probability
    assert settled >= 0.9
    look(nodes, (1.0, 1.0, math.pi))
    assert nodes.tracks[1].probability == settled
    look(nodes, (1.0, 1.0, math.pi), {1})
    assert nodes.tracks[1].probability == PRIOR


@pytest.mark.parametrize('increment_deg', [1.0, -1.0])
def test_field_of_view_ends_at_the_outer_beams(increment_deg):
    angles = 0.3 + np.radians([0.0, 89.0, -89.0, 95.0, -95.0, 180.0])
    nodes = tracker()
    nodes.follow(
        {
            i: (5.0 + math.cos(angle), 5.0 + math.sin(angle))
            for i, angle in enumerate(angles.tolist())
        }
    )
    nodes.look(scan(increment_deg=increment_deg), se2.pose(5.0, 5.0, 0.3), FREE, FRAME, set())
    seen = [bool(track.distances_m) for track in nodes.tracks.values()]
    assert seen == [True, True, True, False, False, False]
