"""scripts/endurance --faults: sequence of faults, what they do to messages, and the judgement."""

import json
import math
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from benchmarks.faults import report
from benchmarks.faults.judge import Counts, Passed, PoseWatch, Record, uncounted
from benchmarks.faults.kinds import KINDS, Fault, random_faults
from benchmarks.faults.stream_faults import StreamFaults
from benchmarks.faults.track import Located, Track
from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.stamps import SECOND_NS
from thinmap_ros.ros import messages

SCAN_NS = SECOND_NS // 5


def test_faults_are_the_same_for_a_seed_and_all_kinds_come_before_any_again() -> None:
    one, again, other = (list(islice(random_faults(seed), 60)) for seed in (1, 1, 2))
    assert one == again != other
    assert {fault.kind.name for fault in one[: len(KINDS)]} == KINDS.keys()
    assert all(10.0 <= f.gap_s <= 30.0 for f in one)
    assert all(f.kind.seconds[0] <= f.duration_s <= f.kind.seconds[1] for f in one)
    only = islice(random_faults(3, ['drop_scan', 'kill_explorer']), 4)
    assert sorted(f.kind.name for f in only) == 2 * ['drop_scan'] + 2 * ['kill_explorer']


def scan_msg(k, nearest_m=2.0):
    ranges = nearest_m + 0.001 * np.arange(5.0)
    scan = Scan.create(k * SCAN_NS, ranges, -1.0, 0.5, 0.05, 8.0)
    return messages.scan_msg(scan, 'laser', 0.2)


def odometry_msg(k):
    T_odom_base = np.array([0.1 * k, 0.0, 0.0])
    return messages.odometry_msg(T_odom_base, (0.5, 0.0), ('odom', 'base_link'), k * SCAN_NS)


def stamp_s(message):
    return messages.stamp_ns(message.header.stamp) / SECOND_NS


@pytest.mark.parametrize(
    ('kind', 'value'),
    [('laser_nan', math.nan), ('laser_zero', 0.0), ('laser_inf', math.inf), ('laser_max', 8.0)],
)
def test_a_blind_laser_gives_one_value_until_the_end_of_the_fault(kind: str, value: float) -> None:
    faults = StreamFaults(0)
    faults.begin(kind, 1)
    (blind,) = faults.scan(scan_msg(1))
    assert np.array_equal(blind.ranges, np.full(5, value, dtype=np.float32), equal_nan=True)
    assert faults.odometry(odometry_msg(1)) == [odometry_msg(1)]
    faults.end()
    assert faults.scan(scan_msg(2)) == [scan_msg(2)]


def test_a_frozen_laser_repeats_ranges_with_new_stamps() -> None:
    faults = StreamFaults(0)
    for seed in (1, 2):
        faults.begin('laser_frozen', seed)
        scans = [faults.scan(scan_msg(k, float(seed + k)))[0] for k in range(3)]
        assert all(scan.ranges == scan_msg(0, float(seed)).ranges for scan in scans)
        assert [stamp_s(scan) for scan in scans] == pytest.approx([0.0, 0.2, 0.4])


def test_messages_are_dropped_repeated_and_silenced() -> None:
    for stream in ('scan', 'odom'):
        counts = {}
        for kind in ('drop', 'repeat', 'silent'):
            faults = StreamFaults(0)
            faults.begin(f'{kind}_{stream}', 1)
            change = faults.scan if stream == 'scan' else faults.odometry
            make = scan_msg if stream == 'scan' else odometry_msg
            counts[kind] = sum(len(change(make(k))) for k in range(100))
            assert faults.is_silent == (kind == 'silent')
        assert 20 < counts['drop'] < 80
        assert 150 < counts['repeat'] < 350
        assert counts['silent'] == 0


def test_stamps_of_scans_and_odometry_are_ahead_for_a_while_or_once() -> None:
    faults = StreamFaults(0)
    for kind, expected in (
        ('scan_stamps', [5.2, 5.4, 0.2, 0.4]),
        ('odom_one_stamp', [0.2, 0.4, 9.2, 0.4]),
    ):
        faults.begin(kind, 1)
        sent = [faults.scan(scan_msg(k))[0] for k in (1, 2)]
        sent += [faults.odometry(odometry_msg(k))[0] for k in (1, 2)]
        assert [stamp_s(message) for message in sent] == pytest.approx(expected)


