"""What is known of a laser belongs to it: to the frame of its scans."""

import math
from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, drive, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.odometry import OdometryIncrements
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.core.sensing.beams import FROZEN, NO_RETURNS
from thinmap_ros.core.sensing.consistency import ConsistencyMonitor
from thinmap_ros.core.sensing.synchronizer import Lasers, ScanOdometrySynchronizer
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import Estimate
from thinmap_ros.pipeline import Pipeline, PipelineConfig

START = se2.pose(2.0, 2.0, 0.0)
PERIOD_NS = 100_000_000
MOUNTS = {'front': se2.pose(0.25, 0.15, 0.6), 'rear': se2.pose(-0.25, -0.15, 0.6 - math.pi)}
NAMES = tuple(MOUNTS)


def as_it_is(scan, k):
    return scan


def rear_only(spoil):
    """Spoil the scans of the rear laser alone."""
    return lambda scan, k: spoil(scan, k) if scan.frame == 'rear' else scan


def driven(steps, spoil=as_it_is, seed=7):
    """Scans of both lasers at one time, and odometry there, (3,), and the true pose (3,)."""
    rng = np.random.default_rng(seed)
    for k, (truth, odom) in enumerate(drive(steps, rng, START)):
        for frame, mount in MOUNTS.items():
            scan = scan_in(ROOM, truth, rng, (k + 1) * PERIOD_NS, T_base_laser=mount)
            yield spoil(replace(scan, frame=frame), k), odom, truth


def checked(steps, spoil):
    """Scans as the synchronizer gives them, and the synchronizer."""
    pairing = ScanOdometrySynchronizer()
    found = []
    for scan, odom, _ in driven(steps, spoil):
        pairing.add_odometry(scan.stamp_ns, odom)
        found += [ready for ready, _ in pairing.add_scan(scan)]
    return found, pairing


def of(scans, frame):
    return [scan for scan in scans if scan.frame == frame]


def dropped(scan, k):
    ranges = scan.ranges_m.copy()
    ranges[np.random.default_rng(k).random(ranges.size) < 0.5] = np.inf
    return replace(scan, ranges_m=ranges)


def test_one_that_drops_out_is_named_and_the_other_is_trusted():
    scans, pairing = checked(80, rear_only(dropped))
    assert of(scans, 'rear')[-1].drops_out
    assert not any(scan.drops_out for scan in of(scans, 'front'))
    (text,) = pairing.warnings.values()
    assert text.startswith('rear: ') and 'no return is taken as unknown' in text


def test_one_that_is_frozen_or_has_failed_is_blind_and_the_other_is_not():
    kept = []

    def freeze(scan, k):
        kept.append(scan.ranges_m)
        return replace(scan, ranges_m=kept[min(k, 40)])

    def fail(scan, k):
        return scan if k < 40 else replace(scan, ranges_m=np.full_like(scan.ranges_m, np.inf))

    for spoil, fault in ((freeze, FROZEN), (fail, NO_RETURNS)):
        scans, _ = checked(100, rear_only(spoil))
        assert [scan.fault for scan in of(scans, 'rear')][-40:] == [fault] * 40
        assert not any(scan.is_blind for scan in of(scans, 'front'))


def test_a_value_for_no_return_is_that_of_its_laser():
    def limited(scan, k):
        return replace(scan, ranges_m=np.minimum(scan.ranges_m, 2.5))

    scans, pairing = checked(30, rear_only(limited))
    assert {scan.range_max_m for scan in of(scans, 'rear')[20:]} == {2.5}
    assert {scan.range_max_m for scan in of(scans, 'front')} == {MAX_M}
    (text,) = pairing.warnings.values()
    assert text.startswith('rear: ')


MAX_M = next(driven(1))[0].range_max_m


def test_echoes_of_one_laser_are_compared_with_its_first():
    """Most of their beams have no return where the first echo has one: they clear nothing."""

    def echoes(steps):
        rng = np.random.default_rng(3)
        for k, (truth, odom) in enumerate(drive(steps, rng, START)):
            first = replace(scan_in(ROOM, truth, rng, (k + 1) * PERIOD_NS), frame='laser_0')
            few = np.where(rng.random(first.ranges_m.size) < 0.2, first.ranges_m, np.inf)
            yield first, odom
            yield replace(first, ranges_m=few, frame='laser_1'), odom

    pairing = ScanOdometrySynchronizer()
    scans = []
    for scan, odom in echoes(60):
        pairing.add_odometry(scan.stamp_ns, odom)
        scans += [ready for ready, _ in pairing.add_scan(scan)]
    assert all(scan.is_blind for scan in of(scans, 'laser_1'))
    assert not any(scan.is_blind for scan in of(scans, 'laser_0'))


def at(frame, seconds):
    made = Scan.create(round(seconds * SECOND_NS), [1.0], 0.0, 0.1, 0.1, 8.0, MOUNTS[frame])
    return replace(made, frame=frame)


def paired(arrivals, capacity=20):
    """Frames and stamps, s, of scans that arrive before odometry from 0 s to 10 s."""
    pairing = ScanOdometrySynchronizer(capacity)
    pairing.add_odometry(0, np.zeros(3))
    for arrival in arrivals:
        assert pairing.add_scan(at(*arrival)) == []
    ready = []
    for k in range(1, 11):
        ready += pairing.add_odometry(k * SECOND_NS, np.zeros(3))
    return [(scan.frame, scan.stamp_ns / SECOND_NS) for scan, _ in ready], pairing.dropped


