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
