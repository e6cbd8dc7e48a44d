"""Storage of a bag: MCAP files, read within limits, and SQLite files, read by rosbags.

Also the message types that a file defines.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol, cast

from mcap.records import Schema
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2, Nodetype, Qos
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from thinmap_ros.core.errors import InputError
from thinmap_ros.files.safe import LOGS
from thinmap_ros.logs import qos
from thinmap_ros.logs.mcap import Damage, McapFile

_IDL_SEPARATOR = '=' * 80 + '\n'


@dataclass(frozen=True)
class RawMessage:
    """A serialized message: topic, type, log time, CDR bytes."""

    topic: str
    type_name: str
    log_ns: int
    data: bytes


class Storage(Protocol):
    """One file of a bag: `topics` and their types, `offers` (QoS) of their publishers, `damage`.

    message_counts: number of messages by topic, as recorded; a topic without a number is missing.
    """

    topics: dict[str, str]
    offers: dict[str, list[Qos]]
    damage: Damage
    message_counts: dict[str, int]

    @property
    def has_messages(self) -> bool:
        """Whether it has messages."""
        ...

    def typestore(self, type_name: str) -> Typestore:
        """Typestore for decoding messages of a type."""
        ...

    def messages(self, topics: set[str] | None) -> Iterator[RawMessage]:
        """Intact messages of the given topics, or of all, in log order."""
        ...


class McapStorage:
    """An MCAP file, possibly truncated or damaged."""

    def __init__(self, path: Path) -> None:
        self._file = McapFile(path)
        self.damage = self._file.damage
        self.has_messages = self._file.has_messages
        self.message_counts = self._file.message_counts
        self.topics: dict[str, str] = {}
        self.offers: dict[str, list[Qos]] = {}
        self._schemas: dict[str, Schema] = {}
        self._typestores: dict[str, Typestore] = {}
        for number, channel in self._file.definitions.channels.items():
            known = self._file.definitions.of(number)
            if known is not None:
                self.topics[channel.topic] = known[0].name
                self.offers.setdefault(channel.topic, []).extend(qos.of_channel(channel))
                self._schemas[known[0].name] = known[0]

    def typestore(self, type_name: str) -> Typestore:
        """Types that the file defines; otherwise those of ROS 2 Jazzy."""
        if type_name not in self._typestores:
            self._typestores[type_name] = typestore_of(self._schemas[type_name])
        return self._typestores[type_name]

    def messages(self, topics: set[str] | None) -> Iterator[RawMessage]:
        """Messages in the order of the log."""
        for schema, channel, message in self._file.messages(topics):
            yield RawMessage(channel.topic, schema.name, message.log_time, message.data)


class SqliteStorage:
    """An SQLite file of a rosbag2 folder."""

    has_messages = True

    def __init__(self, path: Path) -> None:
        """Raises InputError if it cannot be opened."""
        self._path = path
        self.damage = Damage()
        self.topics: dict[str, str] = {}
        self.offers: dict[str, list[Qos]] = {}
        self.message_counts: dict[str, int] = {}
        try:
            with self._reader() as reader:
                for connection in reader.connections:
                    self.topics[connection.topic] = connection.msgtype
                    self.message_counts[connection.topic] = connection.msgcount
                    if isinstance(connection.ext, ConnectionExtRosbag2):
                        self.offers.setdefault(connection.topic, []).extend(
                            connection.ext.offered_qos_profiles
                        )
                self._typestore = reader.typestore
        except Exception as error:  # rosbags raises many types for corrupt files
            reason = ' '.join(str(error).split())[:200] or type(error).__name__
            raise InputError(f'{path}: {reason}') from error

    def typestore(self, type_name: str) -> Typestore:
        """Types of the whole file."""
        return self._typestore

    def messages(self, topics: set[str] | None) -> Iterator[RawMessage]:
        """Messages in the order of the log."""
        try:
            with self._reader() as reader:
                chosen = [c for c in reader.connections if topics is None or c.topic in topics]
                for connection, log_ns, data in reader.messages(chosen) if chosen else ():
                    yield RawMessage(connection.topic, connection.msgtype, log_ns, bytes(data))
        except Exception:  # as above; earlier messages are kept
            self.damage.is_truncated = True

    def _reader(self) -> AnyReader:
        return AnyReader([self._path], default_typestore=get_typestore(Stores.ROS2_JAZZY))


def typestore_of(schema: Schema) -> Typestore:
    """Typestore for messages of a schema: its own types, or those of ROS 2 Jazzy.

    The latter if a definition is unreadable, lacks a nested type, or lacks fields of a type of
    Jazzy.
    """
    known = get_typestore(Stores.ROS2_JAZZY)
    try:
        own = own_typestore(schema)
        own.hash_rihs01(schema.name)  # raises if a type is missing
    except Exception:  # rosbags raises many types for invalid definitions
        return known
    for name in own.fielddefs.keys() & known.fielddefs.keys():
        fields = own.fielddefs[name][1]
        if not all(field in fields for field in known.fielddefs[name][1]):
            return known
    return own


def own_typestore(schema: Schema) -> Typestore:
    """Types of one schema. Raises errors of rosbags' parser, and ValueError if too large."""
    if len(schema.data) > LOGS.schema_bytes:
        raise ValueError(f'definition of {len(schema.data)} bytes: expected {LOGS.schema_bytes}')
    text = schema.data.decode()
    _require_few(sum(map(text.count, '\n;,')), 'lines')
    typestore = _parsed(schema.name, schema.encoding, text)
    _require_few(_field_count(typestore, schema.name, {}), 'fields')
    return typestore


def _require_few(count: int, what: str) -> None:
    if count > LOGS.schema_fields:
        raise ValueError(f'definition of {count} {what}: expected at most {LOGS.schema_fields}')


def _field_count(typestore: Typestore, name: str, known: dict[str, int]) -> int:
    """Number of fields of a type with those of its nested types, each time that they occur.

    known: of the types that were counted. Types without data take time, too, but no bytes of a
    message: for a sequence of them nothing bounds the time. Raises ValueError for such a sequence,
    and for a type that contains itself.
    """
    if name in known:
        return known[name]
    known[name] = LOGS.schema_fields + 1  # if it contains itself
    total = 0
    for _, (kind, value) in typestore.fielddefs[name][1]:
        is_list = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        (element, element_name), length = cast(Any, value if is_list else ((kind, value), 1))
        if element != Nodetype.NAME:
            total += 1
            continue
        nested = _field_count(typestore, element_name, known)
        if kind == Nodetype.SEQUENCE and nested == 0:
            raise ValueError(f'sequence of {element_name[:80]}: expected a type with fields')
        total += (nested + 1) * (length if kind == Nodetype.ARRAY else 1)
    known[name] = total
    return total


@lru_cache(maxsize=64)
def _parsed(name: str, encoding: str, text: str) -> Typestore:
    typestore = get_typestore(Stores.EMPTY)
    if 'idl' not in encoding:
        typestore.register(get_types_from_msg(text, name))
        return typestore
    # rosbag2 concatenates the definitions that a type needs, each below its name.
    parts = [part.partition('\n')[2] for part in text.split(_IDL_SEPARATOR)[1:]]
    for part in parts or [text]:
        types = get_types_from_idl(part)
        unknown = types.keys() - typestore.types.keys()
        typestore.register({name: types[name] for name in unknown})
    return typestore