def test_scans_of_several_lasers_wait_in_the_order_of_their_stamps():
    arrivals = [('front', 1.0), ('front', 1.2), ('rear', 0.9), ('rear', 1.0), ('rear', 1.1)]
    found, dropped = paired(arrivals)
    expected = [('rear', 0.9), ('front', 1.0), ('rear', 1.0), ('rear', 1.1), ('front', 1.2)]
    assert found == expected and dropped == 0


def test_the_order_of_one_laser_is_that_of_its_scans():
    arrivals = [('front', 1.2), ('front', 1.0), ('rear', 1.1)]
    assert paired(arrivals)[0] == [('front', 1.2), ('front', 1.0), ('rear', 1.1)]


def test_capacity_counts_for_each_laser():
    arrivals = [('rear', 1.0)] + [('front', 1.0 + 0.1 * k) for k in range(5)]
    found, dropped = paired(arrivals, capacity=3)
    assert [frame for frame, _ in found] == ['rear', 'front', 'front', 'front'] and dropped == 2


def test_a_clock_that_is_ahead_stops_its_laser_alone():
    """The other one continues, and so does the laser itself once its clock is right."""
    arrivals = [('rear', 5.0), ('front', 1.0), ('rear', 5.1), ('front', 1.1), ('rear', 1.2)]
    found, dropped = paired(arrivals)
    assert found == [('front', 1.0), ('front', 1.1), ('rear', 1.2)] and dropped == 2


@pytest.mark.parametrize('late_steps', [0, 1])
def test_scans_that_come_later_than_newer_ones_of_another_laser_are_used(late_steps):
    """Live: each scan of the rear laser arrives after the newer one of the front laser."""
    x, y, yaw = START.tolist()
    localizer = LocalizerConfig(initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw)
    line = Pipeline(PipelineConfig(localizer=localizer, scans_per_graph=1000))
    pairing = ScanOdometrySynchronizer()
    off = []
    waiting = {frame: deque() for frame in NAMES}
    scans = 0
    truths = {}
    for scan, odom, truth in driven(100):
        truths[scan.stamp_ns] = truth
        ready = pairing.add_odometry(scan.stamp_ns, odom)
        waiting[scan.frame].append(scan)
        if len(waiting[scan.frame]) > late_steps * (scan.frame == 'rear'):
            ready += pairing.add_scan(waiting[scan.frame].popleft())
        for each, T_odom_base in ready:
            scans += 1
            estimate = line.step(each, T_odom_base).estimate
            assert not estimate.is_lost
            off.append(estimate.T_map_base - truths[each.stamp_ns])
    assert scans == 200 - late_steps and pairing.dropped == 0
    assert np.sqrt(np.square(np.array(off)[:, :2]).sum(axis=1).mean()) < 0.02
    assert line.warnings == []


def test_the_mount_of_one_laser_is_checked_with_its_own_scans():
    information = np.diag([1e4, 1e4, 4e4])
    monitor = ConsistencyMonitor()
    askew = se2.pose(0.0, 0.0, math.radians(30.0))
    faults = {frame: [] for frame in NAMES}
    for scan, odom, truth in driven(300):
        matched = se2.compose(truth, askew) if scan.frame == 'rear' else truth
        estimate = Estimate(matched, np.eye(3), np.zeros(3), scan_information=information)
        faults[scan.frame].append(monitor.checked(scan, odom, estimate).mount_fault)
    assert faults['rear'][-1].startswith('rear: laser turned by')
    assert not any(faults['front'])
    assert all(text.startswith('rear: laser') for text in monitor.warnings.values())
    assert monitor.warnings and monitor.reported.keys() >= monitor.warnings.keys()


def test_lasers_with_two_delays_are_one_sequence_of_motions():
    """The stamps of one laser are later by 0.3 s; the robot turns at 1 rad/s."""
    pairing = ScanOdometrySynchronizer()
    increments = OdometryIncrements()
    turned = 0.0
    for k in range(80):
        ns = k * SECOND_NS // 20
        ready = pairing.add_odometry(ns, se2.pose(0.0, 0.0, ns / SECOND_NS))
        if k % 2:
            late = replace(at('front', 0.0), stamp_ns=ns, delay_s=0.3)
            ready += pairing.add_scan(late)
            ready += pairing.add_scan(replace(at('rear', 0.0), stamp_ns=ns))
        for scan, T_odom_base in ready:
            increment = increments.add(scan, T_odom_base)
            assert not increment.discontinuity
            turned += float(increment.T_before_base[2])
    assert not increments.rejected and turned > 3.0


def test_two_lasers_of_one_kind_above_each_other_are_no_echoes():
    lasers = Lasers()
    front = at('front', 1.0)
    above = replace(front, frame='above', stamp_ns=front.stamp_ns + PERIOD_NS // 3)
    assert lasers.of(front) is lasers.of(replace(front, frame='echo'))
    assert lasers.of(front) is not lasers.of(above)


def test_the_scale_of_the_odometry_is_found_beside_a_laser_that_matches_nothing():
    monitor = ConsistencyMonitor()
    sure = np.diag([1e6, 1e6, 1e6])
    for k in range(60):
        x = 0.1 * k
        estimate = Estimate(se2.pose(x, 0.0, 0.0), np.zeros((3, 3)), np.zeros(3))
        matched = replace(estimate, scan_information=sure)
        T_odom_base = se2.pose(0.7 * x, 0.0, 0.0)
        monitor.checked(at('front', 0.1 * k), T_odom_base, matched)
        monitor.checked(at('rear', 0.1 * k + 0.05), T_odom_base, estimate)
    assert 'moves 30 % too little' in monitor.odometry_scale.warning
