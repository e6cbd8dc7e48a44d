"""Storage of a bag: its folder, its kind, and messages of MCAP, SQLite and ROS 1 files.

Also the message types that a file defines.
"""

import bz2
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory, TemporaryFile
from typing import IO, Any, BinaryIO, Literal, cast

import zstandard
from mcap.records import Channel, Schema
from rosbags.highlevel import AnyReader
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    Nodetype,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import (
    Chunk,
    Header,
    IndexData,
    ReaderError,
    RecordType,
    decompressors,
    read_uint32,
)
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.files.safe import (
    FILES,
    LOGS,
    PIECE_BYTES,
    open_regular_file,
    parse_yaml,
    read_text,
)
from thinmap_ros.logs.mcap import MAGIC as _MCAP
from thinmap_ros.logs.mcap import Damage, DamagedError, McapFile, decompress


@dataclass(frozen=True)
class BagFiles:
    """The files of a bag in the order of recording.

    compressed_messages: whether messages are compressed individually; without_metadata: why
    metadata.yaml was not used, empty if it was, or if nothing is missed with it; note: the same for
    files that need none.
    """

    files: list[Path]
    compressed_messages: bool = False
    without_metadata: str = ''
    note: str = ''


def bag_files(path: Path) -> BagFiles:
    """Files of a bag: the given file, or those of a folder.

    Files are found even if metadata.yaml is missing or unreadable: a killed recorder does not write
    it. Raises InputError if there are no files, or those of several bags.
    """
    if not path.is_dir():
        is_sqlite = path.suffixes[:1] == ['.db3']
        return BagFiles([path], note=f'{path}: read without metadata.yaml' if is_sqlite else '')
    metadata = path / 'metadata.yaml'
    found = mcap_files_in(path)
    try:
        return _listed(path, _information(metadata))
    except (InputError, KeyError, TypeError, ValueError, AttributeError) as error:
        reason = f'{metadata}: {one_line_reason(error).removeprefix(f"{metadata}: ")}'
    bare = sorted([*path.glob('*.db3'), *path.glob('*.db3.zstd')], key=_number)
    _require_one_bag(path, found or bare)
    if found:
        return BagFiles(found, without_metadata=reason)
    if bare:
        return BagFiles(bare, note=f'{reason}: its SQLite files are read without it')
    raise InputError(
        f'{path}: expected a rosbag2 folder, with metadata.yaml and MCAP or SQLite files'
    )


def mcap_files_in(folder: Path) -> list[Path]:
    """MCAP files of a folder in the order of recording."""
    return sorted(folder.glob('*.mcap'), key=_number)


def _require_one_bag(folder: Path, files: list[Path]) -> None:
    """Raises InputError where files have other names than the parts of one bag."""
    if len({_bag_name(file) for file in files}) > 1:
        first, second = (file.name for file in files[:2])
        raise InputError(
            f'{folder}: {len(files)} files of several bags ({first}, {second}, ...): expected one '
            f'bag, or the names of the files: {folder}/*{files[0].suffix}'
        )


def _bag_name(file: Path) -> str:
    """Name of the bag that a file is a part of: rosbag2 names them name_0, name_1, ..."""
    stem = Path(file.name.removesuffix('.zstd')).stem
    name, _, number = stem.rpartition('_')
    return name if number.isdecimal() else stem


def _number(file: Path) -> tuple[int, str]:
    """Number of a file of a bag: rosbag2 names them name_0, name_1, ... name_10."""
    number = Path(file.name.removesuffix('.zstd')).stem.rpartition('_')[2]
    return (int(number) if number.isdecimal() and len(number) < 10 else -1, file.name)


def _information(metadata: Path) -> Any:
    """Raises InputError, KeyError or TypeError if it is missing, or exceeds the YAML limits."""
    content: Any = parse_yaml(read_text(metadata, FILES.yaml_bytes))
    return content['rosbag2_bagfile_information']


