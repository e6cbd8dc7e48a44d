"""bag_repair keeps all intact data of a truncated or damaged file; the result is a valid bag.

No damage causes a traceback in any program.
"""

import os
import subprocess
from bisect import bisect_right
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import yaml
from fuzz.damaged_bags import CASES, run_cases, whole_bags
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Channel, ChunkIndex, Message
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter
from rosbags.typesys import Stores, get_typestore
from support.forks import forked

from thinmap_ros.files.safe import LOGS
from thinmap_ros.logs import storage
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.logs.mcap import (
    HEAD,
    MAGIC,
    Damage,
    McapFile,
    Section,
    intact_records,
    plain_records,
)
from thinmap_ros.logs.readers.bag import Bag

STRING = 'std_msgs/msg/String'
COUNT = 200
PER_CHUNK = 10


def write(path: Path, count: int = COUNT) -> Path:
    """A bag of numbered messages, ten per chunk."""
    writer = BagWriter(path, live=True)
    writer.add_topic('/said', STRING, [storage.recorded(7, False, False)])
    writer.add_topic('/map', STRING, [storage.recorded(1, True, True)])
    for i in range(count):
        writer.write('/map' if i % 20 == 0 else '/said', STRING, 10**9 + i, text(writer, i))
        if i % PER_CHUNK == PER_CHUNK - 1:
            writer.flush()
    writer.close()
    return path


def text(writer: BagWriter, i: int) -> Any:
    return writer.typestore.types[STRING](data=f'number {i} ' + 'x' * 50)


def numbers(path: Path) -> list[int]:
    bag = Bag(path)
    assert not bag.is_truncated
    return [int(bag.decode(message).data.split()[1]) for message in bag.messages()]


