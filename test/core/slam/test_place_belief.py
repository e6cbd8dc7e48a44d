"""Evidence against the map: how soon a robot that was put into a map is placed in it."""

import numpy as np
import pytest

from thinmap_ros.core.places.place_odds import SURE
from thinmap_ros.core.slam.matching.scan_matcher import Match
from thinmap_ros.core.slam.matching.visibility import SeenThrough
from thinmap_ros.core.slam.place_belief import PlaceBelief

ANGLES = np.linspace(-np.pi, np.pi, 90)
ALL_AROUND = 4.0 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
DOOR = np.column_stack([np.full(90, 2.0), np.linspace(-1.0, 1.0, 90)])


def match(inlier_ratio: float, contradiction_ratio: float) -> Match:
    return Match(np.zeros(3), np.eye(3), np.eye(3), inlier_ratio, contradiction_ratio, 0.0, 1.0)


@pytest.mark.parametrize(('inlier_ratio', 'scans'), [(1.0, 2), (0.7, 3)])
def test_two_scans_that_fit_well_or_three_that_fit_place_a_robot(inlier_ratio, scans):
    evidence = PlaceBelief(4.0, 0.6)
    evidence.start_delocalized()
    for _ in range(scans):
        assert evidence.is_lost
        evidence.update(match(inlier_ratio, 0.0))
    assert not evidence.is_lost
    assert evidence.agrees


def tried(*rows, is_guess=False):
    """Evidence at a start pose that nobody gave, after scans: path, m, and inlier ratio of each."""
    evidence = PlaceBelief(4.0, 0.6)
    evidence.start_delocalized(is_pose_given=is_guess, is_guess=is_guess)
    for moved_m, inlier_ratio in rows:
        evidence.update(match(inlier_ratio, 0.0), moved_m=moved_m)
    return evidence


@pytest.mark.parametrize('path_m', [0.0, 5.9, 6.1])
def test_a_start_that_nobody_gave_is_confirmed_along_the_path_of_a_view(path_m):
    evidence = tried(*[(0.0, 1.0)] * 2, *[(path_m / 20.0, 1.0)] * 20)
    is_confirmed = path_m > 6.0
    assert evidence.permits_mapping == is_confirmed != evidence.is_delocalized
    assert evidence.agrees and not evidence.is_lost and not evidence.needs_submap


@pytest.mark.parametrize('path_m', [0.0, 5.9, 6.1])
def test_a_robot_at_a_guessed_pose_is_lost_until_its_way_confirms_it(path_m):
    evidence = tried(*[(0.0, 1.0)] * 2, *[(path_m / 20.0, 1.0)] * 20, is_guess=True)
    assert evidence.permits_mapping == (not evidence.is_lost) == (path_m > 6.0)


@pytest.mark.parametrize(('log_ratio', 'permits'), [(2.0, True), (0.0, True), (-0.5, False)])
def test_a_given_start_is_believed_unless_a_look_speaks_against_it(log_ratio, permits):
    belief = PlaceBelief(4.0, 0.6)
    belief.start_delocalized(is_tried=True)
    assert belief.is_start_judged
    belief.judge_start(log_ratio)
    for _ in range(2):
        belief.update(match(1.0, 0.0))
    assert belief.permits_mapping == permits
    assert not belief.needs_submap
    if not permits:
        belief.judge_start(-log_ratio)
        belief.update(match(1.0, 0.0))
        assert belief.permits_mapping, 'the next look speaks for it'


def test_a_given_start_is_left_where_the_odds_are_against_it():
    belief = PlaceBelief(4.0, 0.6)
    belief.start_delocalized(is_tried=True)
    belief.judge_start(-6.0)
    belief.update(match(1.0, 0.0))
    assert not belief.needs_submap, 'one place alone'
    belief.judge_start(-6.0)
    belief.update(match(1.0, 0.0))
    assert belief.needs_submap


def test_a_robot_that_was_kidnapped_in_a_given_map_is_lost_until_scans_fit():
    belief = PlaceBelief(4.0, 0.6)
    belief.move(-13.0)
    belief.update(match(0.2, 0.1), is_stationary=True)
    assert belief.needs_submap
    belief.lose()
    assert belief.is_lost and not belief.is_elsewhere
    belief.update(match(1.0, 0.0))
    assert belief.is_lost


def test_where_the_robot_may_have_been_kidnapped_scans_that_fit_wait_to_be_drawn():
    """Places look alike: a map that grows by the first scan would fit all that follow."""
    belief = PlaceBelief(4.0, 0.6)
    belief.update(match(0.8, 0.0))
    assert not belief.forbids_mapping
    belief.move(-8.0)
    belief.update(match(0.8, 0.0))
    assert belief.is_doubted and not belief.needs_submap
    scans = 0
    while belief.forbids_mapping:
        belief.move(0.0)
        belief.update(match(0.8, 0.0))
        scans += 1
    assert 2 < scans < 10
    assert 2.0 * belief.log_odds >= SURE and not belief.permits_mapping


def test_a_given_pose_ends_a_guess():
    evidence = tried((0.0, 1.0), is_guess=True)
    evidence.place()
    evidence.judge_start(0.0)
    evidence.update(match(1.0, 0.0))
    assert not evidence.is_lost and evidence.permits_mapping


