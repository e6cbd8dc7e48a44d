"""Odometry at the stamp of a scan, for any order of arrival."""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.odometry import OdometryBuffer, OdometryIncrements
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer

SECOND = 1_000_000_000


def scan_at(stamp_ns):
    return Scan.create(stamp_ns, [1.0], 0.0, 0.1, 0.1, 8.0)


def filled(*stamps):
    buffer = OdometryBuffer()
    for stamp in stamps:
        buffer.add(stamp, se2.pose(stamp / SECOND, 0, 0))
    return buffer


def test_a_pose_on_a_sample_is_that_sample_and_between_two_is_interpolated():
    buffer = filled(0, SECOND)
    assert buffer.interpolate(SECOND)[0] == 1.0
    assert buffer.interpolate(SECOND // 4)[0] == pytest.approx(0.25)


def test_outside_of_what_is_known_there_is_no_pose():
    buffer = filled(SECOND, 2 * SECOND)
    assert buffer.interpolate(SECOND - 1) is None
    assert buffer.interpolate(2 * SECOND + 1) is None
    assert OdometryBuffer().interpolate(0) is None


def test_a_late_sample_takes_its_place():
    buffer = filled(0, 2 * SECOND, SECOND)
    assert buffer.latest_stamp_ns == 2 * SECOND
    assert buffer.interpolate(3 * SECOND // 2)[0] == pytest.approx(1.5)


def test_a_clock_set_back_resets_it():
    buffer = filled(100 * SECOND, 5 * SECOND)
    assert buffer.latest_stamp_ns == 5 * SECOND


def test_old_samples_are_forgotten():
    buffer = filled(*(i * SECOND // 100 for i in range(5000)))
    assert buffer.interpolate(0) is None
    assert buffer.interpolate(49 * SECOND)[0] == pytest.approx(49.0)


def test_nan_is_refused():
    with pytest.raises(InputError, match='finite'):
        OdometryBuffer().add(0, np.array([math.nan, 0, 0]))


def test_a_scan_waits_for_odometry_as_new_as_itself():
    pairing = ScanOdometrySynchronizer()
    assert pairing.add_odometry(0, se2.pose(0, 0, 0)) == []
    assert pairing.add_scan(scan_at(SECOND)) == []
    assert pairing.add_odometry(SECOND // 2, se2.pose(0.5, 0, 0)) == []
    ((scan, T_odom_base),) = pairing.add_odometry(SECOND * 3 // 2, se2.pose(1.5, 0, 0))
    assert scan.stamp_ns == SECOND
    assert T_odom_base[0] == pytest.approx(1.0)


def driven(pairing, seconds, ahead_s=lambda s: 0.0):
    """Pairs of a drive at 1 m/s: odometry at 50 Hz with stamps that are ahead, scans at 10 Hz."""
    pairs = []
    for k in range(round(50 * seconds)):
        s = k / 50
        pairs += pairing.add_odometry(round((s + ahead_s(s)) * SECOND), se2.pose(s, 0, 0))
        if k % 5 == 2:
            pairs += pairing.add_scan(scan_at(round(s * SECOND)))
    return pairs


@pytest.mark.parametrize(
    ('ahead_s', 'lost'),
    [
        (lambda s: 9.0 if s == 3.0 else 0.0, 1),
        (lambda s: 5.0 if 3.0 <= s < 8.0 else 0.0, 51),
        (lambda s: -5.0 if 6.0 <= s < 8.0 else 0.0, 21),
    ],
    ids=['one sample 9 s ahead', 'ahead for 5 s', 'behind for 2 s'],
)
def test_odometry_with_wrong_stamps_gives_no_scan_a_wrong_pose(ahead_s, lost):
    pairing = ScanOdometrySynchronizer()
    pairs = driven(pairing, 20, ahead_s)
    for scan, T_odom_base in pairs:
        assert T_odom_base[0] == pytest.approx(scan.stamp_ns / SECOND, abs=0.021)
    assert len(pairs) >= 199 - lost
    assert len(pairs) + pairing.dropped + pairing.waiting == 200
    assert pairing.discarded_odometry > 0


def test_a_pause_of_the_odometry_is_not_interpolated():
    pairing = ScanOdometrySynchronizer()
    pairing.add_odometry(0, se2.pose(0, 0, 0))
    pairing.add_scan(scan_at(SECOND))
    assert pairing.add_odometry(3 * SECOND, se2.pose(2, 0, 0)) == []
    assert pairing.dropped == 1


def test_scans_older_than_all_odometry_and_too_many_waiting_are_dropped_and_counted():
    pairing = ScanOdometrySynchronizer(capacity=2)
    pairing.add_odometry(10 * SECOND, se2.pose(0, 0, 0))
    assert pairing.add_scan(scan_at(9 * SECOND)) == []
    for stamp in (11, 12, 13):
        pairing.add_scan(scan_at(stamp * SECOND))
    assert pairing.dropped == 2


@pytest.mark.parametrize('gap_s', [0.2, 120.0, 1000.0, 1e6])
def test_odometry_that_is_kilometres_away_after_a_gap_is_a_discontinuity(gap_s):
    increments = OdometryIncrements()
    increments.add(scan_at(0), np.zeros(3))
    far = increments.add(scan_at(int(gap_s * SECOND)), se2.pose(2000.0, 0.0, 0.0))
    assert far.T_before_base.tolist() == [0.0, 0.0, 0.0]
    assert 0.0 < far.discontinuity_m < 400.0
    assert increments.rejected == 1
    back = increments.add(scan_at(int((gap_s + 0.2) * SECOND)), se2.pose(2000.1, 0.0, 0.0))
    assert back.T_before_base[0] == pytest.approx(0.1)
    assert increments.rejected == 1


JUMPS = [
    se2.pose(0.0, 0.0, 1.5),
    se2.pose(0.0, 0.0, -2.5),
    se2.pose(2.0, 0.0, 0.0),
    se2.pose(-3.4, 1.0, 0.2),
]


@pytest.mark.parametrize('jump', JUMPS)
def test_a_motion_that_no_robot_makes_in_the_time_is_a_discontinuity(jump):
    increments = OdometryIncrements()
    increments.add(scan_at(0), np.zeros(3))
    step = increments.add(scan_at(SECOND // 5), jump)
    assert not step.T_before_base.any()
    assert step.discontinuity_m > 0.0
    moved_m = math.hypot(jump[0], jump[1])
    assert f'jumped by {moved_m:.2f} m, {math.degrees(jump[2]):.0f} deg within 0.20 s' in (
        step.discontinuity
    )


@pytest.mark.parametrize('jump', JUMPS)
def test_odometry_that_is_reset_while_it_is_silent_is_a_discontinuity(jump):
    """Its samples end for 5 s, in which a robot could have driven that far."""
    pairing = ScanOdometrySynchronizer()
    increments = OdometryIncrements()
    steps = []
    for k in range(200):
        s = k / 20
        is_silent = 4.0 < s < 9.0
        T_odom_base = jump if s >= 9.0 else np.zeros(3)
        pairs = [] if is_silent else pairing.add_odometry(round(s * SECOND), T_odom_base)
        pairs += pairing.add_scan(scan_at(round((s - 0.01) * SECOND))) if k % 4 == 0 else []
        steps += [increments.add(*pair) for pair in pairs]
    assert [step.discontinuity_m > 0.0 for step in steps].count(True) == 1
    assert not any(step.T_before_base.any() for step in steps)


def test_a_drive_past_a_silent_laser_is_known():
    """Odometry comes at its usual rate while scans are missing for 5 s."""
    pairing = ScanOdometrySynchronizer()
    increments = OdometryIncrements()
    steps = []
    for k in range(200):
        s = k / 20
        pairs = pairing.add_odometry(round(s * SECOND), se2.pose(0.5 * s, 0.0, 0.0))
        is_silent = 4.0 < s < 9.0
        pairs += [] if is_silent or k % 4 else pairing.add_scan(scan_at(round(s * SECOND)))
        steps += [increments.add(*pair) for pair in pairs]
    assert max(float(step.T_before_base[0]) for step in steps) == pytest.approx(2.6, abs=0.11)
    assert not any(step.discontinuity for step in steps)


def test_a_pose_within_a_jump_is_not_interpolated():
    buffer = OdometryBuffer()
    buffer.add(0, np.zeros(3))
    buffer.add(SECOND // 20, se2.pose(0.0, 0.0, 1.0))
    assert buffer.interpolate(SECOND // 40) is None
