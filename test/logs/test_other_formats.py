"""Bags of ROS 1, and SQLite files without metadata.yaml, hold what the bag of ROS 2 holds."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from support.bag_maker import TF, UPRIGHT, Maker, drive, write
from support.ros1_bag import NEW_TF, OLD_TF, converted, ros1_bag

from thinmap_ros.core.errors import InputError
from thinmap_ros.files.safe import LOGS
from thinmap_ros.logs import storage
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.logs.log import Event, OdometryEvent, ScanEvent
from thinmap_ros.logs.readers.bag import Bag, BagLog
from thinmap_ros.logs.reading import open_log


def assert_equal(found: list[Event], expected: list[Event]) -> None:
    assert [type(event) for event in found] == [type(event) for event in expected]
    for one, other in zip(found, expected, strict=True):
        if isinstance(one, OdometryEvent) and isinstance(other, OdometryEvent):
            assert one.stamp_ns == other.stamp_ns
            assert np.array_equal(one.T_odom_base, other.T_odom_base)
        elif isinstance(one, ScanEvent) and isinstance(other, ScanEvent):
            assert one.scan.stamp_ns == other.scan.stamp_ns
            assert np.array_equal(one.scan.ranges_m, other.scan.ranges_m, equal_nan=True)
            assert np.array_equal(one.scan.T_base_laser, other.scan.T_base_laser)


@pytest.mark.parametrize('compression', ['', 'bz2', 'lz4'])
@pytest.mark.parametrize('tf_type', [NEW_TF, OLD_TF])
@pytest.mark.parametrize('name', ['old.bag', 'old.log'])
def test_a_ros1_bag_is_read(tmp_path: Path, compression: str, tf_type: str, name: str) -> None:
    source = write(tmp_path / 'bag.mcap', drive)
    converted(source, tmp_path / 'old.bag', compression, tf_type).rename(tmp_path / name)
    log = open_log(tmp_path / name)
    assert_equal(list(log.events()), list(BagLog(source).events()))
    assert (log.expected_scans, log.skipped.count) == (3, 0)


def test_messages_of_a_ros1_bag_are_those_of_ros2(tmp_path: Path) -> None:
    ros1_bag(tmp_path / 'old.bag')
    bag = Bag(tmp_path / 'old.bag')
    (message,) = bag.messages()
    scan = bag.decode(message)
    assert scan.ranges.tolist() == [2.0] * 5
    assert not hasattr(scan.header, 'seq'), 'its bytes are not those of a ROS 2 message'


@pytest.mark.parametrize('share', [0.0, 0.1])
def test_a_ros1_bag_that_was_cut_off_before_its_messages_is_refused_in_one_line(
    tmp_path: Path, share: float
) -> None:
    whole = converted(write(tmp_path / 'bag.mcap', drive), tmp_path / 'old.bag').read_bytes()
    cut = tmp_path / 'cut.bag'
    cut.write_bytes(whole[: 13 + int(share * (len(whole) - 13))])
    with pytest.raises(InputError, match=r'cut\.bag: ROS 1 bag: .*`rosbag reindex`') as error:
        list(open_log(cut).events())
    assert '\n' not in str(error.value)


# In the header of each chunk, after the sizes of the header and of this field.
CHUNK_MARK = b'op=\x05'


@pytest.fixture(scope='module', params=['', 'bz2', 'lz4'])
def chunked(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive as a ROS 1 bag of several chunks, beside the same as an MCAP file."""
    folder = tmp_path_factory.mktemp('chunked')
    source = write(folder / 'bag.mcap', lambda writer, make: drive(writer, make, 60))
    return converted(source, folder / 'old.bag', request.param, chunk_bytes=3000)


def read_to_the_cut(path: Path, whole: Path) -> int:
    """Number of events of a cut bag, which are the first ones of the whole bag."""
    log = open_log(path)
    found = list(log.events())
    assert_equal(found, list(BagLog(whole.with_name('bag.mcap')).events())[: len(found)])
    hint = f'{path}: cut off: only the intact part is read; `rosbag reindex {path}` of ROS 1'
    assert log.skipped.first == f'{hint} repairs it'
    return len(found)


@pytest.mark.parametrize('share', [0.7, 0.8, 0.9, 0.99, 0.9999])
def test_a_ros1_bag_is_read_up_to_where_it_was_cut_off(
    tmp_path: Path, chunked: Path, share: float
) -> None:
    data = chunked.read_bytes()
    end = int(share * len(data))
    assert data.count(CHUNK_MARK) > 4
    index_at = int.from_bytes(data.partition(b'index_pos=')[2][:8], 'little')
    cut = tmp_path / 'cut.bag'
    cut.write_bytes(data[:end])
    events = len(list(BagLog(chunked).events()))
    messages_share = (end - 4109) / (index_at - 4109)
    assert read_to_the_cut(cut, chunked) >= 0.9 * min(messages_share, 1.0) * events - 10


def test_a_ros1_bag_is_read_up_to_the_end_of_a_chunk_where_it_was_cut_off(
    tmp_path: Path, chunked: Path
) -> None:
    data = chunked.read_bytes()
    third = [at for at in range(len(data)) if data.startswith(CHUNK_MARK, at)][3] - 8
    cut = tmp_path / 'cut.bag'
    cut.write_bytes(data[:third])
    assert read_to_the_cut(cut, chunked) > 3


