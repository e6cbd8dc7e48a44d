"""Repairs truncated or damaged MCAP files: copies every intact record to a new file."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml
from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2.metadata import dump_qos_v9

from thinmap_ros.core.errors import InputError
from thinmap_ros.files.safe import LOGS, write_text
from thinmap_ros.logs import storage
from thinmap_ros.logs.mcap import Damage, DamagedError, Definitions, decompress, intact_records
from thinmap_ros.logs.storage import own_typestore


@dataclass
class RepairReport:
    """Messages by topic, damage by file, and number of messages that cannot be decompressed."""

    counts: dict[str, int] = field(default_factory=dict)
    first_ns: int | None = None
    last_ns: int = 0
    damage: dict[Path, Damage] = field(default_factory=dict)
    unreadable: int = 0

    def count(self, topic: str, log_ns: int) -> None:
        """Count a message."""
        self.counts[topic] = self.counts.get(topic, 0) + 1
        self.first_ns = log_ns if self.first_ns is None else min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)

    @property
    def reason(self) -> str:
        """Damage of the first damaged file, in one line; empty if all files are intact."""
        return next((str(damage) for damage in self.damage.values() if damage), '')


def repair(files: list[Path], folder: Path, compressed_messages: bool = False) -> RepairReport:
    """Write the intact records of MCAP files to folder/NAME.mcap and folder/metadata.yaml.

    NAME is that of the folder.
    compressed_messages: messages are compressed individually; they are written decompressed.
    Raises InputError if a file is no MCAP file, or no message is intact.
    """
    found = RepairReport()
    channels: dict[str, Channel] = {}
    schemas: dict[str, Schema] = {}
    with (folder / f'{folder.name}.mcap').open('wb') as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile='ros2')
        copy = _Copy(writer, found, channels, schemas, compressed_messages)
        for file in files:
            copy.add_file(file)
        writer.finish()
    if not found.counts:
        reason = f': {found.reason}' if found.reason else ''
        raise InputError(f'{files[0]}: no intact message{reason}')
    write_text(
        folder / 'metadata.yaml', yaml.safe_dump(_metadata(folder.name, found, channels, schemas))
    )
    return found


@dataclass
class _Copy:
    """Copies messages; equal topics of several files are merged into one channel."""

    writer: Writer
    found: RepairReport
    channels: dict[str, Channel]
    schemas: dict[str, Schema]
    compressed_messages: bool = False
    _schema_ids: dict[str, int] = field(default_factory=dict)
    _channel_ids: dict[str, int] = field(default_factory=dict)

    def add_file(self, file: Path) -> None:
        definitions = Definitions(file)
        damage = self.found.damage.setdefault(file, Damage())
        for record in intact_records(file, damage):
            if not isinstance(record, Message):
                definitions.add(record)
            elif (known := definitions.of(record.channel_id)) is not None:
                try:
                    self._write(*known, self._uncompressed(record))
                except DamagedError:
                    self.found.unreadable += 1

    def _uncompressed(self, message: Message) -> Message:
        if not self.compressed_messages:
            return message
        return replace(message, data=decompress('zstd', message.data, LOGS.chunk_bytes))

    def _write(self, schema: Schema, channel: Channel, message: Message) -> None:
        if schema.name not in self._schema_ids:
            self._schema_ids[schema.name] = self.writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        if channel.topic not in self._channel_ids:
            if not storage.of_channel(channel):
                # Players refuse a bag with messages that cannot be decompressed.
                kept = {key: value for key, value in channel.metadata.items() if key != storage.KEY}
                channel = replace(channel, metadata=kept)
            self._channel_ids[channel.topic] = self.writer.register_channel(
                channel.topic,
                channel.message_encoding,
                self._schema_ids[schema.name],
                channel.metadata,
            )
            self.channels[channel.topic] = channel
            self.schemas[channel.topic] = schema
        self.writer.add_message(
            self._channel_ids[channel.topic],
            message.log_time,
            message.data,
            message.publish_time,
            message.sequence,
        )
        self.found.count(channel.topic, message.log_time)


def _hash(schema: Schema) -> str:
    """ROS type hash of a message type; empty if its definition is unreadable."""
    try:
        return own_typestore(schema).hash_rihs01(schema.name)
    except Exception:
        # rosbags raises many types for invalid definitions.
        return ''


def _span(found: RepairReport) -> dict[str, Any]:
    first_ns = found.first_ns or 0
    return {
        'duration': {'nanoseconds': found.last_ns - first_ns},
        'starting_time': {'nanoseconds_since_epoch': first_ns},
        'message_count': sum(found.counts.values()),
    }


def _metadata(
    name: str, found: RepairReport, channels: dict[str, Channel], schemas: dict[str, Schema]
) -> dict[str, Any]:
    """Content of rosbag2's metadata.yaml."""
    topics = [
        {
            'topic_metadata': {
                'name': topic,
                'type': schemas[topic].name,
                'serialization_format': channel.message_encoding,
                'offered_qos_profiles': dump_qos_v9(storage.of_channel(channel)),
                'type_description_hash': channel.metadata.get('topic_type_hash')
                or _hash(schemas[topic]),
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
