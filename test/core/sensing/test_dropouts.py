"""Whether a laser drops returns is decided from its own scans."""

from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, drive, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.sensing.beams import DropoutDetector

START = se2.pose(2.0, 2.0, 0.0)
PERIOD_NS = 200_000_000


def without_returns(scan, lost):
    """The scan without the returns of the beams `lost` (N,)."""
    return replace(scan, ranges_m=np.where(lost, np.inf, scan.ranges_m))


def verdicts(spoil, scans=300, seed=7):
    """Whether a laser drops out, after each scan of a drive round the room."""
    rng = np.random.default_rng(seed)
    detector = DropoutDetector()
    found = []
    for k, (truth, odom) in zip(range(scans), drive(scans, rng, START), strict=False):
        scan = spoil(scan_in(ROOM, truth, rng, k * PERIOD_NS), rng)
        found.append(detector.update(scan, odom))
    return found, detector


@pytest.mark.parametrize('share', [0.05, 0.2, 0.6, 0.75])
@pytest.mark.parametrize('block', [1, 6])
def test_a_laser_that_drops_returns_is_recognized_within_metres(share, block):
    def spoil(scan, rng):
        lost = np.repeat(rng.random(-(-scan.ranges_m.size // block)) < share, block)
        return without_returns(scan, lost[: scan.ranges_m.size])

    found, detector = verdicts(spoil)
    assert all(found[-100:])
    assert f'{100 * detector.miss_ratio:.0f} % of the beams' in detector.warning


def test_surfaces_that_are_hit_only_at_steep_angles_make_a_laser_that_drops_out():
    """As of polished floors and dark furniture: the same beams are lost from the same place."""

    def spoil(scan, rng):
        ranges = np.where(scan.hit, scan.ranges_m, 1e3)
        slope = np.abs(np.gradient(ranges)) / (ranges * abs(scan.angle_increment_rad))
        return without_returns(scan, slope > 0.5)

    assert verdicts(spoil)[0][-1]


@pytest.mark.parametrize('range_max_m', [1.5, 2.5, 4.0])
def test_walls_out_of_range_are_no_dropouts(range_max_m):
    def spoil(scan, rng):
        return replace(scan, range_max_m=range_max_m)

    found, detector = verdicts(spoil, 600)
    assert not any(found)
    assert detector.warning == ''
    assert detector.miss_ratio < 0.03


def test_a_robot_that_stands_learns_nothing_new():
    """A door that opens to a hall is one view, however long the robot looks into it."""
    rng = np.random.default_rng(3)
    detector = DropoutDetector()
    for k in range(200):
        scan = scan_in(ROOM, START, rng, k * PERIOD_NS)
        is_open = k > 50 and np.abs(scan.angles_rad) < 0.3
        assert not detector.update(without_returns(scan, is_open), np.zeros(3))
