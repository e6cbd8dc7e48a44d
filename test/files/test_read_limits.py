"""Limits of reading files.

A small file that expands or nests without bounds is rejected in one line, with little memory.
"""

import functools
import gzip
import json
import re
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import (
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Schema,
)
from rosbags.typesys import Stores, get_typestore
from support.carmen_log import carmen_lines

from thinmap_ros.core.errors import InputError
from thinmap_ros.files.safe import LOGS
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.logs.mcap import (
    Damage,
    DamagedError,
    Section,
    decompress,
    intact_records,
    plain_records,
)
from thinmap_ros.logs.readers.bag import Bag
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.logs.storage import own_typestore, typestore_of
from thinmap_ros.tools.carmen_to_bag import convert

MAGIC = b'\x89MCAP0\r\n'
EXPANDED = 900 * 2**20
MAX_MB = 300
RUNNER = """
import pathlib, runpy, sys, time
del sys.argv[0]
try:
    runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True)
finally:
    # Not ru_maxrss: after a fork that is at least what the parent had.
    status = pathlib.Path('/proc/self/status').read_text()
    print('cpu', time.process_time())
    print('peak', int(status.split('VmHWM:')[1].split()[0]) // 1024)
"""
# Generous for a slow machine; without limits it takes minutes.
MAX_CPU_S = 120.0


