"""Frames and odometry of bags: by topic, by transforms, or none; first and later transforms."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bag_maker import ODOMETRY, RANGES, SCAN, TF, UPRIGHT, Maker, Quaternion, drive, write

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import LaserConfig
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.logs.log import OdometryEvent, ScanEvent
from thinmap_ros.logs.readers.bag import BagLog

LEFT: Quaternion = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
STEP_NS = 2 * 10**8


def events_of(
    log: BagLog,
) -> tuple[list[OdometryEvent], list[ScanEvent]]:
    events = list(log.events())
    return (
        [event for event in events if isinstance(event, OdometryEvent)],
        [event for event in events if isinstance(event, ScanEvent)],
    )


def static(writer: BagWriter, make: Maker, *links: tuple[Any, ...]) -> None:
    for number, link in enumerate(links):
        writer.write('/tf_static', TF, number, make.transform(*link))


def moving(writer: BagWriter, make: Maker, child: str = 'base_link', count: int = 3) -> None:
    """The robot drives along x by /tf, with a scan at each sample."""
    for i in range(count):
        ns = 10**9 + i * STEP_NS
        pose = make.transform('odom', child, (0.1 * i, 1.0, 0.0), UPRIGHT, ns)
        writer.write('/tf', TF, ns, pose)
        writer.write('/scan', SCAN, ns + 1, make.scan(ns, RANGES))


def odometry_of(writer: BagWriter, make: Maker, child: str, frame: str = 'odom') -> None:
    for i in range(3):
        ns = 10**9 + i * STEP_NS
        writer.write('/odom', ODOMETRY, ns, make.odometry(ns, 0.1 * i, frames=(frame, child)))
        writer.write('/scan', SCAN, ns + 1, make.scan(ns, RANGES))


@pytest.mark.parametrize('is_static', [True, False])
@pytest.mark.parametrize('turned', [UPRIGHT, LEFT])
def test_odometry_of_another_frame_is_that_of_the_robot(
    tmp_path: Path, is_static: bool, turned: Quaternion
) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        topic = '/tf_static' if is_static else '/tf'
        footprint = make.transform('base_footprint', 'base_link', (0.25, 0.0, 0.1), turned)
        writer.write(topic, TF, 1, footprint)
        static(writer, make, ('base_link', 'laser', (0.1, 0.0, 0.2)))
        odometry_of(writer, make, 'base_footprint')

    odometry, scans = events_of(BagLog(write(tmp_path / 'bag', fill)))
    yaw = 0.0 if turned == UPRIGHT else math.pi / 2
    for i, event in enumerate(odometry):
        expected = se2.compose(se2.pose(0.1 * i, 1.0, 0.0), se2.pose(0.25, 0.0, yaw))
        np.testing.assert_allclose(event.T_odom_base, expected, atol=1e-9)
    np.testing.assert_allclose(scans[0].scan.T_base_laser, [0.1, 0.0, 0.0], atol=1e-12)


def test_a_frame_that_nothing_names_gives_way_to_that_of_the_odometry(tmp_path: Path) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        static(writer, make, ('base_footprint', 'laser', (0.1, 0.0, 0.2)))
        writer.write('/scan', SCAN, 5, make.scan(5, RANGES))  # before the odometry
        odometry_of(writer, make, 'base_footprint', 'wheel_odom')

    path = write(tmp_path / 'bag', fill)
    log = BagLog(path)
    odometry, scans = events_of(log)
    assert (len(odometry), len(scans)) == (3, 4)
    np.testing.assert_allclose(scans[0].scan.T_base_laser, [0.1, 0.0, 0.0], atol=1e-12)
    (note,) = log.skipped.notes
    assert 'names "base_link": the frame of the robot is "base_footprint"' in note
    with pytest.raises(InputError, match=r'no transform from "laser" to "base_link"'):
        events_of(BagLog(path, base_frame='base_link'))
    with pytest.raises(InputError, match=r"expected 'odom' \(odom_frame\)"):
        events_of(BagLog(path, odom_frame='odom'))


def test_odometry_in_a_frame_that_nothing_connects_is_refused(tmp_path: Path) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        static(writer, make, ('base_link', 'laser', (0.1, 0.0, 0.2)))
        odometry_of(writer, make, 'camera')

    with pytest.raises(InputError, match=r"child_frame_id 'camera': expected 'base_link'"):
        events_of(BagLog(write(tmp_path / 'bag', fill)))


@pytest.mark.parametrize('first_m', [0.2, 0.5])
def test_of_two_transforms_the_first_one_holds(tmp_path: Path, first_m: float) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        links = [('base_link', 'laser', (x, 0.0, 0.0)) for x in (0.2, 0.5)]
        static(writer, make, *(links if first_m == 0.2 else links[::-1]))
        drive(writer, make, mount=False)

    log = BagLog(write(tmp_path / 'bag', fill))
    _, scans = events_of(log)
    assert scans[0].scan.T_base_laser[0] == first_m
    assert log.skipped.notes == [
        'static transform of laser laser has changed by 0.30 m, 0.00 rad: the first one is used'
    ]


def test_a_laser_beside_the_robots_frame_is_found_by_their_parent(tmp_path: Path) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        static(
            writer,
            make,
            ('base_footprint', 'base_link', (0.1, 0.0, 0.0), LEFT),
            ('base_footprint', 'laser', (0.1, 0.3, 0.0), LEFT),
        )
        drive(writer, make, mount=False)

    _, scans = events_of(BagLog(write(tmp_path / 'bag', fill)))
    np.testing.assert_allclose(scans[0].scan.T_base_laser, [0.3, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize('source', ['', 'tf'])
def test_without_a_topic_odometry_is_that_of_the_transforms(tmp_path: Path, source: str) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        static(writer, make, ('base_link', 'laser', (0.1, 0.0, 0.2)))
        moving(writer, make)

    log = BagLog(write(tmp_path / 'bag', fill), odometry_source=source)
    odometry, scans = events_of(log)
    assert [event.stamp_ns for event in odometry] == [10**9 + i * STEP_NS for i in range(3)]
    found = [event.T_odom_base.tolist() for event in odometry]
    np.testing.assert_allclose(found, [[0.1 * i, 1.0, 0.0] for i in range(3)], atol=1e-12)
    assert len(scans) == 3
    assert bool(log.skipped.notes) == (source == '')


def test_transforms_lead_to_the_frame_that_the_bag_has(tmp_path: Path) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        static(writer, make, ('base_footprint', 'laser', (0.1, 0.0, 0.2)))
        moving(writer, make, 'base_footprint')

    odometry, scans = events_of(BagLog(write(tmp_path / 'bag', fill)))
    assert (len(odometry), len(scans)) == (3, 3)


def test_transforms_that_are_missing_are_named(tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', drive)
    with pytest.raises(InputError, match=r"transforms: no usable message: .*'odom'.*--odom-frame"):
        events_of(BagLog(path, odometry_source='tf'))


def test_without_odometry_the_robot_never_moves_in_its_frame(tmp_path: Path) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        static(writer, make, ('base_link', 'laser', (0.1, 0.0, 0.2)))
        writer.write('/scan', SCAN, 5, make.scan(5, RANGES))

    path = write(tmp_path / 'bag', fill)
    odometry, scans = events_of(BagLog(path, odometry_source='none'))
    (sample,) = odometry
    assert (sample.stamp_ns, sample.is_measured) == (scans[0].scan.stamp_ns, False)
    assert sample.T_odom_base.tolist() == [0.0, 0.0, 0.0]
    with pytest.raises(InputError, match='no odometry'):
        events_of(BagLog(path))


def test_a_range_of_zero_means_what_the_user_says(tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', drive)
    for is_set in (False, True):
        _, scans = events_of(BagLog(path, laser=LaserConfig(zero_is_no_return=is_set)))
        assert scans[0].scan.zero_is_no_return == is_set


PITCH_RAD = 0.15
PITCHED: Quaternion = (0.0, math.sin(PITCH_RAD / 2), 0.0, math.cos(PITCH_RAD / 2))
ROLLED_OVER: Quaternion = (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize('source', ['topic', 'tf'])
@pytest.mark.parametrize(
    ('measured', 'mounted', 'expected_rad'),
    [
        (UPRIGHT, UPRIGHT, 0.0),
        (LEFT, UPRIGHT, 0.0),
        (PITCHED, UPRIGHT, PITCH_RAD),
        (PITCHED, LEFT, PITCH_RAD),
        (ROLLED_OVER, UPRIGHT, 0.0),
        # A sensor that is mounted askew on a level robot, and on a tilted one.
        (PITCHED, PITCHED, 0.0),
        (UPRIGHT, PITCHED, PITCH_RAD),
    ],
)
def test_odometry_tells_the_tilt_of_the_robot(
    tmp_path: Path, source: str, measured: Quaternion, mounted: Quaternion, expected_rad: float
) -> None:
    """The odometry is that of a sensor, mounted on the robot as static transforms say."""

    def fill(writer: BagWriter, make: Maker) -> None:
        static(writer, make, ('base_link', 'laser', (0.0, 0.0, 0.2)))
        x, y, z, w = mounted
        if source == 'topic':
            static(writer, make, ('base_link', 'sensor', (0.0, 0.0, 0.3), mounted))
        else:
            inverse = (-x, -y, -z, w)
            static(writer, make, ('sensor', 'base_link', (0.0, 0.0, -0.3), inverse))
        for i in range(3):
            ns = 10**9 + i * STEP_NS
            if source == 'topic':
                odometry = make.odometry(ns, 0.1 * i, measured, ('odom', 'sensor'))
                writer.write('/odom', ODOMETRY, ns, odometry)
            else:
                pose = make.transform('odom', 'sensor', (0.1 * i, 1.0, 0.0), measured, ns)
                writer.write('/tf', TF, ns, pose)
            writer.write('/scan', SCAN, ns + 1, make.scan(ns, RANGES))

    log = BagLog(write(tmp_path / 'bag.mcap', fill), odometry_source=source)
    odometry, _ = events_of(log)
    assert [event.tilt_rad for event in odometry] == pytest.approx([expected_rad] * 3, abs=1e-6)


@pytest.mark.parametrize('has_pose', [False, True])
def test_a_bag_without_odometry_names_the_way_without(tmp_path: Path, has_pose: bool) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        static(writer, make, ('base_link', 'laser', (0.0, 0.0, 0.2)))
        writer.write('/scan', SCAN, 10**9, make.scan(10**9, RANGES))
        if has_pose:
            writer.write('/odom', ODOMETRY, 10**9, make.odometry(10**9, math.nan))

    path = write(tmp_path / 'bag.mcap', fill)
    with pytest.raises(InputError, match='; --odom-source none maps by scan matching alone'):
        list(BagLog(path).events())
    _, scans = events_of(BagLog(path, odometry_source='none'))
    assert len(scans) == 1
