"""ROS 1 bags, read by rosbags; their messages are converted to those of ROS 2."""

import bz2
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from mcap.records import Schema
from rosbags.interfaces import Connection, Nodetype, Qos
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import decompressors
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.files.safe import LOGS
from thinmap_ros.logs.mcap import Damage, DamagedError, decompress
from thinmap_ros.logs.storage import RawMessage, own_typestore

_HEADER = 'std_msgs/msg/Header'
_TIMES = ('builtin_interfaces/msg/Time', 'builtin_interfaces/msg/Duration')
# Types of ROS 1 that have another name in ROS 2.
_RENAMED = {'tf/msg/tfMessage': 'tf2_msgs/msg/TFMessage'}


class Ros1Storage:
    """A ROS 1 bag. Topics whose types ROS 2 does not have, or defines otherwise, are left out."""

    def __init__(self, path: Path) -> None:
        """Raises InputError if it cannot be opened."""
        self._path = path
        self.damage = Damage()
        self.topics: dict[str, str] = {}
        self.offers: dict[str, list[Qos]] = {}
        self.message_counts: dict[str, int] = {}
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        try:
            with Reader(path) as reader:
                for connection in reader.connections:
                    type_name = _type_of(connection)
                    if type_name:
                        topic = connection.topic
                        self.topics[topic] = type_name
                        count = self.message_counts.get(topic, 0) + connection.msgcount
                        self.message_counts[topic] = count
        except Exception as error:  # rosbags raises many types for corrupt files
            raise InputError(
                f'{path}: ROS 1 bag: {one_line_reason(error)}: `rosbag reindex` of ROS 1 repairs a '
                'bag that was cut off'
            ) from error

    @property
    def has_messages(self) -> bool:
        """Whether it has messages."""
        return any(self.message_counts.values())

    def typestore(self, type_name: str) -> Typestore:
        """Types of ROS 2 Jazzy."""
        return self._typestore

    def messages(self, topics: set[str] | None) -> Iterator[RawMessage]:
        """Messages in the order of the log; up to the first damaged chunk."""
        try:
            with Reader(self._path) as reader:
                for position, chunk in reader.chunks.items():
                    unpack = _bounded(chunk.decompressor)
                    reader.chunks[position] = chunk._replace(decompressor=unpack)
                chosen = [c for c in reader.connections if self._is_chosen(c, topics)]
                for connection, log_ns, data in reader.messages(chosen) if chosen else ():
                    yield self._converted(connection, log_ns, data)
        except Exception:  # as above; earlier messages are kept
            self.damage.is_truncated = True

    def _is_chosen(self, connection: Connection, topics: set[str] | None) -> bool:
        is_wanted = topics is None or connection.topic in topics
        return is_wanted and _type_of(connection) == self.topics.get(connection.topic, '')

    def _converted(self, connection: Connection, log_ns: int, data: bytes) -> RawMessage:
        type_name = _type_of(connection)
        try:
            cdr = bytes(self._typestore.ros1_to_cdr(data, type_name))
        except Exception:  # rosbags raises many types for invalid bytes
            cdr = b''  # it is counted when it is decoded
        return RawMessage(connection.topic, type_name, log_ns, cdr)


def _type_of(connection: Connection) -> str:
    return _type_name(connection.msgtype, connection.msgdef.data)


def _bounded(unpack: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """A decompressor that does not expand a chunk beyond LOGS.chunk_bytes."""
    own = {decompressors['bz2']: _unpack_bz2, decompressors['lz4']: _unpack_lz4}
    return own.get(unpack, unpack)


def _unpack_bz2(packed: bytes) -> bytes:
    unpacked = bz2.BZ2Decompressor().decompress(packed, max_length=LOGS.chunk_bytes + 1)
    if len(unpacked) > LOGS.chunk_bytes:
        raise DamagedError(f'chunk: expected at most {LOGS.chunk_bytes} bytes uncompressed')
    return unpacked


def _unpack_lz4(packed: bytes) -> bytes:
    return decompress('lz4', packed, LOGS.chunk_bytes)


@lru_cache(maxsize=1024)
def _type_name(name: str, definition: str) -> str:
    """Type of ROS 2 for one of ROS 1 with its definition; empty if none has the same fields."""
    new_name = _RENAMED.get(name, name)
    try:
        own = own_typestore(Schema(0, definition.encode(), 'ros1msg', name))
    except Exception:  # rosbags raises many types for invalid definitions
        return ''
    return new_name if _is_equal(own, name, new_name) else ''


def _is_equal(own: Typestore, name: str, new_name: str) -> bool:
    """Whether a type has the fields of one of ROS 2, but for the number of a header."""
    known = get_typestore(Stores.ROS2_JAZZY).fielddefs
    if new_name not in known:
        return False
    fields = [field for field in own.fielddefs[name][1] if (name, field[0]) != (_HEADER, 'seq')]
    kinds = [kind for _, kind in fields]
    if kinds != [kind for _, kind in known[new_name][1]]:
        return False
    return all(_is_equal(own, inner, inner) for inner in _nested(kinds))


def _nested(kinds: list[Any]) -> Iterator[str]:
    """Names of the types of fields and of their elements."""
    for kind, value in kinds:
        is_list = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        element, name = value[0] if is_list else (kind, value)
        if element == Nodetype.NAME and name not in _TIMES:
            yield name