def test_a_ros1_bag_that_was_not_closed_is_read(tmp_path: Path) -> None:
    """The recorder was killed: no index, and the size of the last chunk is 0."""
    source = write(tmp_path / 'bag.mcap', lambda writer, make: drive(writer, make, 40))
    whole = converted(source, tmp_path / 'old.bag')
    data = bytearray(whole.read_bytes())
    at = data.index(b'index_pos=') + len(b'index_pos=')
    chunk_end = int.from_bytes(data[at : at + 8], 'little')
    data[at : at + 8] = bytes(8)
    header_at = data.index(CHUNK_MARK) - 8
    size_at = header_at + 4 + int.from_bytes(data[header_at : header_at + 4], 'little')
    chunk_bytes = int.from_bytes(data[size_at : size_at + 4], 'little')
    data[size_at : size_at + 4] = bytes(4)
    active = tmp_path / 'old.bag.active'
    active.write_bytes(data[: size_at + 4 + chunk_bytes - 7])
    assert size_at + 4 + chunk_bytes < chunk_end
    expected = len(list(BagLog(source).events()))
    assert read_to_the_cut(active, whole) == expected - 1


@pytest.mark.parametrize('compression', ['bz2', 'lz4'])
def test_a_chunk_of_a_ros1_bag_that_expands_too_far_ends_it(
    tmp_path: Path, compression: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = write(tmp_path / 'bag.mcap', lambda writer, make: drive(writer, make, 40))
    old = converted(source, tmp_path / 'old.bag', compression)

    monkeypatch.setattr(storage, 'LOGS', replace(LOGS, chunk_bytes=1000))
    bag = Bag(old)
    assert list(bag.messages()) == []
    assert bag.is_truncated


def sqlite_bag(tmp_path: Path) -> Path:
    """A drive in SQLite, as rosbag2 before Iron records."""
    typestore = get_typestore(Stores.ROS2_JAZZY)
    source = Bag(write(tmp_path / 'bag.mcap', drive))
    connections = {}
    with Writer(tmp_path / 'sq', version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for message in source.messages():
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.type_name, typestore=typestore
                )
            writer.write(connections[message.topic], message.log_ns, message.data)
    return tmp_path / 'sq'


def without_metadata(folder: Path) -> Path:
    (folder / 'metadata.yaml').unlink()
    return folder


def the_file(folder: Path) -> Path:
    shutil.move(folder / 'sq.db3', folder.parent / 'sq.db3')
    return folder.parent / 'sq.db3'


def packed(folder: Path) -> Path:
    file = the_file(folder)
    target = folder.parent / 'sq.db3.zstd'
    target.write_bytes(zstandard.ZstdCompressor().compress(file.read_bytes()))
    file.unlink()
    return target


def packed_folder(folder: Path) -> Path:
    packed(folder).rename(folder / 'sq_0.db3.zstd')
    return without_metadata(folder)


@pytest.mark.parametrize('change', [without_metadata, the_file, packed, packed_folder])
def test_sqlite_is_read_without_metadata_with_a_note(tmp_path: Path, change: object) -> None:
    path = change(sqlite_bag(tmp_path))  # type: ignore[operator]
    log = open_log(path)
    assert_equal(list(log.events()), list(BagLog(tmp_path / 'bag.mcap').events()))
    (note,) = log.skipped.notes
    assert str(path) in note and 'without' in note
    assert log.skipped.count == 0


def test_sqlite_with_metadata_needs_no_note(tmp_path: Path) -> None:
    log = BagLog(sqlite_bag(tmp_path))
    assert len(list(log.events())) == 6
    assert log.skipped.notes == []


def test_messages_that_are_compressed_by_themselves_need_no_metadata(tmp_path: Path) -> None:
    source = Bag(write(tmp_path / 'bag.mcap', drive))
    packer = zstandard.ZstdCompressor()
    with BagWriter(tmp_path / 'packed.mcap') as writer:
        for message in source.messages():
            data = packer.compress(message.data)
            writer.write(message.topic, message.type_name, message.log_ns, data)
    events = list(BagLog(tmp_path / 'packed.mcap').events())
    assert_equal(events, list(BagLog(tmp_path / 'bag.mcap').events()))


def test_transforms_of_an_old_bag_are_those_of_the_robot(tmp_path: Path) -> None:
    """ROS 1 drivers publish the pose of the laser on /tf, again and again."""

    def fill(writer: BagWriter, make: Maker) -> None:
        for ns in range(1, 4):
            mount = make.transform('/base_link', '/laser', (0.2, 0.1, 0.0), UPRIGHT, ns)
            writer.write('/tf', TF, ns, mount)
        drive(writer, make, mount=False)

    old = converted(write(tmp_path / 'bag.mcap', fill), tmp_path / 'old.bag', tf_type=OLD_TF)
    scans = [event.scan for event in open_log(old).events() if isinstance(event, ScanEvent)]
    assert np.array_equal(scans[0].T_base_laser, [0.2, 0.1, 0.0])
