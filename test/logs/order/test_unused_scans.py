"""Scans without odometry are counted by reason, with the times that explain them."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.logs.log import OdometryEvent, ScanEvent
from thinmap_ros.logs.reading import SilentLasers, UnusedScans

YEAR_S = 365.25 * 86400.0


def reasons(odometry_s: list[float], scans_s: list[float], paired_s: list[float]) -> dict[str, int]:
    unused = UnusedScans()
    for s in odometry_s:
        unused.add(OdometryEvent(round(s * SECOND_NS), np.zeros(3)))
    for s in scans_s:
        unused.add(ScanEvent(Scan.create(round(s * SECOND_NS), [1.0], 0.0, 0.1, 0.1, 8.0)))
    for s in paired_s:
        unused.pair(round(s * SECOND_NS))
    return unused.reasons()


@pytest.mark.parametrize(
    ('odometry_s', 'scans_s', 'expected'),
    [
        ([1.0, 2.0], [], {}),
        ([], [1.0, 2.0], {'without any odometry': 2}),
        ([10.0, 11.0], [8.5, 9.9], {'before the first odometry, by up to 1.5 s': 2}),
        ([10.0], [10.5, 12.0], {'after the last odometry, by up to 2 s': 2}),
        ([1.0], [1.0 + 10 * YEAR_S], {'after the last odometry, by up to 10 years': 1}),
        ([30 * 86400.0], [0.0], {'before the first odometry, by up to 30 days': 1}),
        (
            [0.0, 3.0, 7.5],
            [1.0, 4.0, 5.0],
            {'in gaps of the odometry of up to 4.5 s: expected at most 2 s': 3},
        ),
        ([0.0, 1.0], [0.5], {'too late, or with a stamp ahead of later ones': 1}),
    ],
)
def test_reasons(odometry_s: list[float], scans_s: list[float], expected: dict[str, int]) -> None:
    assert reasons(odometry_s, scans_s, []) == expected


def test_paired_scans_are_not_counted_and_equal_stamps_are_two_scans() -> None:
    found = reasons([0.0, 1.0], [0.5, 0.6, 2.0, 2.0, 2.0], [0.5, 0.6, 2.0])
    assert found == {'after the last odometry, by up to 1 s': 2}


def test_scans_of_several_lasers_are_counted_by_laser() -> None:
    unused = UnusedScans()
    unused.add(OdometryEvent(SECOND_NS, np.zeros(3)))
    for frame, seconds in (('front', 1.0), ('rear', 1.0), ('rear', 3.0)):
        unused.add(ScanEvent(scan_of(frame, seconds)))
    unused.pair(SECOND_NS, 'front')
    assert unused.reasons() == {
        'of rear after the last odometry, by up to 2 s': 1,
        'of rear too late, or with a stamp ahead of later ones': 1,
    }


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