def test_stamps_of_odometry_are_ahead_or_late_for_a_while() -> None:
    faults = StreamFaults(100 * SECOND_NS)
    shifts = []
    for seed in range(20):
        faults.begin('odom_stamps', seed)
        sent = [stamp_s(faults.odometry(odometry_msg(k))[0]) for k in (1, 2)]
        assert sent[1] - sent[0] == pytest.approx(0.2)
        shifts.append(sent[0] - 100.2)
        faults.end()
        assert stamp_s(faults.odometry(odometry_msg(1))[0]) == pytest.approx(100.2)
    assert min(shifts) < 0.0 < max(shifts)
    assert all(0.1 <= abs(shift) <= 10.0 for shift in shifts)


def test_clock_and_odometry_keep_their_jumps() -> None:
    faults = StreamFaults(100 * SECOND_NS)
    for kind in ('clock_ahead', 'clock_back'):
        before_ns = faults.clock(0)
        faults.begin(kind, 1)
        faults.end()
        shift_ns = faults.clock(0) - before_ns
        assert 1.0 <= abs(shift_ns) / SECOND_NS <= 20.0
        assert (shift_ns > 0) == (kind == 'clock_ahead')
        (scan,) = faults.scan(scan_msg(1))
        assert stamp_s(scan) == pytest.approx(faults.clock(SCAN_NS) / SECOND_NS)
    faults.begin('odom_jump', 1)
    faults.end()
    poses = [messages.pose_from_msg(faults.odometry(odometry_msg(k))[0].pose.pose) for k in (0, 1)]
    assert math.hypot(*poses[0][:2]) >= 0.1
    assert se2.between(*poses) == pytest.approx([0.1, 0.0, 0.0])


def test_errors_are_those_at_the_true_time_of_a_scan() -> None:
    track = Track()
    for k in range(20):
        track.add_truth(k * SCAN_NS, np.array([0.1 * k, 0.0, 0.0]))
    assert track.travelled_m == pytest.approx(1.9)
    track.add_scan(10**12, 5 * SCAN_NS)
    track.add_pose(10**12, np.array([0.5, 0.3, 0.0]))
    assert track.located() == []
    track.add_state(10**12, True)
    assert track.located() == [Located(1.0, pytest.approx(0.3), True)]
    track.align(np.array([1.0, 1.0, 1.0]), 10**12)
    assert se2.compose(track.T_world_map, np.array([1.0, 1.0, 1.0])) == pytest.approx([0.5, 0, 0])


@pytest.mark.parametrize(
    ('error_m', 'is_tracking', 'is_reported', 'seconds', 'violated'),
    [
        (0.2, True, False, 4.0, True),
        (0.2, True, False, 2.0, False),
        (0.05, True, False, 60.0, False),
        (2.0, False, False, 60.0, False),
        (2.0, True, True, 60.0, False),
    ],
)
def test_an_error_that_lasts_and_is_not_reported_is_a_violation(
    error_m: float, is_tracking: bool, is_reported: bool, seconds: float, violated: bool
) -> None:
    watch = PoseWatch()
    for k in range(round(5.0 * seconds)):
        watch.add(Located(0.2 * k, error_m, is_tracking), is_reported)
    assert watch.is_violated == violated


def test_messages_that_a_node_neither_received_nor_counted_are_found() -> None:
    before = Passed({'scan': 10, 'odom': 40}, 2)
    now = Passed({'scan': 30, 'odom': 120}, 5)
    first = Counts(8, 2, 0)
    assert uncounted('scan', first, Counts(26, 4, 3), now, before) == ''
    assert '2 of 20' in uncounted('scan', first, Counts(26, 2, 3), now, before)
    assert '3 were never sent, 2 counted' in uncounted('scan', first, Counts(28, 2, 2), now, before)
    assert uncounted('odom', first, Counts(88, 2, 0), now, before) == ''


def test_table_and_file_name_what_must_not_happen(tmp_path: Path) -> None:
    fault = Fault(0, KINDS['laser_inf'], 10.0, 20.0, 5)
    records = [
        Record(None, 0.0, driven_m=9.0),
        Record(fault, 12.0, driven_m=1.9, recovered_s=6.0),
        Record(fault, 50.0, driven_m=7.5, collisions=1),
    ]
    lines = report.table(records).splitlines()
    assert lines[1].split() == ['laser_inf', '2', '1', '0.00', '7.50', '6']
    assert lines[2].split() == ['none', '1', '0', '0.00', '9.00', '-']
    assert lines[3:] == [
        'laser_inf at 50.0 s: 1 collisions',
        'laser_inf at 50.0 s: drove 7.50 m, expected 2.0 m',
    ]
    report.write_json(tmp_path / 'faults.json', records, {'seed': 4})
    found = json.loads((tmp_path / 'faults.json').read_text())
    assert found['seed'] == 4
    assert [len(record['violations']) for record in found['records']] == [0, 0, 2]
    assert found['records'][1]['seed'] == 5
