"""Scans of a robot that is tilted are left out; those of a level one with a noisy IMU are not."""

import math

import numpy as np
import pytest

from thinmap_ros.core.odometry import TiltBuffer
from thinmap_ros.core.scan import TILTED, LaserConfig, Scan
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer

LIMIT_RAD = LaserConfig.max_tilt_rad


def left_out(
    tilts_rad: list[float], laser: LaserConfig | None = None
) -> tuple[list[int], dict[str, str]]:
    """Numbers of the scans that are left out, and warnings; a scan between every two samples."""
    pairing = ScanOdometrySynchronizer()
    pairs = []
    for k, tilt_rad in enumerate(tilts_rad):
        pairs += pairing.add_odometry(k * SECOND_NS, np.array([0.1 * k, 0.0, 0.0]), tilt_rad)
        ranges = [2.0 + 0.01 * k + 0.001 * i for i in range(20)]
        stamp_ns = k * SECOND_NS + SECOND_NS // 2
        pairs += pairing.add_scan(Scan.create(stamp_ns, ranges, 0.0, 0.1, 0.1, 8.0, laser=laser))
    blind = [scan.stamp_ns // SECOND_NS for scan, _ in pairs if scan.is_blind]
    assert {scan.blind_reason for scan, _ in pairs if scan.is_blind} <= {TILTED}
    assert len(pairs) == len(tilts_rad) - 1
    return blind, pairing.warnings


def test_scans_beside_a_tilted_sample_are_left_out() -> None:
    assert left_out([0.0, 0.0, 0.2, 0.2, 0.0, 0.0]) == ([1, 2, 3], {})


def test_the_limit_is_that_of_the_laser() -> None:
    tilts = [0.0, 0.0, 0.15, 0.15]
    assert left_out(tilts, LaserConfig(max_tilt_rad=0.2))[0] == []
    assert left_out(tilts, LaserConfig(max_tilt_rad=0.1))[0] == [1, 2]


def test_the_noise_of_a_level_robot_is_below_the_limit_and_a_wheelchair_ramp_above() -> None:
    # 3 deg in roll and in pitch, and a slope of 1:12.
    noise_rad = math.acos(math.cos(math.radians(3.0)) ** 2)
    assert noise_rad < LIMIT_RAD < math.atan(1.0 / 12.0)


def test_a_robot_that_was_never_level_has_an_imu_that_is_askew_and_this_is_told() -> None:
    blind, warnings = left_out([0.15, 0.14, 0.15])
    assert blind == []
    assert 'tilted by 9 deg or more since the start' in warnings['tilt']


def test_a_robot_that_starts_on_a_ramp_is_left_out_from_the_next_ramp_on() -> None:
    assert left_out([0.15, 0.15, 0.0, 0.0, 0.15]) == ([3], {})


@pytest.mark.parametrize(('stamp_s', 'expected'), [(0, 0.0), (1, 0.3), (1.5, 0.3), (3, 0.2)])
def test_tilt_at_a_stamp_is_the_larger_one_beside_it(stamp_s: float, expected: float) -> None:
    tilts = TiltBuffer()
    for s, tilt_rad in ((1, 0.1), (2, 0.3), (2.5, 0.2)):
        tilts.add(round(s * SECOND_NS), tilt_rad)
    assert tilts.at(round(stamp_s * SECOND_NS)) == expected


def test_old_tilts_are_forgotten_also_when_the_time_is_set_back() -> None:
    tilts = TiltBuffer()
    for s in range(100, 200):
        tilts.add(s * SECOND_NS, 0.1)
    assert tilts.at(150 * SECOND_NS) == 0.0
    tilts.add(SECOND_NS, 0.2)
    assert tilts.at(2 * SECOND_NS) == 0.2


def test_an_askew_imu_that_is_level_on_a_bump_is_still_askew() -> None:
    blind, warnings = left_out([*[0.1] * 60, *[0.075] * 4, *[0.1] * 60])
    assert blind == [] and 'askew' in warnings['tilt']
