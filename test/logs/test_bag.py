"""Bags: round trips; damage and missing data are reported in one line."""

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from support.bag_maker import (
    ODOMETRY,
    RANGES,
    SCAN,
    TF,
    UPRIGHT,
    Maker,
    Quaternion,
    drive,
    write,
)

from thinmap_ros.core.errors import InputError
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.logs.log import Event, OdometryEvent, ScanEvent
from thinmap_ros.logs.readers.bag import Bag, BagLog
from thinmap_ros.logs.storage import bag_files


def read(path: Path, **options: Any) -> list[Event]:
    return list(BagLog(path, **options).events())


def scans(events: list[Event]) -> list[Any]:
    return [e.scan for e in events if isinstance(e, ScanEvent)]


@pytest.mark.parametrize('name', ['bag', 'bag.mcap'])
def test_round_trip(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name, drive)
    events = read(path)
    assert [isinstance(e, ScanEvent) for e in events] == [False, True] * 3
    first = events[0]
    assert isinstance(first, OdometryEvent)
    assert first.stamp_ns == 10**9 and np.array_equal(first.T_odom_base, [0.0, 1.0, 0.0])
    scan = scans(events)[-1]
    assert scan.stamp_ns == 10**9 + 4 * 10**8
    assert np.array_equal(scan.ranges_m, RANGES, equal_nan=True)
    assert np.array_equal(scan.T_base_laser, [0.2, -0.1, 0.0])
    assert scan.angle_min_rad == -0.5 and scan.range_max_m == 8.0
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_a_folder_is_what_rosbag2_writes(tmp_path: Path) -> None:
    import yaml

    path = write(tmp_path / 'drive', drive)
    metadata = yaml.safe_load((path / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert metadata['storage_identifier'] == 'mcap'
    files = [f.name for f in path.glob('*.mcap')]
    assert metadata['relative_file_paths'] == files == ['drive.mcap']
    offered = {
        t['topic_metadata']['name']: t['topic_metadata']
        for t in metadata['topics_with_message_count']
    }
    assert offered['/tf_static']['offered_qos_profiles'][0]['durability'] in (1, 'transient_local')


def test_an_older_bag_gives_way_and_nothing_else_does(tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', drive)
    write(path, lambda w, m: drive(w, m, 5))
    assert len(scans(read(path))) == 5
    file = write(tmp_path / 'one.mcap', drive)
    write(file, lambda w, m: drive(w, m, 5))
    assert len(scans(read(file))) == 5
    (tmp_path / 'home').mkdir()
    (tmp_path / 'home' / 'thesis.tex').write_text('years of work')
    (tmp_path / 'letter').write_text('dear')
    for other in ('home', 'letter'):
        with pytest.raises(InputError, match=other):
            write(tmp_path / other, drive)
    assert (tmp_path / 'home' / 'thesis.tex').read_text() == 'years of work'
    assert (tmp_path / 'letter').read_text() == 'dear'


@pytest.mark.parametrize('name', ['bag', 'bag.mcap'])
def test_a_write_that_fails_leaves_nothing_or_the_old_one(tmp_path: Path, name: str) -> None:
    def breaks(writer: BagWriter, make: Maker) -> None:
        drive(writer, make)
        raise RuntimeError('stop')

    with pytest.raises(RuntimeError):
        write(tmp_path / name, breaks)
    assert list(tmp_path.iterdir()) == []
    write(tmp_path / name, drive)
    with pytest.raises(RuntimeError):
        write(tmp_path / name, breaks)
    assert len(scans(read(tmp_path / name))) == 3
    assert [p.name for p in tmp_path.iterdir()] == [name]


def mounted(tmp_path: Path, *links: tuple[str, str, tuple[float, ...], Quaternion]) -> Path:
    def fill(writer: BagWriter, make: Maker) -> None:
        for parent, child, moved, turned in links:
            writer.write('/tf_static', TF, 1, make.transform(parent, child, moved, turned))
        drive(writer, make, mount=False)

    return write(tmp_path / 'bag', fill)


def about(axis: str, angle: float) -> Quaternion:
    x, y, z = (math.sin(angle / 2) if a == axis else 0.0 for a in 'xyz')
    return (x, y, z, math.cos(angle / 2))


def test_a_chain_of_mounts(tmp_path: Path) -> None:
    path = mounted(
        tmp_path,
        ('base_link', 'plate', (0.5, 0.0, 0.2), about('z', math.pi / 2)),
        ('/plate', '/laser', (0.1, 0.2, 0.0), about('z', -0.3)),
    )
    assert scans(read(path))[0].T_base_laser == pytest.approx([0.3, 0.1, math.pi / 2 - 0.3])


def test_a_laser_upside_down_sees_the_same_room(tmp_path: Path) -> None:
    scan = scans(
        read(mounted(tmp_path, ('base_link', 'laser', (0.2, 0.0, 0.3), about('x', math.pi))))
    )[0]
    assert np.array_equal(scan.ranges_m, RANGES[::-1], equal_nan=True)
    assert scan.angle_increment_rad == 0.25
    # Its beam at -0.5 rad with range 1 points to the left of the robot.
    assert scan.points_base()[-1] == pytest.approx([0.2 + math.cos(0.5), math.sin(0.5)])


def test_a_tilted_laser_is_refused(tmp_path: Path) -> None:
    path = mounted(tmp_path, ('base_link', 'laser', (0.0, 0.0, 0.3), about('y', 0.5)))
    with pytest.raises(InputError, match='tilted by 29 deg'):
        read(path)


@pytest.mark.parametrize(
    'links',
    [
        (),
        (('base_link', 'camera', (0.0, 0.0, 0.0), UPRIGHT),),
        (('a', 'laser', (0.0, 0.0, 0.0), UPRIGHT), ('laser', 'a', (0.0, 0.0, 0.0), UPRIGHT)),
        (('base_link', 'laser', (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),),
        (('base_link', 'laser', (math.nan, 0.0, 0.0), UPRIGHT),),
    ],
)
def test_without_a_mount_nothing_is_assumed(tmp_path: Path, links: Any) -> None:
    path = mounted(tmp_path, *links)
    with pytest.raises(InputError, match=r'tf_static has no transform from "laser" to "base_link"'):
        read(path)
    given = np.array([0.78, 0.0, 0.0])
    assert np.array_equal(scans(read(path, T_base_laser=given))[0].T_base_laser, given)


def test_topics_are_chosen_or_asked_for(tmp_path: Path) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        drive(writer, make)
        writer.write('/rear/scan', SCAN, 5, make.scan(5, [4.0] * 5))

    path = write(tmp_path / 'bag', fill)
    log = BagLog(path)
    assert len(scans(list(log.events()))) > 1
    assert log.skipped.notes == [
        'laser scans of /scan, as the nodes subscribe to it; not of /rear/scan'
    ]

    def without_the_usual_name(writer: BagWriter, make: Maker) -> None:
        drive(writer, make)
        writer.write('/front/scan', SCAN, 5, make.scan(5, [4.0] * 5))
        writer.write('/rear/scan', SCAN, 5, make.scan(5, [4.0] * 5))

    two = write(tmp_path / 'two', without_the_usual_name)
    assert len(scans(read(two, scan_topic='/front/scan'))) == 1
    assert len(scans(read(path, scan_topic='/rear/scan'))) == 1
    with pytest.raises(InputError, match=r'no laser scans .*front.*it has /odom'):
        read(path, scan_topic='/front')


def two_lasers(writer: BagWriter, make: Maker, rear: int = 3) -> None:
    """Both measure at the same times, the rear one `rear` times; its messages are 60 ms late."""
    for frame, x in (('front', 0.2), ('rear', -0.2)):
        writer.write(
            '/tf_static', TF, 1, make.transform('base_link', frame, (x, 0.0, 0.3), UPRIGHT)
        )
    for i in range(3):
        ns = 10**9 + i * 2 * 10**8
        writer.write('/odom', ODOMETRY, ns, make.odometry(ns, 0.1 * i))
        writer.write('/front/scan', SCAN, ns + 1, make.scan(ns, RANGES, 'front'))
        ranges = RANGES if i < rear else []
        late_ns = ns + 6 * 10**7
        writer.write('/rear/scan', SCAN, late_ns, make.scan(ns, ranges, 'rear'))


BOTH = ('/front/scan', '/rear/scan')


def test_each_scan_of_several_lasers_is_one_of_its_own(tmp_path: Path) -> None:
    log = BagLog(write(tmp_path / 'bag', two_lasers), BOTH)
    found = scans(list(log.events()))
    assert [scan.frame for scan in found] == ['front', 'rear'] * 3
    assert [scan.T_base_laser[0] for scan in found] == [0.2, -0.2] * 3
    assert log.expected_scans == 6 and log.skipped.notes == []


def test_a_topic_without_usable_scans_is_named_and_the_others_are_used(tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', lambda writer, make: two_lasers(writer, make, rear=0))
    log = BagLog(path, BOTH)
    assert [scan.frame for scan in scans(list(log.events()))] == ['front'] * 3
    assert log.skipped.notes == ['/rear/scan: no usable message: mapped by the other lasers']
    with pytest.raises(InputError, match=r'/rear/scan: no usable message: .*0 beams'):
        read(path, scan_topic=('/rear/scan', '/rear/scan'))
    with pytest.raises(InputError, match=r'no laser scans \(/x\)'):
        read(path, scan_topic=('/front/scan', '/x'))


def test_what_is_asked_of_several_lasers(tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', two_lasers)
    with pytest.raises(
        InputError, match='several topics: give those of several lasers, or choose one of /front'
    ):
        read(path)
    with pytest.raises(InputError, match='one pose for the lasers of /front/scan, /rear/scan: exp'):
        read(path, scan_topic=BOTH, T_base_laser=np.zeros(3))
    one = read(path, scan_topic='/rear/scan', T_base_laser=np.zeros(3))
    assert len(scans(one)) == 3


def without_odometry(writer: BagWriter, make: Maker) -> None:
    writer.write('/scan', SCAN, 5, make.scan(5, RANGES))


def without_scans(writer: BagWriter, make: Maker) -> None:
    writer.write('/odom', ODOMETRY, 5, make.odometry(5, 1.0))


def with_empty_scans(writer: BagWriter, make: Maker) -> None:
    drive(writer, make, 0)
    writer.write('/odom', ODOMETRY, 5, make.odometry(5, 1.0))
    writer.write('/scan', SCAN, 5, make.scan(5, []))


@pytest.mark.parametrize(
    ('fill', 'said'),
    [
        (without_odometry, 'no odometry .*it has /scan .sensor_msgs/msg/LaserScan'),
        (without_scans, 'no laser scans .*it has /odom'),
        (with_empty_scans, '/scan: no usable message.*: 0 beams'),
        (lambda w, m: None, 'no laser scans'),
    ],
)
def test_missing_data_are_reported(
    tmp_path: Path, fill: Callable[[BagWriter, Maker], None], said: str
) -> None:
    path = write(tmp_path / 'bag', fill)
    with pytest.raises(InputError, match=said) as error:
        read(path)
    assert str(path) in str(error.value) and '\n' not in str(error.value)


def test_unusable_messages_are_skipped_and_counted(tmp_path: Path) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        drive(writer, make)
        writer.write('/odom', ODOMETRY, 2 * 10**9, make.odometry(5, 1.0, (0.0, 0.0, 0.0, 0.0)))
        writer.write('/odom', ODOMETRY, 2 * 10**9 + 1, make.odometry(5, math.nan))
        writer.write('/scan', SCAN, 2 * 10**9 + 2, b'\x00\x01\x00\x00rubbish')
        writer.write('/scan', SCAN, 2 * 10**9 + 3, make.scan(2 * 10**9, RANGES))

    log = BagLog(write(tmp_path / 'bag', fill))
    assert len(scans(list(log.events()))) == 4
    assert log.skipped.count == 3
    assert '/odom: quaternion' in log.skipped.first


def test_messages_of_our_own_types(tmp_path: Path) -> None:
    definitions = {
        'thinmap_test/msg/Inner': 'float64 x\n',
        'thinmap_test/msg/Outer': 'Inner[] parts\nuint32 id\n',
    }
    with BagWriter(tmp_path / 'bag', definitions=definitions) as writer:
        inner, outer = (writer.typestore.types[f'thinmap_test/msg/{n}'] for n in ('Inner', 'Outer'))
        writer.write('/own', 'thinmap_test/msg/Outer', 7, outer(parts=[inner(x=1.5)], id=3))
    bag = Bag(tmp_path / 'bag')
    (message,) = bag.messages({'/own'})
    assert (message.log_ns, message.type_name) == (7, 'thinmap_test/msg/Outer')
    assert bag.decode(message).parts[0].x == 1.5
    assert list(bag.messages({'/other'})) == []


def long_bag(tmp_path: Path) -> Path:
    return write(tmp_path / 'long.mcap', lambda w, m: drive(w, m, 8_000))


def test_a_cut_mcap_is_read_as_far_as_it_is_whole(tmp_path: Path) -> None:
    whole = long_bag(tmp_path).read_bytes()
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    log = BagLog(cut)
    count = len(scans(list(log.events())))
    assert 2_000 < count < 7_000
    assert 'cut off' in log.skipped.first
    folder = tmp_path / 'killed'  # as a killed recorder leaves it: no metadata
    folder.mkdir()
    cut.rename(folder / 'killed_0.mcap')
    assert len(scans(read(folder))) == count


@pytest.mark.parametrize(
    ('name', 'content'),
    [
        ('a.mcap', b''),
        ('b.mcap', b'hello'),
        ('c.mcap', b'\x89MCAP0\r\n'),
        ('d.bag', b'#ROSBAG V2.0'),
        ('e.db3', b'x'),
    ],
)
def test_files_that_are_no_bags(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name) as error:
        read(tmp_path / name)
    assert '\n' not in str(error.value)


def test_no_file_and_an_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='no such file'):
        Bag(tmp_path / 'none')
    with pytest.raises(InputError, match='rosbag2 folder'):
        Bag(tmp_path)


_WHOLE: list[bytes] = []


@settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.floats(0.0, 1.0), st.binary(max_size=12), st.booleans())
def test_damaged_bags(tmp_path: Path, share: float, noise: bytes, cut: bool) -> None:
    if not _WHOLE:
        _WHOLE.append(write(tmp_path / 'whole.mcap', drive).read_bytes())
    whole = _WHOLE[0]
    at = int(share * len(whole))
    path = tmp_path / 'damaged.mcap'
    path.write_bytes(whole[:at] + noise + (b'' if cut else whole[at + len(noise) :]))
    try:
        for event in BagLog(path).events():
            assert isinstance(event, OdometryEvent | ScanEvent)
    except InputError as error:
        assert '\n' not in str(error)


def test_what_a_bag_names_is_quoted_in_short(tmp_path: Path) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        for k in range(300):
            writer.write(f'/robot_{k}/' + 'x' * 500, SCAN, 5, make.scan(5, RANGES))

    path = write(tmp_path / 'bag.mcap', fill)
    with pytest.raises(
        InputError, match=r'choose one of /robot_0/x+\.\.\., .* and 29\d more$'
    ) as error:
        read(path)
    assert len(str(error.value)) < 400
    with pytest.raises(InputError, match='no odometry') as error:
        read(path, scan_topic='/robot_0/' + 'x' * 500)
    assert len(str(error.value)) < 500


def test_a_scan_of_too_many_beams_is_skipped(tmp_path: Path) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        drive(writer, make)
        writer.write('/scan', SCAN, 2 * 10**9, make.scan(2 * 10**9, [1.0] * 200_001))

    log = BagLog(write(tmp_path / 'bag', fill))
    assert len(scans(list(log.events()))) == 3
    assert (log.skipped.count, '200001 beams' in log.skipped.first) == (1, True)


def test_definitions_are_those_of_the_bag(tmp_path: Path) -> None:
    """A ROS 1 bag that was converted without new types still has `seq` in its headers."""
    definition = 'Header header\nfloat32 x\n' + '=' * 80 + '\nMSG: std_msgs/Header\n'
    definition += 'uint32 seq\ntime stamp\nstring frame_id\n'
    with (tmp_path / 'bag.mcap').open('wb') as out:
        writer = Writer(out)
        writer.start(profile='ros2')
        schema = writer.register_schema('a_msgs/msg/Old', 'ros2msg', definition.encode())
        channel = writer.register_channel('/old', 'cdr', schema)
        content = struct.pack('<IiIIccxxf', 7, 1, 2, 2, b'a', b'\0', 1.5)
        writer.add_message(channel, 5, b'\0\1\0\0' + content, 5)
        writer.finish()
    bag = Bag(tmp_path / 'bag.mcap')
    (message,) = bag.messages()
    decoded = bag.decode(message)
    assert (decoded.header.seq, decoded.header.frame_id, decoded.x) == (7, 'a', 1.5)


def test_files_of_a_bag_are_read_as_they_were_numbered(tmp_path: Path) -> None:
    folder = tmp_path / 'bag'
    folder.mkdir()
    for k in range(12):
        with BagWriter(folder / f'bag_{k}.mcap') as writer:
            writer.write('/scan', SCAN, k, Maker(writer).scan(k, RANGES))
    bag = Bag(folder)
    assert [message.log_ns for message in bag.messages()] == list(range(12))
    assert 'metadata.yaml' in bag.repair_hint and 'bag_repair' in bag.repair_hint


@pytest.mark.parametrize('name', ['bag', 'bag.mcap'])
def test_the_number_of_scans_is_known_from_the_first_event_on(tmp_path: Path, name: str) -> None:
    log = BagLog(write(tmp_path / name, lambda writer, make: drive(writer, make, count=7)))
    assert log.expected_scans is None
    next(iter(log.events()))
    assert log.expected_scans == 7


def test_a_scan_whose_angles_contradict_its_beams_is_read_with_a_warning(tmp_path: Path) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        drive(writer, make, 1)
        writer.write('/scan', SCAN, 2 * 10**9, make.scan(2 * 10**9, 2 * RANGES))

    first, second = scans(read(write(tmp_path / 'bag', fill)))
    assert first.warning == ''
    assert 'fits 5 beams, 10 came' in second.warning
    assert second.ranges_m.size == 10


def test_a_scan_with_angles_in_degrees_is_skipped_with_the_reason(tmp_path: Path) -> None:
    def fill(writer: BagWriter, make: Maker) -> None:
        drive(writer, make)
        wrong = make.scan(2 * 10**9, RANGES)
        wrong.angle_increment = 30.0
        writer.write('/scan', SCAN, 2 * 10**9, wrong)

    log = BagLog(write(tmp_path / 'bag', fill))
    assert len(scans(list(log.events()))) == 3
    assert log.skipped.count == 1 and 'degrees' in log.skipped.first


def test_a_folder_of_several_bags_is_refused(tmp_path):
    """Their scans would be taken for those of one drive, up to where the clock jumps back."""
    for name in ('office', 'hall_10', 'hall_2'):
        (tmp_path / f'{name}.mcap').write_bytes(b'')
    with pytest.raises(InputError, match=r'3 files of several bags \(office.mcap, ') as error:
        Bag(tmp_path)
    assert str(error.value).endswith(f'or the names of the files: {tmp_path}/*.mcap')
    (tmp_path / 'office.mcap').unlink()
    assert [file.name for file in bag_files(tmp_path).files] == ['hall_2.mcap', 'hall_10.mcap']
