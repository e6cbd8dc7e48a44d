"""A scan made while the robot moves, against the one that all beams had made at its stamp."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import RANGE_MAX_M, ROOM, ranges_in

from thinmap_ros.core import se2
from thinmap_ros.core.scan import AT_END, LaserConfig, Scan
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer, SweepTiming, deskewed
from thinmap_ros.logs.transforms import Mount

SECOND = 1_000_000_000
PERIOD_S = 0.2
STAMP_NS = 5 * SECOND
START = se2.pose(2.0, 2.0, 0.3)
LASER = se2.pose(0.15, -0.05, 0.4)
FANS = {
    'full circle': (-math.pi, 2.0 * math.pi / 360, 360),
    'first and last beam the same': (-math.pi, 2.0 * math.pi / 360, 361),
    'clockwise': (math.pi, -2.0 * math.pi / 360, 360),
    'half': (-math.pi / 2.0, math.pi / 180, 181),
}
TWISTS = [(0.3, 1.0), (0.3, -1.0), (0.5, 2.2), (0.0, -2.2), (0.8, 0.0)]


def pose_at(twist, seconds):
    """Odometry pose (3,) of a robot that drives an arc."""
    speed, turn = twist
    parts = 20
    T = START
    for _ in range(parts):
        T = se2.compose(T, se2.pose(speed * seconds / parts, 0.0, turn * seconds / parts))
    return T


def odometry(twist, rate_hz=50):
    """Stamps (K,) and poses (K, 3) from 1 s before to 1 s after the stamp."""
    since_s = np.arange(-rate_hz, rate_hz + 1) / rate_hz
    stamps = STAMP_NS + np.round(since_s * SECOND).astype(np.int64)
    return stamps, np.array([pose_at(twist, s) for s in since_s])


def measured(fan, twist, *, at_end=False, instant=False, rng=None):
    """The scan of a laser that turns once in PERIOD_S, or that makes all beams at its stamp."""
    first, step, beams = fan
    beam_s = 0.0 if instant else PERIOD_S * abs(step) / (2.0 * math.pi)
    since_s = beam_s * (np.arange(beams) - (beams - 1 if at_end else 0))
    angles = first + step * np.arange(beams)
    ranges = np.array(
        [
            ranges_in(ROOM, se2.compose(pose_at(twist, s), LASER), np.array([angle]))[0]
            for s, angle in zip(since_s, angles, strict=True)
        ]
    )
    if rng is not None:
        ranges[rng.random(beams) < 0.1] = np.inf
    laser = LaserConfig(scan_stamp=AT_END) if at_end else None
    return Scan.create(
        STAMP_NS, ranges, first, step, 0.05, RANGE_MAX_M, LASER, laser, beam_s, PERIOD_S
    )


def errors(scan, expected):
    """Differences of the ranges of beams that have one in both scans, m; and how many have not."""
    both = scan.hit & expected.hit
    return np.abs(scan.ranges_m - expected.ranges_m)[both], np.count_nonzero(~scan.hit)


@pytest.mark.parametrize('twist', TWISTS)
@pytest.mark.parametrize('fan', FANS.values(), ids=FANS)
@pytest.mark.parametrize('at_end', [False, True])
def test_it_is_the_scan_of_a_laser_that_makes_all_beams_at_once(twist, fan, at_end):
    raw = measured(fan, twist, at_end=at_end)
    expected = measured(fan, twist, instant=True)
    off, missing = errors(deskewed(raw, *odometry(twist)), expected)
    # Turning against the sweep leaves a sector that no beam has seen.
    unseen = abs(twist[1]) * PERIOD_S / abs(fan[1])
    assert missing <= np.count_nonzero(~expected.hit) + unseen + 8
    assert np.quantile(off, 0.9) < min(0.012, 0.5 * np.quantile(errors(raw, expected)[0], 0.9))


def test_a_laser_that_is_mounted_upside_down_measures_in_the_other_order():
    twist = (0.3, 1.5)
    fan = FANS['full circle']
    turned_over = measured((-fan[0], -fan[1], fan[2]), twist)
    # In its own frame it turns counter-clockwise.
    own = replace(turned_over, angle_min_rad=-turned_over.angle_min_rad, angle_increment_rad=fan[1])
    seen = Mount(LASER, upside_down=True).apply(own)
    expected = Mount(LASER, upside_down=True).apply(
        replace(own, ranges_m=measured((-fan[0], -fan[1], fan[2]), twist, instant=True).ranges_m)
    )
    off, _ = errors(deskewed(seen, *odometry(twist)), expected)
    assert np.quantile(off, 0.9) < 0.012


def test_beams_without_return_move_too_and_what_no_beam_sees_is_invalid():
    twist = (0.0, -2.2)
    rng = np.random.default_rng(3)
    raw = measured(FANS['full circle'], twist, rng=rng)
    moved = deskewed(raw, *odometry(twist))
    assert np.mean(moved.no_return) == pytest.approx(np.mean(raw.no_return), abs=0.03)
    unseen = np.count_nonzero(np.isnan(moved.ranges_m))
    assert unseen == pytest.approx(2.2 * PERIOD_S / math.radians(1.0), abs=2)


def test_the_scan_of_a_robot_that_stands_is_left_as_it_is():
    raw = measured(FANS['full circle'], (0.0, 0.0))
    assert deskewed(raw, *odometry((0.0, 0.0))) is raw


def stream(beam_period_s, scan_time_s, period_s=PERIOD_S, fan='full circle'):
    """Whether the times of the beams are plausible after some scans at a period."""
    timing = SweepTiming()
    first, step, beams = FANS[fan]
    for k in range(10):
        scan = Scan.create(
            round(k * period_s * SECOND),
            np.ones(beams),
            first,
            step,
            0.05,
            8.0,
            time_increment_s=beam_period_s,
            scan_time_s=scan_time_s,
        )
        timing.add(scan)
    return timing.is_plausible(scan)


@pytest.mark.parametrize('fan', FANS)
@pytest.mark.parametrize('scan_time_s', [0.0, PERIOD_S, 1.0 / 30.0])
def test_times_that_fit_the_measured_period_are_trusted(fan, scan_time_s):
    assert stream(PERIOD_S / 360, scan_time_s, fan=fan)
    assert not stream(PERIOD_S / 360, scan_time_s, 0.5 * PERIOD_S, fan), 'longer than the period'


def test_times_that_fit_the_stated_period_are_trusted_if_scans_are_left_out():
    assert stream(PERIOD_S / 360, PERIOD_S, 3.0 * PERIOD_S)
    assert not stream(PERIOD_S / 360, 0.0, 3.0 * PERIOD_S)


@pytest.mark.parametrize('beam_period_s', [0.0, 1e-9, PERIOD_S, 0.1 / 360, math.nan, 1e30])
def test_times_that_fit_no_period_are_not_trusted(beam_period_s):
    assert not stream(beam_period_s, 0.0)


def pairs_of(scan, twist, until_s):
    """What the synchronizer returns for a scan and the odometry until some time since its stamp."""
    pairing = ScanOdometrySynchronizer()
    found = []
    for k in range(-5, 1):
        stamp_ns = scan.stamp_ns + round(k * PERIOD_S * SECOND)
        ranges = scan.ranges_m + 0.01 * k  # else the laser looks frozen
        found += pairing.add_scan(replace(scan, stamp_ns=stamp_ns, ranges_m=ranges))
    for stamp_ns, T_odom_base in zip(*odometry(twist), strict=True):
        if stamp_ns <= scan.stamp_ns + until_s * SECOND:
            found += pairing.add_odometry(int(stamp_ns), T_odom_base)
    return [pair for pair in found if pair[0].stamp_ns == scan.stamp_ns]


def test_a_scan_waits_for_the_odometry_of_its_last_beam():
    twist = (0.3, 1.0)
    raw = measured(FANS['full circle'], twist)
    assert pairs_of(raw, twist, 0.5 * PERIOD_S) == []
    ((scan, T_odom_base),) = pairs_of(raw, twist, PERIOD_S)
    np.testing.assert_allclose(T_odom_base, START)
    assert np.quantile(errors(scan, measured(FANS['full circle'], twist, instant=True))[0], 0.9) < (
        0.012
    )


def test_a_scan_whose_times_are_nonsense_waits_for_its_stamp_only():
    twist = (0.3, 1.0)
    raw = replace(measured(FANS['full circle'], twist), beam_period_s=1.0)
    ((scan, _),) = pairs_of(raw, twist, 0.0)
    np.testing.assert_array_equal(scan.ranges_m, raw.ranges_m)