def _listed(folder: Path, information: Any) -> BagFiles:
    """Raises KeyError, TypeError, ValueError or AttributeError if the information is invalid."""
    files = [folder / PurePath(name).name for name in information['relative_file_paths']]
    missing = [file.name for file in files if not file.is_file()]
    if missing or not files:
        raise ValueError(
            f'expected the file {missing[0][:80]}' if missing else 'expected the names of files'
        )
    mode = (information.get('compression_mode') or '').lower()
    return BagFiles(files, compressed_messages=mode == 'message')


class DecompressedFile:
    """A file that is compressed as a whole, decompressed for as long as this object exists.

    An MCAP file has no name, so that nothing of it is left, however the program ends. SQLite opens
    files by name only: that one is in a temporary folder.
    """

    def __init__(self, file: Path) -> None:
        """Raises InputError if a file is invalid, or expands to more than it may."""
        self._folder: TemporaryDirectory[str] | None = None
        if file.stem.endswith('.db3'):
            self._folder = TemporaryDirectory(prefix='thinmap_')
            self.path = Path(self._folder.name) / file.stem
            self._stream: IO[bytes] = self.path.open('w+b')
        else:
            self._stream = TemporaryFile()  # noqa: SIM115
            self.path = Path(f'/proc/self/fd/{self._stream.fileno()}')
        _unpack(file, self._stream)
        self._stream.flush()


def _unpack(file: Path, out: IO[bytes]) -> None:
    limit = LOGS.unpacked_bytes(file.stat().st_size)
    try:
        with open_regular_file(file) as packed:
            reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            while piece := reader.read(PIECE_BYTES):
                if out.tell() + len(piece) > limit:
                    raise InputError(f'{file}: expected at most {limit} bytes decompressed')
                out.write(piece)
    except zstandard.ZstdError as error:
        raise InputError(f'{file}: no zstd file: {str(error)[:120]}') from error


Kind = Literal['mcap', 'ros1', 'sqlite', '']
_KINDS: dict[bytes, Kind] = {
    _MCAP: 'mcap',
    b'#ROSBAG V': 'ros1',
    b'SQLite format 3\0': 'sqlite',
}
_FOREIGN: dict[Kind, str] = {
    'ros1': 'a ROS 1 bag',
    'sqlite': 'an SQLite file of a rosbag2 bag',
}


def kind_of(path: Path) -> Kind:
    """Kind of a file of a bag by its first bytes; empty for any other file.

    Also for one that cannot be read: opening it reports the error.
    """
    try:
        with open_regular_file(path) as stream:
            begin = stream.read(16)
    except OSError:
        return ''
    return next((kind for magic, kind in _KINDS.items() if begin.startswith(magic)), '')


def refuse_foreign(path: Path, expected: str) -> None:
    """Raise InputError, with a command for conversion, for a ROS 1 bag or an SQLite file."""
    name = _FOREIGN.get(kind_of(path))
    if name:
        convert = f'rosbags-convert --src {path} --dst {path.stem} --dst-storage mcap'
        raise InputError(
            f'{path}: {name}: expected {expected}: it is converted by '
            f'`{convert} --dst-typestore ros2_jazzy`'
        )


def is_bag(path: Path) -> bool:
    """Whether a path is a folder, or a file of a bag by its name or its first bytes."""
    is_named = path.is_dir() or path.suffix in ('.mcap', '.db3', '.bag', '.zstd')
    return is_named or bool(kind_of(path))


# QoS profiles in bags, stored with each topic so that players can offer the same.

# Key of a channel's metadata in an MCAP file; its value is YAML.
KEY = 'offered_qos_profiles'
_FOREVER = QosTime(2147483647, 4294967295)


def of_channel(channel: Channel) -> list[Qos]:
    """QoS of the publishers of a channel; empty if missing or unreadable."""
    text = channel.metadata.get(KEY, '')
    try:
        content: Any = parse_yaml(text) if text else []
        offers = parse_qos(content) if content else []
        depths = [offer.depth for offer in offers]
    except (InputError, KeyError, TypeError, ValueError, AttributeError):
        return []
    good = all(isinstance(depth, int) and 0 <= depth < LOGS.queue_depth for depth in depths)
    return offers if good else []


def recorded(depth: int, reliable: bool, latched: bool) -> Qos:
    """Stored QoS of a topic: depth, reliability, durability."""
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=_FOREVER,
        lifespan=_FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )


