"""MCAP files that were cut off or damaged: every record that is whole, and a new file made of them."""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame
import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from thinmap_ros.adapters import bag_types
from thinmap_ros.adapters.files import write_text
from thinmap_ros.core.errors import InputError

_MAGIC = b'\x89MCAP0\r\n'
_RECORD = struct.Struct('<BQ')
_CHUNK = struct.Struct('<QQQI')


@dataclass
class Salvage:
    """What was found: messages by topic, and what was not whole."""

    counts: dict[str, int] = field(default_factory=dict)
    first_ns: int | None = None
    last_ns: int = 0
    damaged_chunks: int = 0
    cut_off: bool = False

    def count(self, topic: str, log_ns: int) -> None:
        """Count one message."""
        self.counts[topic] = self.counts.get(topic, 0) + 1
        self.first_ns = log_ns if self.first_ns is None else min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)


def repair(files: list[Path], folder: Path) -> Salvage:
    """Write what is whole in MCAP files into folder/NAME.mcap and folder/metadata.yaml, NAME being the folder's.

    Raises InputError where a file is no MCAP file, or no whole message is left.
    """
    found = Salvage()
    channels: dict[str, Channel] = {}
    schemas: dict[str, Schema] = {}
    with (folder / f'{folder.name}.mcap').open('wb') as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile='ros2')
        copy = _Copy(writer, found, channels, schemas)
        for file in files:
            copy.take(file)
        writer.finish()
    if not found.counts:
        raise InputError(f'{files[0]}: no whole message is left in it')
    write_text(folder / 'metadata.yaml', yaml.safe_dump(_metadata(folder.name, found, channels, schemas)))
    return found


@dataclass
class _Copy:
    """Copies messages; the same topic of several files becomes one channel."""

    writer: Writer
    found: Salvage
    channels: dict[str, Channel]
    schemas: dict[str, Schema]
    _schema_ids: dict[str, int] = field(default_factory=dict)
    _channel_ids: dict[str, int] = field(default_factory=dict)

    def take(self, file: Path) -> None:
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for record in whole_records(file, self.found):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif record.channel_id in channels and channels[record.channel_id].schema_id in schemas:
                channel = channels[record.channel_id]
                self._write(schemas[channel.schema_id], channel, record)

    def _write(self, schema: Schema, channel: Channel, message: Message) -> None:
        if schema.name not in self._schema_ids:
            self._schema_ids[schema.name] = self.writer.register_schema(schema.name, schema.encoding, schema.data)
        if channel.topic not in self._channel_ids:
            self._channel_ids[channel.topic] = self.writer.register_channel(
                channel.topic, channel.message_encoding, self._schema_ids[schema.name], channel.metadata
            )
            self.channels[channel.topic], self.schemas[channel.topic] = channel, schema
        self.writer.add_message(
            self._channel_ids[channel.topic], message.log_time, message.data, message.publish_time, message.sequence
        )
        self.found.count(channel.topic, message.log_time)


def whole_records(file: Path, found: Salvage) -> Iterator[Schema | Channel | Message]:
    """Schemas, channels and messages of a file, in and outside of chunks, as far as they are whole.

    A chunk whose bytes were changed is left out; of one that was cut off, what came before the cut is taken.
    Raises InputError where the file does not begin as MCAP files do.
    """
    with file.open('rb') as stream:
        if stream.read(len(_MAGIC)) != _MAGIC:
            raise InputError(f'{file}: no MCAP file: expected it to begin with {_MAGIC!r}')
        while True:
            head = stream.read(_RECORD.size)
            if len(head) < _RECORD.size:
                found.cut_off = True
                return
            code, length = _RECORD.unpack(head)
            if code in (Opcode.DATA_END, Opcode.FOOTER):
                return
            # Read at most what is there: a damaged length may be astronomical.
            content = stream.read(min(length, file.stat().st_size))
            whole = len(content) == length
            if code == Opcode.CHUNK:
                yield from _of_chunk(content, whole, found)
            elif whole:
                yield from _parsed(code, content)
            if not whole:
                found.cut_off = True
                return