def repaired(source: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return forked.run('thinmap_ros.tools.bag_repair', source, *arguments)


def test_what_is_flushed_is_readable_at_once(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'bag', live=True)
    for i in range(5):
        writer.write('/said', STRING, 10**9 + i, text(writer, i))
    writer.flush()
    writer.flush()
    bag = Bag(tmp_path / 'bag')
    assert len(list(bag.messages())) == 5 and bag.is_truncated
    writer.write('/said', STRING, 2 * 10**9, text(writer, 5))
    writer.close()
    assert numbers(tmp_path / 'bag') == list(range(6))


def test_a_topic_that_is_defined_before_its_first_message_is_read_without_a_summary(
    tmp_path: Path,
) -> None:
    writer = BagWriter(tmp_path / 'bag', live=True)
    topics = ['/map', '/map', '/said', '/map', '/said']
    for i, topic in enumerate(topics):
        if i == 1:  # as a recorder that subscribes
            writer.add_topic('/said', STRING, [storage.recorded(7, False, False)])
        writer.write(topic, STRING, 10**9 + i, text(writer, i))
        writer.flush()
    bag = Bag(tmp_path / 'bag')
    assert [message.topic for message in bag.messages()] == topics
    assert len(list(bag.messages({'/said'}))) == 2 and bag.is_truncated


def record_ends(content: bytes | bytearray) -> list[int]:
    """Ends of the records of an undamaged file, and the file."""
    ends = [len(MAGIC)]
    while ends[-1] < len(content) - len(MAGIC):
        _, length = HEAD.unpack_from(content, ends[-1])
        ends.append(ends[-1] + HEAD.size + length)
    return [*ends, len(content)]


def test_a_file_that_ends_among_message_indexes_keeps_the_messages_of_all_topics(
    tmp_path: Path,
) -> None:
    whole = (write(tmp_path / 'bag', 5 * PER_CHUNK) / 'bag.mcap').read_bytes()
    cut = tmp_path / 'cut.mcap'
    for end in record_ends(whole):
        cut.write_bytes(whole[:end])
        said = [found for found in McapFile(cut).messages() if found[1].topic == '/said']
        assert list(McapFile(cut).messages({'/said'})) == said


def test_a_message_index_of_a_damaged_length_does_not_hide_what_is_before_it(
    tmp_path: Path,
) -> None:
    whole = bytearray((write(tmp_path / 'bag', 5 * PER_CHUNK) / 'bag.mcap').read_bytes())
    last = max(end for end in record_ends(whole) if whole[end : end + 1] == b'\x07')
    whole[last + 1 : last + HEAD.size] = b'\xff' * 8
    (tmp_path / 'damaged.mcap').write_bytes(whole[: last + 100])
    assert len(list(McapFile(tmp_path / 'damaged.mcap').messages())) == 5 * PER_CHUNK


def test_a_chunk_is_read_though_the_length_of_its_record_is_damaged(tmp_path: Path) -> None:
    whole = (write(tmp_path / 'bag', PER_CHUNK) / 'bag.mcap').read_bytes()
    at = next(end for end in record_ends(whole) if whole[end : end + 1] == b'\x06')
    damaged = tmp_path / 'damaged.mcap'
    with damaged.open('wb') as stream:
        stream.write(whole[:at] + HEAD.pack(6, 2 * LOGS.chunk_bytes) + whole[at + HEAD.size :])
        stream.truncate(3 * LOGS.chunk_bytes)  # with a hole, which takes no space
    assert len(list(McapFile(damaged).messages())) == PER_CHUNK


def test_a_definition_behind_a_message_shows_that_its_length_is_right() -> None:
    builder = RecordBuilder()
    Message(channel_id=1, log_time=3, data=b'said', publish_time=3, sequence=0).write(builder)
    Channel(1, '/said', 'cdr', {}, 1).write(builder)
    Message(channel_id=1, log_time=5, data=b'lost', publish_time=5, sequence=1).write(builder)
    content = builder.end() + bytes(50)
    records = plain_records(Section(BytesIO(content), len(content)))
    assert [message.endswith(b'said') for message in records.contents] == [True]
    assert records.damaged


def test_a_file_may_grow_while_it_is_read(tmp_path: Path) -> None:
    whole = (write(tmp_path / 'bag', 5 * PER_CHUNK) / 'bag.mcap').read_bytes()
    ends = record_ends(whole)

    class Growing(type(tmp_path)):  # type: ignore[misc]
        """A file to which a recorder adds a record after each query of its size."""

        def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
            found: os.stat_result = super().stat(follow_symlinks=follow_symlinks)
            sizes.append(found.st_size)
            following = min(bisect_right(ends, found.st_size), len(ends) - 1)
            self.write_bytes(whole[: ends[following]])
            return found

    still = tmp_path / 'still.mcap'
    for end in ends:
        sizes: list[int] = []
        growing = Growing(tmp_path / 'growing.mcap')
        growing.write_bytes(whole[:end])
        read = McapFile(growing)
        still.write_bytes(whole[: sizes[-1]])
        wanted = McapFile(still)
        assert list(read.messages()) == list(wanted.messages()) and read.damage == wanted.damage


@pytest.mark.programs
def test_a_cut_off_bag_gets_index_metadata_and_its_qualities_back(tmp_path: Path) -> None:
    whole = (write(tmp_path / 'bag') / 'bag.mcap').read_bytes()
    (tmp_path / 'cut').mkdir()
    (tmp_path / 'cut' / 'cut_0.mcap').write_bytes(whole[: len(whole) // 2])
    done = repaired(tmp_path / 'cut')
    assert done.returncode == 0, done.stderr
    assert 'cut off' in done.stdout and 'on 2 topics' in done.stdout
    good = tmp_path / 'cut_repaired'
    found = numbers(good)
    # Half of the file has more than half of the messages: summary and index are at its end.
    assert found == list(range(len(found))) and COUNT / 2 - PER_CHUNK <= len(found) < COUNT
    assert f'{len(found)} messages' in done.stdout
    metadata = yaml.safe_load((good / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert metadata['message_count'] == len(found)
    assert metadata['relative_file_paths'] == ['cut_repaired.mcap']
    assert metadata['starting_time']['nanoseconds_since_epoch'] == 10**9
    assert metadata['duration']['nanoseconds'] == len(found) - 1
    offers = Bag(good).offers
    assert storage.is_latched('/map', offers['/map'])
    assert not storage.is_latched('/said', offers['/said'])
    assert not storage.is_reliable(offers['/said']) and storage.depth(offers['/said']) == 7


def cut_file(tmp_path: Path, compression: CompressionType) -> Path:
    """One chunk of many messages, truncated in its middle."""
    with (tmp_path / 'one.mcap').open('wb') as stream:
        writer = Writer(stream, chunk_size=10**9, compression=compression)
        writer.start(profile='ros2')
        schema = writer.register_schema(STRING, 'ros2msg', b'string data')
        channel = writer.register_channel('/said', 'cdr', schema)
        noise = BagWriter(tmp_path / 'noise', live=True).typestore
        for i in range(20_000):
            data = noise.serialize_cdr(
                noise.types[STRING](data=f'number {i} {hash((i, 1)):x}'), STRING
            )
            writer.add_message(channel, 10**9 + i, bytes(data), 10**9 + i, i)
        writer.finish()
    content = (tmp_path / 'one.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(content[: len(content) // 2])
    return tmp_path / 'cut.mcap'


@pytest.mark.programs
@pytest.mark.parametrize('compression', list(CompressionType))
def test_of_a_chunk_that_was_cut_off_the_part_before_the_cut_is_kept(
    tmp_path: Path, compression: CompressionType
) -> None:
    cut = cut_file(tmp_path, compression)
    done = repaired(cut, '-o', str(tmp_path / 'good.mcap'))
    assert done.returncode == 0, done.stderr
    found = numbers(tmp_path / 'good.mcap')
    assert found == list(range(len(found))) and 4_000 < len(found) < 16_000
    with (tmp_path / 'good.mcap').open('rb') as stream:
        last = list(NonSeekingReader(stream, validate_crcs=True).iter_messages())[-1][2]
    assert last.sequence == last.log_time - 10**9 == len(found) - 1


def chunked_file(path: Path, compression: CompressionType) -> list[ChunkIndex]:
    """A file of 500 numbered messages, and the offsets of its chunks."""
    with path.open('wb') as stream:
        writer = Writer(stream, chunk_size=2000, compression=compression)
        writer.start(profile='ros2')
        channel = writer.register_channel(
            '/said', 'cdr', writer.register_schema(STRING, 'ros2msg', b'string data')
        )
        for i in range(500):
            writer.add_message(channel, i, b'\x00\x01\x00\x00' + bytes([i % 251]) * 60, i)
        writer.finish()
    with path.open('rb') as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes


@pytest.mark.parametrize('compression', list(CompressionType))
def test_a_damaged_chunk_costs_only_itself(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / 'bag.mcap'
    chunks = chunked_file(path, compression)
    hit = chunks[len(chunks) // 3]
    content = bytearray(path.read_bytes())
    # In the data of the chunk: if it is uncompressed, only its checksum shows the damage.
    content[hit.chunk_start_offset + hit.chunk_length - hit.compressed_size // 2] ^= 0x40
    path.write_bytes(content)
    damage = Damage()
    records = list(intact_records(path, damage))
    lost = range(hit.message_start_time, hit.message_end_time + 1)
    assert 0 < len(lost) < 100
    assert [r.log_time for r in records if isinstance(r, Message)] == [
        i for i in range(500) if i not in lost
    ]
    assert list(damage.parts) == [hit.chunk_start_offset] and not damage.is_truncated
    if compression == CompressionType.NONE:
        assert damage.parts[hit.chunk_start_offset] == 'wrong checksum'


def test_a_damaged_summary_is_not_believed(tmp_path: Path) -> None:
    path = tmp_path / 'bag.mcap'
    chunked_file(path, CompressionType.NONE)
    content = bytearray(path.read_bytes())
    # The last occurrence of the topic is in the summary.
    at = content.rindex(b'/said')
    content[at : at + 5] = b'/sald'
    path.write_bytes(content)
    file = McapFile(path)
    assert {channel.topic for _, channel, _ in file.messages()} == {'/said'}


@pytest.mark.programs
def test_what_cannot_be_repaired_is_reported_in_one_line(tmp_path: Path) -> None:
    (tmp_path / 'text.mcap').write_bytes(b'dear all')
    (tmp_path / 'start.mcap').write_bytes(b'\x89MCAP0\r\n\x01')
    (tmp_path / 'empty').mkdir()
    for name, said in (
        ('text.mcap', 'begin with'),
        ('start.mcap', 'no intact message'),
        ('empty', 'MCAP files in it'),
    ):
        done = repaired(tmp_path / name)
        assert done.returncode == 2 and said in done.stderr and name in done.stderr
        assert len(done.stderr.splitlines()) == 1
    (tmp_path / 'home').mkdir()
    (tmp_path / 'home' / 'thesis').write_text('work')
    done = repaired(write(tmp_path / 'bag') / 'bag.mcap', '-o', str(tmp_path / 'home'))
    assert done.returncode == 2 and 'thesis' in done.stderr
    assert not list(tmp_path.glob('.*.part'))


@pytest.mark.programs
def test_behind_a_range_of_zeros_it_continues_at_the_next_chunk_of_the_summary(
    tmp_path: Path,
) -> None:
    folder = write(tmp_path / 'bag')
    content = bytearray((folder / 'bag.mcap').read_bytes())
    middle = len(content) // 3
    content[middle : middle + 3000] = bytes(3000)
    (folder / 'bag.mcap').write_bytes(content)
    done = repaired(folder)
    assert done.returncode == 0 and 'damaged part' in done.stdout
    found = numbers(tmp_path / 'bag_repaired')
    assert COUNT - 10 * PER_CHUNK < len(found) < COUNT and {0, COUNT - 1} <= set(found)
    bag = Bag(folder)
    assert [int(bag.decode(m).data.split()[1]) for m in bag.messages()] == found
    assert bag.is_truncated


@pytest.mark.programs
def test_messages_that_are_compressed_each_on_its_own_are_unpacked(tmp_path: Path) -> None:
    writer = RosbagWriter(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    types = get_typestore(Stores.ROS2_JAZZY)
    with writer:
        connection = writer.add_connection('/said', STRING, typestore=types)
        for i in range(20):
            data = types.serialize_cdr(types.types[STRING](data=f'number {i}'), STRING)
            writer.write(connection, 10**9 + i, data)
    assert numbers(tmp_path / 'bag') == list(range(20))
    done = repaired(tmp_path / 'bag', '-o', str(tmp_path / 'good.mcap'))
    assert done.returncode == 0, done.stderr
    assert numbers(tmp_path / 'good.mcap') == list(range(20))


_WHOLE: list[bytes] = []


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(0.0, 1.0), st.binary(max_size=16), st.booleans())
def test_no_damage_makes_it_stumble_or_invent(
    tmp_path: Path, share: float, noise: bytes, cut: bool
) -> None:
    if not _WHOLE:
        _WHOLE.append((write(tmp_path / 'whole') / 'whole.mcap').read_bytes())
    at = 8 + int(share * (len(_WHOLE[0]) - 8))
    damaged = _WHOLE[0][:at] + noise + (b'' if cut else _WHOLE[0][at + len(noise) :])
    (tmp_path / 'damaged.mcap').write_bytes(damaged)
    records = list(intact_records(tmp_path / 'damaged.mcap', Damage()))
    if not cut and not noise:
        assert sum(isinstance(record, Message) for record in records) == COUNT
    assert len(records) <= COUNT + 10 + len(noise)


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return whole_bags(tmp_path_factory.mktemp('whole'))


def test_no_damage_ends_in_a_traceback(whole: dict[str, bytes], tmp_path: Path) -> None:
    ends = run_cases(whole, tmp_path, seed=0, count=CASES)
    assert ends['repaired'] > ends.total() / 2