def test_a_scan_that_does_not_fit_begins_the_path_anew_and_without_a_view_the_robot_is_elsewhere():
    rows = [(0.5, 0.3 if k % 8 == 7 else 1.0) for k in range(40)]
    assert not tried(*rows[:24]).permits_mapping
    assert not tried(*rows[:24]).needs_submap
    assert tried(*rows[:25]).needs_submap


def test_points_that_contradict_count_three_times_as_much_as_points_that_fit():
    evidence = PlaceBelief(4.0, 0.6)
    evidence.update(match(0.75, 0.5))
    assert evidence.level == 0.25
    evidence.update(match(0.75, 0.0))
    assert evidence.agrees


def test_evidence_that_is_high_is_limited_when_the_robot_is_lost_so_that_scans_place_it_again():
    evidence = PlaceBelief(4.0, 0.6)
    for _ in range(20):
        evidence.update(match(0.0, 1.0))
    assert evidence.level == pytest.approx(20.0)
    assert not evidence.is_lost
    evidence.lose()
    assert evidence.is_lost
    assert evidence.level == 4.0
    evidence.update(match(0.0, 1.0))
    assert evidence.level == 4.0
    scans = 0
    while evidence.is_lost:
        evidence.update(match(1.0, 0.0))
        scans += 1
    assert scans == 12
    assert not evidence.is_delocalized


def test_in_a_given_map_a_pose_is_lost_until_a_scan_fits():
    for is_map_given in (False, True):
        evidence = PlaceBelief(4.0, 0.6)
        evidence.place(is_map_given)
        for update in (None, match(0.0, 0.0)):
            assert evidence.is_lost == is_map_given
            evidence.update(update)
        assert evidence.is_lost == is_map_given
        evidence.update(match(0.7, 0.0))
        assert not evidence.is_lost


def test_walls_that_are_seen_through_are_evidence_that_no_inlier_reduces():
    evidence = PlaceBelief(4.0, 0.6)
    scans = 0
    while not evidence.needs_submap:
        evidence.update(match(1.0, 0.0), through(ALL_AROUND, 0.5))
        scans += 1
        assert not evidence.agrees
    assert scans == 16
    evidence.start_submap()
    assert evidence.agrees


def test_glass_is_seen_through_and_no_evidence():
    evidence = PlaceBelief(4.0, 0.6)
    for _ in range(1000):
        evidence.update(match(0.9, 0.05), through(ALL_AROUND, 0.2))
    assert evidence.agrees


def test_a_door_that_opens_before_the_robot_is_no_evidence_of_another_place():
    evidence = PlaceBelief(4.0, 0.6)
    for _ in range(30):
        evidence.update(match(0.95, 0.0), through(DOOR, 0.7))
        assert not evidence.needs_submap
    # Beside it the walls are those of another place.
    scans = 0
    while not evidence.needs_submap:
        evidence.update(match(0.95, 0.0), through(ALL_AROUND, 0.7))
        scans += 1
    assert 20 < scans < 60


@pytest.mark.parametrize(('step_m', 'is_elsewhere'), [(0.1, False), (0.15, True)])
def test_a_robot_that_sees_through_an_opening_for_metres_is_elsewhere(step_m, is_elsewhere):
    belief = PlaceBelief(4.0, 0.6)
    for _ in range(30):
        belief.update(match(0.95, 0.0), through(DOOR, 0.7), moved_m=step_m)
    assert belief.needs_submap == is_elsewhere


def test_after_a_door_another_place_is_noticed_as_soon():
    evidence = PlaceBelief(4.0, 0.6)
    for _ in range(10):
        evidence.update(match(0.95, 0.0), through(DOOR, 0.7))
    for _ in range(50):
        evidence.update(match(1.0, 0.0))
    assert evidence.agrees
    for _ in range(16):
        evidence.update(match(1.0, 0.0), through(ALL_AROUND, 0.5))
    assert evidence.needs_submap


@pytest.mark.parametrize(
    ('continuity', 'is_elsewhere'), [(-5.0, False), (-8.0, False), (-12.0, True)]
)
def test_a_robot_is_elsewhere_where_that_it_was_carried_off_is_likelier(continuity, is_elsewhere):
    belief = PlaceBelief(4.0, 0.6)
    assert belief.log_odds == SURE
    belief.move(continuity)
    assert belief.is_elsewhere == belief.needs_submap == is_elsewhere
    assert belief.agrees == (continuity == -5.0)
    belief.update(match(1.0, 0.0))
    belief.move(0.0)
    for _ in range(20):
        belief.update(match(1.0, 0.0))
    assert belief.agrees != is_elsewhere
    belief.start_submap()
    assert belief.agrees and not belief.is_elsewhere


def test_at_rest_the_last_scan_counts_and_a_robot_that_was_put_back_is_here():
    belief = PlaceBelief(4.0, 0.6)
    belief.move(-12.0)
    belief.move(-12.0, is_again=True)
    assert belief.is_elsewhere and belief.log_odds < 0.0
    belief.move(0.0, is_again=True)
    assert belief.agrees and belief.log_odds == SURE


def test_of_a_robot_that_is_placed_the_last_scan_says_nothing():
    belief = PlaceBelief(4.0, 0.6)
    belief.place()
    belief.move(-30.0)
    assert not belief.is_elsewhere


def through(walls, ratio):
    return SeenThrough(walls, ratio)
