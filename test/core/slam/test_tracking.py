"""Evidence against the map: how soon a robot that was put into a map is placed in it."""

import numpy as np
import pytest

from thinmap_ros.core.slam.matching.scan_matcher import Match
from thinmap_ros.core.slam.tracking import Tracking


def match(inlier_ratio: float, contradiction_ratio: float) -> Match:
    return Match(np.zeros(3), np.eye(3), np.eye(3), inlier_ratio, contradiction_ratio, 0.0, 1.0)


@pytest.mark.parametrize(('inlier_ratio', 'scans'), [(1.0, 2), (0.7, 3)])
def test_two_scans_that_fit_well_or_three_that_fit_place_a_robot(inlier_ratio, scans):
    tracking = Tracking(4.0, 0.6, np.zeros(3))
    tracking.start_delocalized()
    for _ in range(scans):
        assert tracking.is_lost
        tracking.update(match(inlier_ratio, 0.0))
    assert not tracking.is_lost
    assert tracking.agrees


def test_points_that_contradict_count_three_times_as_much_as_points_that_fit():
    tracking = Tracking(4.0, 0.6, np.zeros(3))
    tracking.update(match(0.75, 0.5))
    assert tracking.evidence == 0.25
    tracking.update(match(0.75, 0.0))
    assert tracking.agrees


def test_evidence_that_is_high_is_limited_when_the_robot_is_lost_so_that_scans_place_it_again():
    tracking = Tracking(4.0, 0.6, np.zeros(3))
    for _ in range(20):
        tracking.update(match(0.0, 1.0))
    assert tracking.evidence == pytest.approx(20.0)
    assert not tracking.is_lost
    tracking.lose()
    assert tracking.is_lost
    assert tracking.evidence == 4.0
    tracking.update(match(0.0, 1.0))
    assert tracking.evidence == 4.0
    scans = 0
    while tracking.is_lost:
        tracking.update(match(1.0, 0.0))
        scans += 1
    assert scans == 12
    assert not tracking.is_delocalized


def test_in_a_given_map_a_pose_is_lost_until_a_scan_fits():
    for is_map_given in (False, True):
        tracking = Tracking(4.0, 0.6, np.zeros(3))
        tracking.place(np.ones(3), np.eye(3), is_map_given)
        for update in (None, match(0.0, 0.0)):
            assert tracking.is_lost == is_map_given
            tracking.update(update)
        assert tracking.is_lost == is_map_given
        tracking.update(match(0.7, 0.0))
        assert not tracking.is_lost


def test_walls_that_are_seen_through_are_evidence_that_no_inlier_reduces():
    tracking = Tracking(4.0, 0.6, np.zeros(3))
    scans = 0
    while not tracking.needs_submap:
        tracking.update(match(1.0, 0.0), seen_through=0.5)
        scans += 1
        assert not tracking.agrees
    assert scans == 16
    tracking.start_submap()
    assert tracking.agrees


def test_glass_is_seen_through_and_no_evidence():
    tracking = Tracking(4.0, 0.6, np.zeros(3))
    for _ in range(1000):
        tracking.update(match(0.9, 0.05), seen_through=0.2)
    assert tracking.agrees