def _of_chunk(content: bytes, whole: bool, found: Salvage) -> Iterator[Schema | Channel | Message]:
    try:
        _, _, _, checksum = _CHUNK.unpack_from(content)
        (n,) = struct.unpack_from('<I', content, _CHUNK.size)
        name = content[_CHUNK.size + 4 : _CHUNK.size + 4 + n].decode('ascii')
        data = _unpacked(name, content[_CHUNK.size + 12 + n :], whole)
        if whole and checksum and zlib.crc32(data) != checksum:
            raise ValueError('checksum')
        # All of it before any of it: what stumbles half-way through a chunk has misread it from somewhere on.
        records = list(_records(data))
    except (struct.error, ValueError, RuntimeError, zstandard.ZstdError):
        found.damaged_chunks += 1
        return
    yield from records


def _unpacked(compression: str, data: bytes, whole: bool) -> bytes:
    if compression == '':
        return data
    if compression == 'zstd':
        unpacker: Any = zstandard.ZstdDecompressor().decompressobj()
    elif compression == 'lz4':
        unpacker = lz4.frame.LZ4FrameDecompressor()
    else:
        raise ValueError(f'compression {compression}')
    if whole:
        return bytes(unpacker.decompress(data))
    # Bit by bit, so that what comes out before the cut is kept.
    parts = []
    for at in range(0, len(data), 4096):
        parts.append(unpacker.decompress(data[at : at + 4096]))
    return b''.join(parts)


def _records(data: bytes) -> Iterator[Schema | Channel | Message]:
    at = 0
    while at + _RECORD.size <= len(data):
        code, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if at + length > len(data):
            return
        yield from _parsed(code, data[at : at + length])
        at += length


def _parsed(code: int, content: bytes) -> Iterator[Schema | Channel | Message]:
    stream = ReadDataStream(BytesIO(content))
    if code == Opcode.SCHEMA:
        yield Schema.read(stream)
    elif code == Opcode.CHANNEL:
        yield Channel.read(stream)
    elif code == Opcode.MESSAGE:
        yield Message.read(stream, len(content))


def _hash(schema: Schema) -> str:
    """Hash of a message type as ROS computes it; empty where its definition cannot be read."""
    typestore = get_typestore(Stores.EMPTY)
    try:
        bag_types.learn(typestore, schema)
        return typestore.hash_rihs01(schema.name)
    except Exception:  # rosbags' parser and hasher raise whatever a broken definition makes them stumble over
        return ''


def _span(found: Salvage) -> dict[str, Any]:
    first_ns = found.first_ns or 0
    return {
        'duration': {'nanoseconds': found.last_ns - first_ns},
        'starting_time': {'nanoseconds_since_epoch': first_ns},
        'message_count': sum(found.counts.values()),
    }


def _metadata(name: str, found: Salvage, channels: dict[str, Channel], schemas: dict[str, Schema]) -> dict[str, Any]:
    """Content of rosbag2's metadata.yaml."""
    topics = [
        {
            'topic_metadata': {
                'name': topic,
                'type': schemas[topic].name,
                'serialization_format': channel.message_encoding,
                'offered_qos_profiles': yaml.safe_load(channel.metadata.get('offered_qos_profiles', '')) or [],
                'type_description_hash': channel.metadata.get('topic_type_hash') or _hash(schemas[topic]),
            },
            'message_count': found.counts[topic],
        }
        for topic, channel in channels.items()
    ]
    return {
        'rosbag2_bagfile_information': {
            'version': 9,
            'storage_identifier': 'mcap',
            'relative_file_paths': [f'{name}.mcap'],
            **_span(found),
            'topics_with_message_count': topics,
            'compression_format': '',
            'compression_mode': '',
            'files': [{'path': f'{name}.mcap', **_span(found)}],
            'custom_data': None,
            'ros_distro': 'jazzy',
        }
    }
