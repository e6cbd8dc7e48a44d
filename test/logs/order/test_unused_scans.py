"""Scans without odometry are counted by reason, with the times that explain them."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer
from thinmap_ros.logs.log import ScanEvent
from thinmap_ros.logs.reading import SilentLasers

YEAR_S = 365.25 * 86400.0


def scan(s: float, range_m: float = 1.0, frame: str = '') -> Scan:
    return replace(Scan.create(round(s * SECOND_NS), [range_m], 0.0, 0.1, 0.1, 8.0), frame=frame)


def reasons(
    odometry: list[tuple[float, float]],
    scans_s: list[float],
    capacity: int = 20,
    arrived_s: list[float] | None = None,
) -> dict[str, int]:
    """Reasons of scans with stamps; odometry: stamps (s) and x (m); arrived_s: of the scans."""
    pairing = ScanOdometrySynchronizer(capacity)
    arrivals = scans_s if arrived_s is None else arrived_s
    events = [(s, 0, s, x) for s, x in odometry]
    events += [(at, 1, s, 0.1 * k) for k, (at, s) in enumerate(zip(arrivals, scans_s, strict=True))]
    used = 0
    for _, kind, s, value in sorted(events):
        if kind:
            used += len(pairing.add_scan(scan(s, 1.0 + value)))
        else:
            pose: Array = np.array([value, 0.0, 0.0])
            used += len(pairing.add_odometry(round(s * SECOND_NS), pose))
    used += len(pairing.finish())
    found = pairing.reasons()
    assert used + sum(found.values()) == len(scans_s)
    assert sum(found.values()) == pairing.dropped + pairing.waiting
    return found


def still(*stamps_s: float) -> list[tuple[float, float]]:
    return [(s, 0.0) for s in stamps_s]


GAPS = 'in gaps of the odometry of up to {}: expected at most 2 s'


@pytest.mark.parametrize(
    ('odometry', 'scans_s', 'expected'),
    [
        (still(1.0, 2.0), [], {}),
        ([], [1.0, 2.0], {'without any odometry': 2}),
        (still(10.0, 11.0), [8.5, 9.9], {'before the first odometry, by up to 1.5 s': 2}),
        (still(10.0), [10.5, 12.0], {'after the last odometry, by up to 2 s': 2}),
        (still(1.0), [1.0 + 10 * YEAR_S], {'after the last odometry, by up to 10 years': 1}),
        (still(30 * 86400.0), [0.0], {'before the first odometry, by up to 30 days': 1}),
        (still(0.0, 3.0, 7.5), [1.0, 4.0, 5.0], {GAPS.format('4.5 s'): 3}),
        (still(0.0, 1.0), [0.5], {}),
        (
            [(0.0, 0.0), (0.05, 20.0), (0.1, 20.0)],
            [0.01, 0.02, 0.06],
            {
                'in jumps of the odometry of up to 20 m, 0 deg within 0.05 s: reset, in mm or in '
                'degrees?': 2
            },
        ),
        (still(0.0, 1.0), [0.5, 0.6, 1.9, 2.0], {'after the last odometry, by up to 1 s': 2}),
    ],
)
def test_reasons(
    odometry: list[tuple[float, float]], scans_s: list[float], expected: dict[str, int]
) -> None:
    assert reasons(odometry, scans_s) == expected


def test_scans_that_wait_for_too_long_get_the_reason_that_turns_out() -> None:
    many = [1.0 + 0.1 * k for k in range(50)]
    early = reasons(still(10.0, 11.0), many, capacity=3)
    assert early == {'before the first odometry, by up to 9 s': 50}
    assert reasons(still(0.0, 10.0), many, capacity=3) == {GAPS.format('10 s'): 50}
    assert reasons(still(0.0), many, 3) == {'after the last odometry, by up to 5.9 s': 50}
    crowded = {'with too many others between two samples of the odometry': 7}
    assert reasons(still(0.0, 1.0), [0.05 + 0.05 * k for k in range(10)], capacity=3) == crowded


def test_a_scan_that_is_received_late_or_with_a_stamp_ahead_has_that_reason() -> None:
    odometry = still(*np.arange(0.0, 60.0, 0.05).tolist())
    late = reasons(odometry, [5.0, 6.0], arrived_s=[5.0, 50.0])
    assert [*late.values()] == [1]
    assert next(iter(late)).startswith('received too late, by up to 44 s after their odometry')
    ahead = reasons(odometry, [5.0, 25.0, 6.0, 7.0], arrived_s=[5.0, 5.5, 6.0, 7.0])
    assert ahead == {'with a stamp ahead of later ones, by up to 19 s': 1}


def test_scans_whose_stamp_never_changes_have_that_reason() -> None:
    found = reasons(still(100.0, 100.1), [0.0] * 5, arrived_s=[100.0 + 0.1 * k for k in range(5)])
    assert found == {
        'with the stamp of the scan before': 4,
        'before the first odometry, by up to 100 s': 1,
    }


def moved(stamps_s: list[float], frames: str = '', equal: bool = False) -> list[float]:
    """Stamps (s) of the scans as they are paired; frames: one letter a scan."""
    pairing = ScanOdometrySynchronizer(100)
    pairing.add_odometry(0, np.zeros(3))
    for k, s in enumerate(stamps_s):
        pairing.add_scan(scan(s, 1.0 if equal else 1.0 + 0.01 * k, frames[k : k + 1]))
    ready = [pair for s in range(1, 9) for pair in pairing.add_odometry(s * 10**9, np.zeros(3))]
    return [round(made.stamp_ns / SECOND_NS, 6) for made, _ in ready]


@pytest.mark.parametrize('size', [2, 3, 5])
def test_scans_that_arrive_in_packets_get_their_times_back(size: int) -> None:
    true_s = [round(0.1 * k, 6) for k in range(1, 1 + 4 * size)]
    found = moved([true_s[k - k % size] for k in range(len(true_s))])
    # Of the first packet the period is not known yet.
    assert found == [true_s[0], *true_s[size:]]


def test_a_single_scan_with_the_stamp_of_the_one_before_is_moved_on_by_the_period() -> None:
    assert moved([0.1, 0.2, 0.3, 0.3, 0.5, 0.6]) == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]


def test_stamps_of_two_lasers_and_of_a_scan_that_comes_twice_are_kept() -> None:
    pairs = [0.1, 0.1, 0.2, 0.2, 0.3, 0.3]
    assert moved(pairs, frames='frfrfr') == pairs
    assert moved(pairs, equal=True) == pairs


def test_sectors_of_one_revolution_keep_their_stamp() -> None:
    pairing = ScanOdometrySynchronizer()
    pairing.add_odometry(0, np.zeros(3))
    for k in range(6):
        first_rad = 1.5 * (k % 2)
        pairing.add_scan(Scan.create(10**8 * (1 + k // 2), [1.0 + k], first_rad, 0.1, 0.1, 80.0))
    ready = pairing.add_odometry(10**9, np.zeros(3))
    assert [made.stamp_ns // 10**8 for made, _ in ready] == [1, 1, 2, 2, 3, 3]
    assert not pairing.warnings


def test_moved_stamps_are_told_with_their_number() -> None:
    pairing = ScanOdometrySynchronizer()
    for k in range(6):
        pairing.add_scan(scan(0.2 * (k // 2), 1.0 + k))
    (text,) = pairing.warnings.values()
    assert text.startswith('2 scans with the stamp of the scan before') and '0.100 s' in text


def test_moved_stamps_of_one_of_two_lasers_are_told() -> None:
    pairing = ScanOdometrySynchronizer(100)
    for k in range(20):
        pairing.add_scan(scan(0.2 * (k // 2), 1.0 + k, 'packets'))
        pairing.add_scan(scan(0.1 * k, 1.0 + k, 'honest'))
    (text,) = pairing.warnings.values()
    assert text.startswith('9 scans with the stamp of the scan before')


def test_a_coarse_clock_of_two_lasers_with_their_own_poses_is_kept() -> None:
    pairing = ScanOdometrySynchronizer()
    for k in range(6):
        ns = k // 2 * 10**9
        pairing.add_odometry(ns, np.array([0.1 * k, 0.0, 0.0]))
        for frame in ('front', 'rear'):
            pairing.add_scan(scan(ns / 1e9, 1.0 + k, frame))
    assert not pairing.warnings and not pairing.dropped


def test_a_coarse_clock_of_scans_with_their_own_poses_is_kept() -> None:
    pairing = ScanOdometrySynchronizer()
    pairs = []
    for k in range(6):
        ns = k // 2 * 10**9
        pairs += pairing.add_odometry(ns, np.array([0.1 * k, 0.0, 0.0]))
        pairs += pairing.add_scan(scan(ns / 1e9, 1.0 + k))
    assert not pairing.warnings and not pairing.dropped
    assert [round(float(T[0]), 6) for _, T in pairs] == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
    assert all(a.stamp_ns <= b.stamp_ns for (a, _), (b, _) in pairwise(pairs))


def test_scans_of_several_lasers_are_counted_by_laser() -> None:
    pairing = ScanOdometrySynchronizer()
    pairing.add_odometry(SECOND_NS, np.zeros(3))
    for frame, seconds in (('front', 1.0), ('rear', 1.0), ('rear', 3.0)):
        pairing.add_scan(scan_of(frame, seconds))
    assert pairing.reasons() == {'of rear after the last odometry, by up to 2 s': 1}


def scan_of(frame: str, seconds: float) -> Scan:
    scan = Scan.create(round(seconds * SECOND_NS), [1.0], 0.0, 0.1, 0.1, 8.0)
    return replace(scan, frame=frame)


FULL = np.arange(0.0, 40.0, 0.1)
SLOW = np.arange(0.0, 40.0, 2.5)


@pytest.mark.parametrize(
    ('front', 'rear', 'expected'),
    [
        (FULL, FULL, []),
        (FULL, SLOW, []),
        (FULL, [], []),
        (FULL, FULL[:200], ['rear: no scan for 19.9 s, from 20.0 s on']),
        (FULL, FULL[FULL > 30.05], ['rear: no scan for 30.1 s, from 0.0 s on']),
        (FULL, FULL[(FULL < 10.05) | (FULL > 14.05)], ['rear: no scan for 4.0 s, from 10.1 s on']),
        (FULL, [5.0], ['rear: no scan for 34.8 s, from 5.1 s on']),
        # The recording paused: no laser measured.
        (FULL[FULL % 20.0 < 10.0], FULL[FULL % 20.0 < 10.0] + 0.05, []),
    ],
)
def test_a_laser_that_is_silent_while_another_measures_is_named(
    front: Iterable[float], rear: Iterable[float], expected: list[str]
) -> None:
    lasers = SilentLasers()
    for frame, stamps in (('front', front), ('rear', rear)):
        for seconds in stamps:
            lasers.add(ScanEvent(scan_of(frame, seconds)))
    assert lasers.warnings() == [f'{text}, while another laser measured' for text in expected]
