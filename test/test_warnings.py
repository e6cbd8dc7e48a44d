"""What a pipeline reports of lasers that are mirrored, or mounted elsewhere than given."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, drive, drive_round_the_block, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.pipeline import Pipeline, PipelineConfig

START = se2.pose(2.0, 2.0, 0.0)
GIVEN = se2.pose(0.2, 0.0, 0.0)
PERIOD_NS = 200_000_000


def pipeline():
    x, y, yaw = START.tolist()
    localizer = LocalizerConfig(initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw)
    return Pipeline(PipelineConfig(localizer=localizer, scans_per_graph=1000))


def run(steps, mount=lambda k: GIVEN, spoil=lambda scan: scan, watch=lambda k, line, step: None):
    """Drive round a room with a laser that is at a pose in truth, and at another one as given."""
    line = pipeline()
    rng = np.random.default_rng(7)
    for k, (truth, odom) in enumerate(drive(steps, rng, START)):
        scan = scan_in(ROOM, truth, rng, k * PERIOD_NS, T_base_laser=mount(k))
        watch(k, line, line.step(spoil(replace(scan, T_base_laser=GIVEN)), odom))
    return line


def turned(deg):
    return GIVEN + np.array([0.0, 0.0, math.radians(deg)])


def test_a_right_laser_is_not_reported_in_a_room():
    assert run(700).warnings == []


def test_a_right_laser_is_not_reported_in_a_corridor_with_slipping_wheels():
    line = Pipeline(PipelineConfig(scans_per_graph=1000))
    for scan, odom, _ in drive_round_the_block():
        assert line.step(scan, odom).estimate.mount_fault == ''
    assert line.warnings == []


def test_a_laser_that_is_mounted_askew_is_reported_with_its_angle_and_mapped():
    faults = []
    line = run(
        500, lambda k: turned(12.0), watch=lambda k, line, step: faults.append(step.estimate)
    )
    (warning,) = line.warnings
    assert warning.startswith(('laser turned by 11 deg', 'laser turned by 12 deg'))
    assert not any(estimate.mount_fault for estimate in faults)


def test_a_laser_that_slips_is_a_fault_within_some_metres_and_no_scan_is_mapped_from_then_on():
    slip = 300
    cells = []

    def watch(k, line, step):
        if step.estimate.mount_fault and not cells:
            cells.append((k, line.grid.known_area().cells.copy()))

    line = run(700, lambda k: turned(30.0 if k >= slip else 0.0), watch=watch)
    (first, before), *_ = cells
    assert slip < first and (first - slip) * 0.04 < 6.0, 'm of path at most'
    assert np.array_equal(line.grid.known_area().cells, before)
    assert 'laser turned by' in line.warnings[0]


def test_a_laser_in_another_place_is_reported_with_its_offset():
    line = run(700, lambda k: GIVEN + np.array([-0.3, 0.15, 0.0]))
    (warning,) = line.warnings
    found = re.match(r'laser displaced by (\S+), (\S+) m', warning)
    assert found and [float(number) for number in found.groups()] == pytest.approx(
        [-0.3, 0.15], abs=0.05
    )


def test_a_mirrored_laser_is_reported_with_both_sums():
    def mirrored(scan):
        step = scan.angle_increment_rad
        return replace(scan, angle_min_rad=-scan.angle_min_rad, angle_increment_rad=-step)

    line = run(500, spoil=mirrored)
    turns = [text for text in line.warnings if text.startswith('scans turn against the odometry')]
    assert len(turns) == 1 and 'by -' in turns[0] and 'upside down or clockwise' in turns[0]


def test_angles_that_do_not_fit_are_reported_once():
    line = run(5, spoil=lambda scan: replace(scan, warning='angle_max fits 360 beams, 300 came'))
    assert line.warnings == ['angle_max fits 360 beams, 300 came']