def is_latched(topic: str, offers: list[Qos]) -> bool:
    """Whether late subscribers receive the last message of a topic: all publishers offered it.

    Converted bags have no QoS of static transforms, which are always latched.
    """
    if not offers:
        return topic.endswith('tf_static')
    return all(offer.durability is QosDurability.TRANSIENT_LOCAL for offer in offers)


def is_reliable(offers: list[Qos]) -> bool:
    """Whether to offer a topic as reliable; the default if no QoS was recorded."""
    return all(offer.reliability is not QosReliability.BEST_EFFORT for offer in offers)


def depth(offers: list[Qos]) -> int:
    """Total queue depth of the publishers of a topic; the graph does not always report it."""
    return sum(max(offer.depth, 1) for offer in offers)


_IDL_SEPARATOR = '=' * 80 + '\n'


@dataclass(frozen=True)
class RawMessage:
    """A serialized message: topic, type, log time, CDR bytes."""

    topic: str
    type_name: str
    log_ns: int
    data: bytes


class Storage(ABC):
    """One file of a bag: `topics` and their types, `offers` (QoS) of their publishers, `damage`.

    message_counts: number of messages by topic, as recorded; a topic without a number is missing.
    """

    has_messages = True
    repair = '`bag_repair {}` writes a repaired bag'  # of a damaged file; '' where nothing does

    def __init__(self) -> None:
        self.damage = Damage()
        self.topics: dict[str, str] = {}
        self.offers: dict[str, list[Qos]] = {}
        self.message_counts: dict[str, int] = {}
        self._typestore = get_typestore(Stores.ROS2_JAZZY)

    def typestore(self, type_name: str) -> Typestore:
        """Typestore for decoding messages of a type."""
        return self._typestore

    @abstractmethod
    def messages(self, topics: set[str] | None) -> Iterator[RawMessage]:
        """Intact messages of the given topics, or of all, in log order."""


