"""Whether a laser drops returns is decided from its own scans."""

from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, drive, ranges_in, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.sensing.beams import DropoutDetector
from thinmap_ros.sim.moving_obstacles import range_to_disc

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


def at_rest(ranges_of, scans=60, reach_m=8.0, beams=360):
    """A detector after scans of 7 Hz of a robot at rest, all round.

    ranges_of: makes exact ranges (N,) of a time, s, at bearings (N,).
    """
    rng = np.random.default_rng(5)
    bearings = np.linspace(-np.pi, np.pi, beams, endpoint=False)
    detector = DropoutDetector()
    for k in range(scans):
        ranges = ranges_of(k / 7.0, bearings) + rng.normal(0.0, 0.01, beams)
        scan = Scan.create(k * 143_000_000, ranges, -np.pi, 2.0 * np.pi / beams, 0.05, reach_m)
        detector.update(scan, np.zeros(3))
    return detector


def in_room(_, bearings):
    return ranges_in(ROOM, START, bearings)


@pytest.mark.parametrize('share', [0.02, 0.2, 0.6, 0.75])
@pytest.mark.parametrize('block', [1, 6])
def test_a_laser_that_drops_returns_at_rest_is_recognized(share, block):
    rng = np.random.default_rng(2)

    def ranges(seconds, bearings):
        lost = np.repeat(rng.random(-(-bearings.size // block)) < share, block)[: bearings.size]
        return np.where(lost, np.inf, in_room(seconds, bearings))

    assert at_rest(ranges).drops_out


def test_empty_beams_between_those_of_a_surface_show_no_free_space():
    """As of two lasers merged to one, without noise: always the same beams are empty."""

    def ranges(seconds, bearings):
        return np.where(np.arange(bearings.size) % 3 == 1, np.inf, in_room(seconds, bearings))

    assert at_rest(ranges).drops_out


class Person:
    """A person who walks back and forth, or stands and sways, as two legs."""

    def __init__(self, rng, walks):
        self._start = rng.uniform(-3.0, 3.0, 2)
        self._way = rng.uniform(-3.0, 3.0, 2) if walks else np.array([0.02, 0.01])
        self._period_s = rng.uniform(4.0, 9.0) if walks else 3.0

    def ranges(self, seconds, beams):
        phase = 2.0 * np.pi * seconds / self._period_s
        middle = self._start + np.sin(phase) * self._way
        legs = [range_to_disc(middle + side, 0.06, beams) for side in ([0.0, 0.12], [0.0, -0.12])]
        return np.minimum(*legs)


@pytest.mark.parametrize('reach_m', [3.5, 8.0])
@pytest.mark.parametrize('walls', [ROOM[:0], ROOM[:1], ROOM[:4]])
@pytest.mark.parametrize('walks', [True, False])
def test_people_before_a_laser_at_rest_are_no_dropouts(walks, walls, reach_m):
    people = [Person(np.random.default_rng(k), walks) for k in range(6)]

    def ranges(seconds, bearings):
        beams = np.column_stack([np.cos(bearings), np.sin(bearings)])
        surfaces = [ranges_in(walls, START, bearings)] if len(walls) else []
        return np.min([*surfaces, *(person.ranges(seconds, beams) for person in people)], axis=0)

    assert not at_rest(ranges, 300, reach_m).drops_out


@pytest.mark.parametrize('reach_m', [2.0, 3.5, 8.0])
def test_a_wall_at_the_end_of_the_range_is_no_dropout(reach_m):
    """Noise decides whether it is in range."""
    assert not at_rest(in_room, 200, reach_m).drops_out
    assert not at_rest(lambda _, bearings: np.full(bearings.size, reach_m)).drops_out


def test_a_robot_that_moves_without_odometry_is_not_at_rest():
    rng = np.random.default_rng(7)
    detector = DropoutDetector()
    for k, (truth, _) in zip(range(900), drive(900, rng, START), strict=False):
        scan = replace(scan_in(ROOM, truth, rng, k * PERIOD_NS), range_max_m=3.5)
        assert not detector.update(scan, np.zeros(3))