def run(tool: str, *arguments: Path | str) -> tuple[int, str, int]:
    """Exit code, last line of stderr, and peak memory (MB) of a program."""
    command = [sys.executable, '-c', RUNNER, f'thinmap_ros.tools.{tool}', *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert 'Traceback' not in done.stderr, done.stderr[-2000:]
    peak = int(done.stdout.split()[-1])
    assert float(done.stdout.split()[-3]) < MAX_CPU_S
    return done.returncode, (done.stderr.splitlines() or [''])[-1], peak


def bomb(path: Path, compression: str, packed: bytes, claimed: int) -> Path:
    """An MCAP file of one chunk with a declared size in bytes."""
    builder = RecordBuilder()
    Header('ros2', 'test').write(builder)
    Schema(id=1, name='std_msgs/msg/String', encoding='ros2msg', data=b'string data').write(builder)
    Channel(id=1, topic='/said', message_encoding='cdr', metadata={}, schema_id=1).write(builder)
    Chunk(compression, packed, 5, 1, 0, claimed).write(builder)
    DataEnd(0).write(builder)
    Footer(0, 0, 0).write(builder)
    path.write_bytes(MAGIC + builder.end() + MAGIC)
    return path


@functools.cache
def packed_zeros(compression: str, size: int) -> bytes:
    """A number of zeros, compressed in pieces."""
    piece = bytes(2**20)
    if compression == 'lz4':
        packer = lz4.frame.LZ4FrameCompressor()
        parts = [
            packer.begin(),
            *(packer.compress(piece) for _ in range(size // 2**20)),
            packer.flush(),
        ]
        return b''.join(parts)
    stream = zstandard.ZstdCompressor().compressobj()
    return b''.join([*(stream.compress(piece) for _ in range(size // 2**20)), stream.flush()])


@pytest.mark.programs
@pytest.mark.parametrize('claimed', [2**20, EXPANDED, 2**62])
@pytest.mark.parametrize('compression', ['lz4', 'zstd'])
@pytest.mark.parametrize('tool', ['bag_repair', 'replay'])
def test_a_chunk_that_expands_without_end(
    tmp_path: Path, tool: str, compression: str, claimed: int
) -> None:
    packed = packed_zeros(compression, EXPANDED)
    path = bomb(tmp_path / 'bomb.mcap', compression, packed, claimed)
    code, line, peak_mb = run(tool, path, '-o', tmp_path / 'out')
    assert code == 2
    assert 'bomb.mcap' in line and 'bytes uncompressed' in line and len(line) < 500
    assert peak_mb < MAX_MB
    assert not (tmp_path / 'out').exists()


def test_messages_beside_a_bomb_are_read(tmp_path: Path) -> None:
    with (tmp_path / 'bag.mcap').open('wb') as out:
        builder = RecordBuilder()
        Header('ros2', 'test').write(builder)
        Schema(1, data=b'string data', encoding='ros2msg', name='std_msgs/msg/String').write(
            builder
        )
        Channel(id=1, topic='/said', message_encoding='cdr', metadata={}, schema_id=1).write(
            builder
        )
        Message(channel_id=1, log_time=3, data=b'before', publish_time=3, sequence=0).write(builder)
        Chunk('lz4', packed_zeros('lz4', EXPANDED), 5, 1, 0, 2**40).write(builder)
        Message(channel_id=1, log_time=9, data=b'behind', publish_time=9, sequence=1).write(builder)
        out.write(MAGIC + builder.end())
    bag = Bag(tmp_path / 'bag.mcap')
    assert [message.data for message in bag.messages()] == [b'before', b'behind']
    assert 'expected at most' in bag.damage


@pytest.mark.parametrize('compression', ['lz4', 'zstd'])
def test_unpacked_is_exact_at_its_bound(compression: str) -> None:
    packed = packed_zeros(compression, 3 * 2**20)
    assert decompress(compression, packed, 3 * 2**20) == bytes(3 * 2**20)
    with pytest.raises(DamagedError, match='more than'):
        decompress(compression, packed, 3 * 2**20 - 1)
    with pytest.raises(DamagedError, match='at most'):
        decompress(compression, packed, LOGS.chunk_bytes + 1)
    half = packed[: len(packed) // 2]
    assert 0 < len(decompress(compression, half, 3 * 2**20, whole=False)) < 3 * 2**20


@functools.cache
def _schema_parts() -> tuple[bytes, bytes]:
    builder = RecordBuilder()
    Schema(0xABCD, data=b'', encoding='', name='a').write(builder)
    before, after = builder.end().split(b'\xcd\xab')
    return before, after


def schema_record(number: int) -> bytes:
    """An empty schema with an id; RecordBuilder would take ten times as long."""
    before, after = _schema_parts()
    return before + number.to_bytes(2, 'little') + after


def test_definitions_without_end_are_refused(tmp_path: Path) -> None:
    data = b''.join(schema_record(number % 2**16) for number in range(2**16 + 2))
    with pytest.raises(DamagedError, match='schemas and channels'):
        plain_records(Section(BytesIO(data), len(data)))
    builder = RecordBuilder()
    Header('ros2', 'test').write(builder)
    for number in range(70):
        Schema(number, data=bytes(2**20), encoding='ros2msg', name='a').write(builder)
        Channel(number, f'/{number}', 'cdr', {}, number).write(builder)
    (tmp_path / 'bag.mcap').write_bytes(MAGIC + builder.end())
    with pytest.raises(InputError, match='schemas and channels: expected at most'):
        Bag(tmp_path / 'bag.mcap')


def laughs() -> str:
    """A document of some hundred characters that expands to 10^9 values."""
    lines = ['a0: &a0 [x, x, x, x, x, x, x, x, x, x]']
    for k in range(1, 10):
        names = ', '.join([f'*a{k - 1}'] * 10)
        lines.append(f'a{k}: &a{k} [{names}]')
    return '\n'.join([*lines, 'rosbag2_bagfile_information: {version: 9, storage_identifier: *a9}'])


@pytest.fixture
def in_short() -> Iterator[None]:
    """A limit of CPU time, so that other processes on the machine do not count."""
    begun = time.process_time()
    yield
    assert time.process_time() - begun < 20.0


YAML_BOMBS: dict[str, Callable[[], str]] = {
    'anchors': laughs,
    '20 levels': lambda: '[' * 100_000,
    'at most 4194304': lambda: '#' * 5_000_000,
    'at most 100': lambda: 'a: ' + '1' * 100_001,
}


@pytest.mark.usefixtures('in_short')
@pytest.mark.parametrize('said', YAML_BOMBS)
def test_metadata_that_grow_in_memory_are_not_read(tmp_path: Path, said: str) -> None:
    writer = BagWriter(tmp_path / 'bag')
    writer.write('/said', 'std_msgs/msg/String', 5, b'\0\1\0\0\1\0\0\0\0')
    writer.__exit__(None, None, None)
    (tmp_path / 'bag' / 'metadata.yaml').write_text(YAML_BOMBS[said]())
    bag = Bag(tmp_path / 'bag')
    # The bag itself is complete, and is read without the metadata.
    assert set(bag.topics) == {'/said'}
    assert re.search(f'metadata.yaml.*{said}', bag.damage)
    assert len(bag.damage) < 400
    (tmp_path / 'bag' / 'bag.mcap').unlink()
    with pytest.raises(InputError) as error:
        Bag(tmp_path / 'bag')
    assert len(str(error.value)) < 400


@pytest.mark.programs
@pytest.mark.usefixtures('in_short')
@pytest.mark.parametrize('said', YAML_BOMBS)
def test_offers_that_cannot_be_read_are_left_out(tmp_path: Path, said: str) -> None:
    builder = RecordBuilder()
    Header('ros2', 'test').write(builder)
    Schema(1, data=b'string data', encoding='ros2msg', name='std_msgs/msg/String').write(builder)
    Channel(1, '/said', 'cdr', {'offered_qos_profiles': YAML_BOMBS[said]()}, 1).write(builder)
    Message(channel_id=1, log_time=3, data=b'\0\1\0\0', publish_time=3, sequence=0).write(builder)
    DataEnd(0).write(builder)
    (tmp_path / 'bag.mcap').write_bytes(MAGIC + builder.end())
    assert Bag(tmp_path / 'bag.mcap').offers == {'/said': []}
    code, line, _ = run('bag_repair', tmp_path / 'bag.mcap', '-o', tmp_path / 'good')
    assert code == 0, line
    records = intact_records(tmp_path / 'good' / 'good.mcap', Damage())
    channel = next(record for record in records if isinstance(record, Channel))
    assert channel.metadata == {}


@pytest.mark.programs
def test_a_line_that_never_ends(tmp_path: Path) -> None:
    path = tmp_path / 'log.clf.gz'
    path.write_bytes(gzip.compress(b'FLASER 180 1.0 2.0\n') + 900 * gzip.compress(b'1' * 2**20))
    for tool, *arguments in (
        ('replay', path, '-o', tmp_path / 'out'),
        ('carmen_to_bag', path, tmp_path / 'out'),
    ):
        code, line, peak_mb = run(str(tool), *arguments)
        assert code == 2
        assert (
            f'log.clf.gz:2: a line of more than {LOGS.line_bytes} bytes' in line and len(line) < 400
        )
        assert peak_mb < MAX_MB
    assert not (tmp_path / 'out').exists()


def test_a_long_line_is_read(tmp_path: Path) -> None:
    ranges = ' '.join(['1.25'] * 100_000)
    path = tmp_path / 'log.clf'
    path.write_text(f'FLASER 100000 {ranges} 0 0 0 0 0 0 1.0 host 1.0\n' * 2)
    assert len(list(CarmenLog(path).events())) == 4


@pytest.mark.programs
@pytest.mark.cpu_budget(20.0, 'reads as many lines as a log may have')
def test_empty_lines_without_end(tmp_path: Path) -> None:
    path = tmp_path / 'log.clf.gz'
    begin = gzip.compress(('\n'.join(carmen_lines()) + '\n').encode())
    path.write_bytes(begin + 1000 * gzip.compress(b'\n' * 2**20))
    code, line, peak_mb = run('replay', path, '-o', tmp_path / 'out', '--quiet')
    assert code == 0, line
    assert peak_mb < MAX_MB
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert report['scans'] == 30, 'what comes before the limit is used'
    assert f'log.clf.gz:{LOGS.lines + 1}: expected at most' in report['first_skipped']


@pytest.mark.programs
def test_long_lines_without_end(tmp_path: Path) -> None:
    path = tmp_path / 'log.clf.gz'
    begin = gzip.compress(('\n'.join(carmen_lines()) + '\n').encode())
    path.write_bytes(begin + 1000 * gzip.compress(b' ' * (2**20 - 1) + b'\n'))
    log = CarmenLog(path)
    assert len(list(log.events())) == 90
    number = int(log.skipped.first.removeprefix(f'{path}:').partition(':')[0])
    assert 200 < number < 400, 'after 256 MB'


def compressed_bag(folder: Path, packed: bytes, name: str = 'bag_0.mcap.zstd') -> Path:
    """A bag folder of one file that is compressed as a whole."""
    folder.mkdir()
    (folder / name).write_bytes(packed)
    (folder / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information: '
        f'{{relative_file_paths: [{name}], compression_mode: FILE, compression_format: zstd}}'
    )
    return folder


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files."""
    folder = tmp_path / 'temporary'
    folder.mkdir()
    monkeypatch.setattr(tempfile, 'tempdir', str(folder))
    monkeypatch.setenv('TMPDIR', str(folder))
    return folder


@pytest.mark.parametrize('name', ['bag_0.mcap.zstd', 'bag_0.db3.zstd'])
def test_a_bag_file_that_expands_without_end(tmp_path: Path, temporary: Path, name: str) -> None:
    bag = compressed_bag(tmp_path / 'bag', packed_zeros('zstd', EXPANDED), name)
    assert (bag / name).stat().st_size < 200_000
    with pytest.raises(InputError, match=rf'{name}: expected at most {256 << 20} bytes'):
        Bag(bag)
    assert list(temporary.iterdir()) == []


def test_a_compressed_bag_file_leaves_no_file_behind(tmp_path: Path, temporary: Path) -> None:
    convert(log_of(tmp_path), tmp_path / 'plain.mcap')
    packed = zstandard.compress((tmp_path / 'plain.mcap').read_bytes())
    bag = Bag(compressed_bag(tmp_path / 'bag', packed))
    plain = Bag(tmp_path / 'plain.mcap')
    assert [m.data for m in bag.messages()] == [m.data for m in plain.messages()]
    # Not even while it is read: whatever ends the program, nothing is left.
    assert list(temporary.iterdir()) == []
    with pytest.raises(InputError, match=r'bag_0.mcap.zstd: no MCAP file'):
        Bag(compressed_bag(tmp_path / 'other', zstandard.compress(b'no bag')))


def log_of(folder: Path) -> CarmenLog:
    (folder / 'log.clf').write_text('\n'.join(carmen_lines()) + '\n')
    return CarmenLog(folder / 'log.clf')


def definitions_of(builder: RecordBuilder) -> None:
    """A channel 1 that is read, and a channel 2 that is not."""
    Schema(1, data=b'string data', encoding='ros2msg', name='std_msgs/msg/String').write(builder)
    Channel(1, '/said', 'cdr', {}, 1).write(builder)
    Channel(2, '/unread', 'cdr', {}, 1).write(builder)


@functools.cache
def unread_records(count: int, message_bytes: int) -> tuple[bytes, int, int]:
    """Messages of channel 2, compressed; their size and checksum."""
    builder = RecordBuilder()
    Message(2, log_time=5, data=bytes(message_bytes), publish_time=5, sequence=0).write(builder)
    content = builder.end() * count
    return zstandard.compress(content), len(content), zlib.crc32(content)


def bag_of_unread_chunks(path: Path, indexed: bool, kind: tuple[int, int], chunks: int) -> Path:
    """A bag without a summary, of chunks of 200 MB that nobody reads, and two messages."""
    packed, size, checksum = unread_records(*kind)
    builder = RecordBuilder()
    Header('ros2', 'test').write(builder)
    definitions_of(builder)
    Message(channel_id=1, log_time=3, data=b'before', publish_time=3, sequence=0).write(builder)
    for _ in range(chunks):
        Chunk('zstd', packed, 5, 5, checksum, size).write(builder)
        if indexed:
            MessageIndex(2, [(5, 0)]).write(builder)
    Message(channel_id=1, log_time=9, data=b'behind', publish_time=9, sequence=1).write(builder)
    path.write_bytes(MAGIC + builder.end())
    return path


READER = """
import pathlib, sys, time
from thinmap_ros.logs.readers.bag import Bag
begun = time.process_time()
bag = Bag(pathlib.Path(sys.argv[1]))
found = [message.data.decode() for message in bag.messages({'/said'})]
status = pathlib.Path('/proc/self/status').read_text()
peak = int(status.split('VmHWM:')[1].split()[0]) // 1024
print(*found, time.process_time() - begun, peak)
"""
UNREAD = {
    'indexed, small messages': (True, (2_000_000, 69), 40),
    'small messages': (False, (2_000_000, 69), 1),
    'large messages': (False, (20, 10_000_000), 10),
    'one message': (False, (1, 200_000_000), 10),
}


@pytest.mark.programs
@pytest.mark.parametrize('name', UNREAD)
def test_records_that_nobody_reads_take_no_memory(tmp_path: Path, name: str) -> None:
    indexed, kind, chunks = UNREAD[name]
    path = bag_of_unread_chunks(tmp_path / 'bag.mcap', indexed, kind, chunks)
    done = subprocess.run(
        [sys.executable, '-c', READER, path], capture_output=True, text=True, check=True
    )
    *found, cpu_s, peak_mb = done.stdout.split()
    assert found == ['before', 'behind']
    assert float(cpu_s) < MAX_CPU_S
    assert int(peak_mb) < MAX_MB


def scan_definition(*extra: str) -> Schema:
    """LaserScan as ROS defines it, with more fields."""
    known = get_typestore(Stores.ROS2_JAZZY)
    text, _ = known.generate_msgdef('sensor_msgs/msg/LaserScan', ros_version=2)
    own, separator, nested = text.partition('=' * 80)
    data = '\n'.join([own, extra[0], separator + nested, *extra[1:]])
    return Schema(1, data=data.encode(), encoding='ros2msg', name='sensor_msgs/msg/LaserScan')


def doubled(levels: int, last: str) -> list[str]:
    """A field whose number of nested fields doubles with each level."""
    parts = ['x/M0 extra']
    for k in range(levels):
        fields = f'x/M{k + 1} a\nx/M{k + 1} b' if k < levels - 1 else last
        parts.append(f'{"=" * 80}\nMSG: x/M{k}\n{fields}')
    return parts


LARGE_DEFINITIONS = {
    'fields': ['\n'.join(f'bool f{k}' for k in range(60_000))],
    'lines': [900_000 * '\n'],
    'nested': doubled(40, 'bool c'),
    'nested without data': doubled(40, 'int32 C=1'),
    'array': ['x/M0[1000000000] extra', f'{"=" * 80}\nMSG: x/M0\nbool a'],
}


@pytest.mark.usefixtures('in_short')
@pytest.mark.parametrize('name', LARGE_DEFINITIONS)
def test_a_large_definition_is_replaced_by_that_of_ros(name: str) -> None:
    schema = scan_definition(*LARGE_DEFINITIONS[name])
    assert len(schema.data) <= LOGS.schema_bytes
    assert 'extra' not in fields_of(schema) and 'ranges' in fields_of(schema)
    with pytest.raises(ValueError, match='expected at most'):
        own_typestore(schema)


def test_a_definition_with_more_fields_is_read() -> None:
    few = '\n'.join(f'bool f{k}' for k in range(3000))
    assert 'f2999' in fields_of(scan_definition(few))
    nested = doubled(10, 'bool c')
    assert 'extra' in fields_of(scan_definition(*nested))


def fields_of(schema: Schema) -> list[str]:
    return [name for name, _ in typestore_of(schema).fielddefs[schema.name][1]]