class McapStorage(Storage):
    """An MCAP file, possibly truncated or damaged."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._file = McapFile(path)
        self.damage = self._file.damage
        self.has_messages = self._file.has_messages
        self.message_counts = self._file.message_counts
        self._schemas: dict[str, Schema] = {}
        self._typestores: dict[str, Typestore] = {}
        for number, channel in self._file.definitions.channels.items():
            known = self._file.definitions.of(number)
            if known is not None:
                self.topics[channel.topic] = known[0].name
                self.offers.setdefault(channel.topic, []).extend(of_channel(channel))
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


class SqliteStorage(Storage):
    """An SQLite file of a rosbag2 folder; it defines all of its types together."""

    repair = ''

    def __init__(self, path: Path) -> None:
        """Raises InputError if it cannot be opened."""
        super().__init__()
        self._path = path
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


_HEADER = 'std_msgs/msg/Header'
_TIMES = ('builtin_interfaces/msg/Time', 'builtin_interfaces/msg/Duration')
# Types of ROS 1 that have another name in ROS 2.
_LONGEST_MAGIC = 64
_RENAMED = {'tf/msg/tfMessage': 'tf2_msgs/msg/TFMessage'}


@dataclass(frozen=True, eq=False)
class _Ros1Index:
    """Chunks of a ROS 1 bag, and its connections with their messages, as rosbags describes them."""

    connections: list[Connection] = field(default_factory=list)
    chunks: dict[int, Chunk] = field(default_factory=dict)
    messages: dict[int, list[IndexData]] = field(default_factory=dict)


class _IndexedReader(Reader):
    """A reader with a given index."""

    def __init__(self, path: Path, index: _Ros1Index) -> None:
        super().__init__(path)
        self._index = index

    def open(self) -> None:
        """Open the bag; nothing of it is read."""
        self.bio = self.path.open('rb')
        self.connections = list(self._index.connections)
        self.chunks = dict(self._index.chunks)
        self.indexes = dict(self._index.messages)


def _ros1_index(path: Path) -> _Ros1Index:
    """Index of a ROS 1 bag, from its chunks: a recorder writes the index when it ends.

    The last chunk may be cut off, or without its size, as of a recorder that was killed.
    """
    index = _Ros1Index()
    size = path.stat().st_size
    with open_regular_file(path) as stream:
        stream.readline(_LONGEST_MAGIC)
        for at, header, length in _ros1_records(stream, size):
            if header.get_uint8('op') != RecordType.CHUNK:
                continue
            data_at = stream.tell()
            left = size - data_at
            unpack = _bounded(decompressors.get(header.get_string('compression'), bytes))
            chunk = Chunk(min(length or left, left, LOGS.chunk_bytes), data_at, unpack)
            index.chunks[at] = chunk
            with suppress(Exception):  # rosbags raises many types for corrupt records
                _add_chunk(index, at, unpack(stream.read(chunk.datasize)))
            if length == 0:
                break
    counts = {number: len(messages) for number, messages in index.messages.items()}
    index.connections[:] = [c._replace(msgcount=counts.get(c.id, 0)) for c in index.connections]
    for messages in index.messages.values():
        messages.sort()
    return index


def _add_chunk(index: _Ros1Index, at: int, content: bytes) -> None:
    """Add the whole records of a chunk at a byte of the file."""
    reader = Reader('/dev/null')
    reader.bio = BytesIO(content)
    known = {connection.id for connection in index.connections}
    for offset, header, length in _ros1_records(reader.bio, len(content)):
        kind = header.get_uint8('op')
        if reader.bio.tell() + length > len(content):
            break
        if kind == RecordType.CONNECTION and header.get_uint32('conn') not in known:
            reader.bio.seek(offset)
            index.connections.append(reader.read_connection())
            known.add(index.connections[-1].id)
        elif kind == RecordType.MSGDATA and header.get_uint32('conn') in known:
            number = header.get_uint32('conn')
            entry = IndexData(header.get_time('time'), at, offset)
            index.messages.setdefault(number, []).append(entry)


def _ros1_records(stream: BinaryIO, size: int) -> Iterator[tuple[int, Header, int]]:
    """First byte, header and length of the data of each record, with the stream at the data.

    Up to the end, or to bytes that are no record.
    """
    at = stream.tell()
    while at < size:
        stream.seek(at)
        try:
            if read_uint32(stream) > PIECE_BYTES:
                return
            stream.seek(at)
            header = Header.read(stream)
            length = read_uint32(stream)
            header.get_uint8('op')
        except (ReaderError, ValueError):
            return
        data_at = stream.tell()
        yield at, header, length
        at = data_at + length


class Ros1Storage(Storage):
    """A ROS 1 bag, read by rosbags, with messages of ROS 2.

    Topics whose types ROS 2 does not have, or defines otherwise, are left out. One without an
    index is read up to where it was cut off.
    """

    repair = '`rosbag reindex {}` of ROS 1 repairs it'

    def __init__(self, path: Path) -> None:
        """Raises InputError if it cannot be opened."""
        super().__init__()
        self._path = path
        self._index: _Ros1Index | None = None
        try:
            self._read_topics()
        except Exception as error:  # rosbags raises many types for corrupt files
            self._index = _ros1_index(path)
            self._read_topics()
            self.damage.is_truncated = True
            if not self._index.messages:
                raise InputError(
                    f'{path}: ROS 1 bag: {one_line_reason(error)}: no intact message: `rosbag '
                    'reindex` of ROS 1 repairs a bag that was cut off'
                ) from error
        self.has_messages = any(self.message_counts.values())

    def _reader(self) -> Reader:
        return (
            Reader(self._path) if self._index is None else _IndexedReader(self._path, self._index)
        )

    def _read_topics(self) -> None:
        with self._reader() as reader:
            for connection in reader.connections:
                type_name = _type_of(connection)
                if type_name:
                    topic = connection.topic
                    self.topics[topic] = type_name
                    count = self.message_counts.get(topic, 0) + connection.msgcount
                    self.message_counts[topic] = count

    def messages(self, topics: set[str] | None) -> Iterator[RawMessage]:
        """Messages in the order of the log; up to the first damaged chunk."""
        try:
            with self._reader() as reader:
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
