"""Turns of scans against those of the odometry: only a mirrored laser contradicts it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, corridor, drive, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.sensing.consistency import TurnComparison

START = se2.pose(2.0, 2.0, 0.0)
STEPS = 700


def as_is(scan):
    return scan


def mirrored(scan):
    """The scan of a driver whose increment has the wrong sign."""
    angles = {
        'angle_min_rad': -scan.angle_min_rad,
        'angle_increment_rad': -scan.angle_increment_rad,
    }
    return replace(scan, **angles)


def inverted(T):
    """Odometry whose yaw has the wrong sign."""
    return np.array([T[0], -T[1], -T[2]])


def compared(pairs, spoil=as_is, odometry=as_is):
    comparison = TurnComparison()
    for scan, odom in pairs:
        comparison.add(spoil(scan), odometry(odom))
    return comparison


def in_the_room(steps=STEPS, **options):
    rng = np.random.default_rng(7)
    for truth, odom in drive(steps, rng, START):
        yield scan_in(ROOM, truth, rng, **options), odom


@pytest.mark.parametrize('clockwise', [False, True])
@pytest.mark.parametrize('yaw', [0.0, math.pi])
def test_turns_of_a_right_laser_are_those_of_the_odometry(clockwise, yaw):
    mount = se2.pose(0.2, -0.1, yaw)
    comparison = compared(in_the_room(T_base_laser=mount, clockwise=clockwise))
    assert not comparison.are_opposed
    turns = comparison.turns
    assert turns.odometry > 5.0
    assert turns.scans == pytest.approx(turns.odometry, rel=0.1)


@pytest.mark.parametrize(
    ('spoil', 'odometry'), [(mirrored, as_is), (as_is, inverted)], ids=['laser', 'odometry']
)
def test_a_mirrored_laser_or_odometry_is_opposed_after_a_turn_or_two(spoil, odometry):
    comparison = compared(in_the_room(), spoil, odometry)
    assert comparison.are_opposed
    turns = comparison.turns
    assert turns.scans == pytest.approx(-turns.odometry, rel=0.1)
    soon = TurnComparison()
    for scan, odom in in_the_room():
        soon.add(spoil(scan), odometry(odom))
        if soon.are_opposed:
            break
    assert soon.turns.odometry < 4.0


def test_both_mirrored_agree_again():
    assert not compared(in_the_room(), mirrored, inverted).are_opposed


def round_room_scan(truth, rng, radius_m=3.0):
    """All ranges of a round room around the origin, 360 beams."""
    angles = np.radians(np.arange(360.0)) + truth[2]
    along = truth[0] * np.cos(angles) + truth[1] * np.sin(angles)
    far = np.hypot(truth[0], truth[1])
    ranges = np.sqrt(along**2 - far**2 + radius_m**2) - along + rng.normal(0.0, 0.01, 360)
    return Scan.create(0, ranges, 0.0, math.radians(1.0), 0.05, 8.0)


def curves(rng, steps=STEPS):
    """Poses (3,) of a drive in curves around the origin, within 1.5 m of it."""
    truth = np.zeros(3)
    for _ in range(steps):
        home = math.atan2(-truth[1], -truth[0])
        far = math.hypot(truth[0], truth[1])
        turn = 0.1 * np.sign(se2.wrap(home - truth[2])) if far > 1.0 else rng.uniform(-0.1, 0.1)
        truth = se2.compose(truth, np.array([0.04, 0.0, turn]))
        yield truth


def turning_in_place(rng, steps=STEPS):
    for k in range(steps):
        yield se2.pose(0.0, 0.0, 0.1 * k)


@pytest.mark.parametrize('motion', [curves, turning_in_place])
def test_a_round_room_contradicts_nothing(motion):
    rng = np.random.default_rng(3)
    pairs = [(round_room_scan(truth, rng), truth) for truth in motion(rng)]
    assert not compared(pairs).are_opposed


def test_a_smooth_corridor_contradicts_nothing():
    rng = np.random.default_rng(3)
    walls = np.array([[0.0, -1.2, 60.0, -1.2], [0.0, 1.2, 60.0, 1.2]])
    truth = se2.pose(5.0, 0.0, 0.0)
    pairs = []
    for k in range(STEPS):
        truth = se2.compose(truth, np.array([0.05, 0.0, 0.06 * math.cos(0.2 * k)]))
        pairs.append((scan_in(walls, truth, rng), truth))
    assert not compared(pairs).are_opposed


def with_people(scan, rng):
    """A third of the beams hit people that are anywhere, in other places in each scan."""
    ranges = scan.ranges_m.copy()
    for _ in range(6):
        first = int(rng.integers(ranges.size - 10))
        ranges[first : first + 10] = np.minimum(ranges[first : first + 10], rng.uniform(0.5, 2.0))
    return replace(scan, ranges_m=ranges)


def test_a_crowd_hides_neither_the_right_nor_the_wrong_direction():
    rng = np.random.default_rng(5)
    assert not compared(in_the_room(), lambda scan: with_people(scan, rng)).are_opposed
    assert compared(in_the_room(), lambda scan: mirrored(with_people(scan, rng))).are_opposed


@pytest.mark.parametrize(
    'odometry',
    [
        pytest.param(lambda T: np.zeros(3), id='none'),
        pytest.param(lambda T: T * [1.0, 1.0, 0.0], id='that does not turn'),
        pytest.param(lambda T: T + [0.0, 0.0, 40.0 * math.sin(700.0 * T[0])], id='of noise'),
        pytest.param(lambda T: T * math.nan, id='that is not finite'),
    ],
)
def test_a_useless_odometry_is_not_opposed(odometry):
    assert not compared(in_the_room(), odometry=odometry).are_opposed


def test_scans_without_hits_are_no_turns():
    rng = np.random.default_rng(2)
    hall = np.array([[1e3, -1.0, 1e3, 1.0]])
    pairs = [(scan_in(hall, truth, rng), odom) for truth, odom in drive(300, rng, START)]
    assert compared(pairs).turns.odometry == 0.0


def test_niches_of_a_corridor_are_enough():
    rng = np.random.default_rng(3)
    walls = corridor(40.0)
    truth = se2.pose(3.0, 0.0, 0.0)
    pairs = []
    for k in range(STEPS):
        truth = se2.compose(truth, np.array([0.04, 0.0, 0.08 * math.cos(0.2 * k)]))
        pairs.append((scan_in(walls, truth, rng), truth))
    assert not compared(pairs).are_opposed
    assert compared(pairs, mirrored).are_opposed
