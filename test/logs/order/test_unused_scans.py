"""Scans without odometry are counted by reason, with the times that explain them."""

import numpy as np
import pytest

from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.logs.log import OdometryEvent, ScanEvent
from thinmap_ros.logs.reading import UnusedScans

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
