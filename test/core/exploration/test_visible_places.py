"""Visibility: which places a scan sees."""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.space import field_of_view, visible_places
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.scan import Scan

FRAME = GridFrame(0.0, 0.0, 0.1)


def half_scan(range_max_m=8.0):
    return Scan.create(0, np.full(181, 1.0), -math.pi / 2, math.pi / 180, 0.05, range_max_m)


def sees(place, pose=(2.0, 2.0, 0.0), wall=None, range_max_m=8.0):
    free = np.ones((100, 100), dtype=np.bool_)
    if wall is not None:
        free[:, wall] = False
    seen = visible_places(np.array([place]), half_scan(range_max_m), se2.pose(*pose), free, FRAME)
    return bool(seen[0])


def test_a_place_in_range_and_field_of_view_is_seen():
    assert sees((6.0, 2.0))
    assert sees((2.0, 6.0)), 'the outer beam counts'


@pytest.mark.parametrize(
    'hidden', [{'place': (1.0, 2.0)}, {'range_max_m': 3.9}, {'wall': 40}, {'place': (1.5, 6.0)}]
)
def test_what_is_behind_the_robot_out_of_range_or_behind_a_wall_is_not_seen(hidden):
    assert not sees(**({'place': (6.0, 2.0)} | hidden))


@pytest.mark.parametrize('increment_deg', [1.0, -1.0])
def test_the_field_of_view_ends_at_the_outer_beams(increment_deg):
    first = math.radians(-90.0 * increment_deg)
    scan = Scan.create(0, np.full(181, 1.0), first, math.radians(increment_deg), 0.05, 8.0)
    low, high = field_of_view(scan)
    assert np.degrees([low, high]).tolist() == pytest.approx([-91.0, 91.0])
