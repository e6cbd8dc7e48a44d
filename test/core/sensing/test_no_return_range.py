"""A driver that publishes a finite range below range_max for beams without return."""

from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import RANGE_MAX_M, ROOM, drive, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.sensing.beams import NoReturnRange

START = se2.pose(2.0, 2.0, 0.0)
POSES = list(drive(200, np.random.default_rng(1), START))


def scans(reach_m, published_m):
    """Scans of a drive, with a range for everything beyond reach_m."""
    rng = np.random.default_rng(2)
    for truth, _ in POSES:
        scan = scan_in(ROOM, truth, rng)
        out = scan.ranges_m >= reach_m
        yield replace(scan, ranges_m=np.where(out, np.float32(published_m), scan.ranges_m)), out


@pytest.mark.parametrize(('reach_m', 'published_m'), [(3.0, 2.99), (3.5, 3.5), (4.0, 5.5)])
def test_a_range_that_many_beams_share_at_the_far_end_is_no_return(reach_m, published_m):
    driver = NoReturnRange()
    wrong = 0
    for scan, out in scans(reach_m, published_m):
        applied = driver.applied(scan)
        wrong += np.count_nonzero(applied.hit & out)
        assert not (applied.hit & (applied.ranges_m >= published_m)).any() or wrong
    assert wrong < 100, 'before a scan has shown it'
    assert f'{published_m:.3f} m' in driver.warning


def test_a_room_has_no_such_range():
    driver = NoReturnRange()
    for scan, _ in scans(np.inf, 0.0):
        assert driver.applied(scan) is scan
    assert driver.warning == ''


@pytest.mark.parametrize('value', [np.inf, np.nan, 0.0, RANGE_MAX_M, 65.535])
def test_what_is_no_hit_anyway_is_left_alone(value):
    driver = NoReturnRange()
    for scan, _ in scans(3.0, value):
        assert driver.applied(scan) is scan


def test_a_coarse_laser_along_a_wall_shares_its_nearest_range_only():
    driver = NoReturnRange()
    for k in range(20):
        scan = scan_in(ROOM, se2.pose(1.0 + 0.1 * k, 1.0, 0.5), beams=721)
        coarse = replace(scan, ranges_m=np.round(scan.ranges_m, 1))
        assert driver.applied(coarse) is coarse


def test_larger_ranges_show_that_it_was_a_surface():
    driver = NoReturnRange()
    for scan, _ in scans(3.0, 2.99):
        driver.applied(scan)
    for scan, _ in scans(np.inf, 0.0):
        applied = driver.applied(scan)
    assert applied is scan and driver.warning == ''
