"""Reads MCAP files, also truncated or damaged ones: intact messages in log order or file order.

The `mcap` package has no recovery (`mcap recover` is a program written in Go), and neither it nor
rosbags limits the decompressed size of a chunk. Of `mcap` the record types are used, and the reader
for the summary alone. Declared sizes are checked before memory is allocated.

Source: https://mcap.dev/spec.
"""

import heapq
import struct
import zlib
from array import array
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from io import BufferedReader, BytesIO, RawIOBase
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Message, Schema, Statistics
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import LATEST_NS
from thinmap_ros.files.safe import LOGS, PIECE_BYTES, open_regular_file

MAGIC = b'\x89MCAP0\r\n'
FIRST_PRIVATE_OPCODE = 0x80
HEAD = struct.Struct('<BQ')
_CHUNK = struct.Struct('<QQQI')
_LENGTH = struct.Struct('<I')
_MESSAGE = struct.Struct('<HIQQ')
_PLAIN = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_SLICE = 2**16
_LONGEST_NAME = 1000  # of a compression
Definition = Schema | Channel


class DamagedError(Exception):
    """Damaged bytes: what was found, and what was expected."""


@dataclass(eq=False)
class Records:
    """The records of a chunk, or of a range of the file without chunks.

    definitions: schemas and channels; log_ns (N,), offsets (N,): the messages of the wanted
    channels in file order, with offsets into `data`, which holds only these; count, first_ns,
    channel_ids: number, earliest log time and channels of all messages; damaged: why records were
    omitted, else empty.
    """

    data: bytearray = field(default_factory=bytearray)
    definitions: list[Definition] = field(default_factory=list)
    log_ns: 'array[int]' = field(default_factory=lambda: array('Q'))
    offsets: 'array[int]' = field(default_factory=lambda: array('Q'))
    count: int = 0
    first_ns: int = LATEST_NS
    channel_ids: set[int] = field(default_factory=set)
    damaged: str = ''
    _is_last_kept: bool = False

    def message(self, index: int) -> Message:
        """Message by its index in `offsets`."""
        at = self.offsets[index]
        (_, length) = HEAD.unpack_from(self.data, at - HEAD.size)
        channel_id, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(self.data, at)
        content = bytes(self.data[at + _MESSAGE.size : at + length])
        return Message(channel_id, log_ns, content, publish_ns, sequence)

    def messages(self) -> Iterator[Message]:
        """All messages in the order of the file."""
        return (self.message(index) for index in range(len(self.offsets)))

    def add_message(self, channel_id: int, log_ns: int, record: bytes) -> None:
        """Count a message, and keep its whole record, unless that is empty."""
        self.count += 1
        self.first_ns = min(self.first_ns, log_ns)
        self.channel_ids.add(channel_id)
        self._is_last_kept = bool(record)
        if record:
            self.log_ns.append(log_ns)
            self.offsets.append(len(self.data) + HEAD.size)
            self.data += record

    def omit(self, reason: str) -> None:
        """Something is damaged; the first reason counts."""
        self.damaged = self.damaged or reason

    def drop_last(self) -> None:
        """Omit the last message, once."""
        self.count = max(self.count - 1, 0)
        if self._is_last_kept:
            del self.log_ns[-1:]
            del self.offsets[-1:]
        self._is_last_kept = False


class Section:
    """The next bytes of a stream, at most `left`."""

    def __init__(self, stream: BinaryIO, left: int) -> None:
        self._stream = stream
        self.left = left

    def read(self, size: int) -> bytes:
        """Read up to `size` bytes; none at the end of the section or of the stream."""
        piece = self._stream.read(max(min(size, self.left), 0))
        self.left -= len(piece)
        return piece


def chunk_records(content: Section, whole: bool, wanted: frozenset[int] | None = None) -> Records:
    """Records in the content of a chunk; if it is truncated (not `whole`), those before the end.

    wanted: the channels whose messages are kept, None for all. Only these take memory: the chunk is
    unpacked in pieces. Raises DamagedError if it is corrupt or larger than LOGS.chunk_bytes.
    """
    try:
        _, _, size, checksum = _CHUNK.unpack(content.read(_CHUNK.size))
        (n,) = _LENGTH.unpack(content.read(_LENGTH.size))
        compression = content.read(min(n, _LONGEST_NAME)).decode('ascii')
        (length,) = struct.unpack('<Q', content.read(8))
    except (struct.error, ValueError) as error:
        raise DamagedError(f'no chunk header: {_short(error)}') from error
    if whole and content.left < length:
        raise DamagedError(f'{content.left} bytes compressed: expected {length}')
    # The length of the record itself may be damaged.
    complete = content.left >= length
    content.left = min(content.left, length)
    stream = _Unpacked(_pieces(compression, content, size, complete))
    records = _records(stream, size, complete, wanted)
    if complete and stream.size != size:
        raise DamagedError(f'{stream.size} bytes uncompressed: expected {size}')
    if complete and checksum and stream.checksum != checksum:
        raise DamagedError('wrong checksum')
    return records


def decompress(compression: str, data: bytes, size: int, whole: bool = True) -> bytes:
    """Uncompressed bytes; of truncated data (not `whole`), those before the end.

    size: declared bytes; no more is ever decompressed. Raises DamagedError if it exceeds
    LOGS.chunk_bytes, or the data expand to more than declared.
    """
    result = bytearray()
    for piece in _pieces(compression, Section(BytesIO(data), len(data)), size, whole):
        result += piece
    return bytes(result)


def _pieces(compression: str, packed: Section, size: int, whole: bool) -> Iterator[bytes]:
    """Uncompressed pieces of data; raises DamagedError as `decompress` does."""
    if size > LOGS.chunk_bytes:
        raise DamagedError(f'{size} bytes uncompressed: expected at most {LOGS.chunk_bytes}')
    unpack = {'': _plain_pieces, 'lz4': _lz4_pieces, 'zstd': _zstd_pieces}.get(compression)
    if unpack is None:
        raise DamagedError(f'compression {compression[:20]!r}: expected none, lz4 or zstd')
    unpacked = 0
    try:
        for piece in unpack(packed):
            unpacked += len(piece)
            if unpacked > size:
                raise DamagedError(f'more than the declared {size} bytes uncompressed')
            yield piece
    except (RuntimeError, zstandard.ZstdError) as error:
        if whole:
            raise DamagedError(f'{compression}: {_short(error)}') from error


def _plain_pieces(data: Section) -> Iterator[bytes]:
    while piece := data.read(PIECE_BYTES):
        yield piece


def _zstd_pieces(data: Section) -> Iterator[bytes]:
    source: Any = data  # of the methods of a stream, only `read` is used
    reader = zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True)
    while piece := reader.read(PIECE_BYTES):
        yield piece


def _lz4_pieces(data: Section) -> Iterator[bytes]:
    unpacker: Any = lz4.frame.LZ4FrameDecompressor()
    while packed := data.read(_SLICE):
        yield unpacker.decompress(packed, max_length=PIECE_BYTES)
        while not unpacker.needs_input and not unpacker.eof:
            yield unpacker.decompress(b'', max_length=PIECE_BYTES)
        if unpacker.eof:
            return


def plain_records(content: Section, wanted: frozenset[int] | None = None) -> Records:
    """Consecutive records outside of chunks, up to the end or to bytes that are no record.

    The message before such bytes is omitted, too: most likely its length is wrong. wanted: as in
    `chunk_records`. Raises DamagedError if there are too many definitions.
    """
    return _records(_Unpacked(_plain_pieces(content)), content.left, True, wanted)


class _Unpacked(RawIOBase):
    """Pieces of bytes as a stream; counts what it has read, with its checksum."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self.size = 0
        self.checksum = 0
        self._pieces = pieces
        self._piece = memoryview(b'')

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        while not self._piece:
            piece = next(self._pieces, None)
            if piece is None:
                return 0
            self.size += len(piece)
            self.checksum = zlib.crc32(piece, self.checksum)
            self._piece = memoryview(piece)
        n = min(len(buffer), len(self._piece))
        buffer[:n] = self._piece[:n]
        self._piece = self._piece[n:]
        return n


def _records(unpacked: _Unpacked, size: int, whole: bool, wanted: frozenset[int] | None) -> Records:
    """Records of a stream of `size` bytes; in truncated data the last one may be incomplete."""
    stream = BufferedReader(unpacked, _SLICE)
    found = Records()
    at = 0
    is_record = True
    is_complete = True
    while is_complete and (head := stream.read(HEAD.size)):
        code, length = HEAD.unpack(head) if len(head) == HEAD.size else (Opcode.MESSAGE, size)
        is_record = code in _PLAIN or code >= FIRST_PRIVATE_OPCODE
        end = at + HEAD.size + length
        is_complete = is_record and end <= size and _add(found, stream, head, wanted)
        at = end if is_complete else at
    _skip(stream, size)
    if not is_complete and (whole or not is_record):
        found.omit(f'no record at byte {at} of {unpacked.size}')
        found.drop_last()
    return found


def _add(found: Records, stream: BinaryIO, head: bytes, wanted: frozenset[int] | None) -> bool:
    """Add the record behind a head, or why it is invalid; returns whether it is complete."""
    code, length = HEAD.unpack(head)
    if code == Opcode.MESSAGE and length >= _MESSAGE.size:
        return _add_message(found, stream, head, wanted)
    if code >= FIRST_PRIVATE_OPCODE:
        return _skip(stream, length)
    content = stream.read(length)
    if len(content) < length:
        return False
    if code == Opcode.MESSAGE:
        found.omit(f'message of {length} bytes: expected at least {_MESSAGE.size}')
        return True
    try:
        found.definitions.append(definition(code, content))
    except DamagedError as error:
        found.omit(str(error))
    if len(found.definitions) > LOGS.definitions:
        raise DamagedError(f'more than {LOGS.definitions} schemas and channels')
    return True


def _add_message(
    found: Records, stream: BinaryIO, head: bytes, wanted: frozenset[int] | None
) -> bool:
    fields = stream.read(_MESSAGE.size)
    if len(fields) < _MESSAGE.size:
        return False
    channel_id, _, log_ns, _ = _MESSAGE.unpack(fields)
    rest = int(HEAD.unpack(head)[1]) - _MESSAGE.size
    record = b''
    if wanted is None or channel_id in wanted:
        content = stream.read(rest)
        is_complete = len(content) == rest
        record = head + fields + content
    else:
        is_complete = _skip(stream, rest)
    if is_complete and log_ns >= LATEST_NS:
        found.omit(f'message logged at {log_ns} ns: expected less than {LATEST_NS}')
    elif is_complete:
        found.add_message(channel_id, log_ns, record)
    return is_complete


def _skip(stream: BinaryIO, size: int) -> bool:
    """Skip bytes, in pieces; returns whether there were as many."""
    while size > 0 and (piece := stream.read(min(size, PIECE_BYTES))):
        size -= len(piece)
    return size == 0


def definition(code: int, content: bytes) -> Definition:
    """Schema or channel from the content of its record. Raises DamagedError if it is invalid."""
    stream = ReadDataStream(BytesIO(content))
    builder = RecordBuilder()
    try:
        record: Definition = Schema.read(stream) if code == Opcode.SCHEMA else Channel.read(stream)
        record.write(builder)
    except (McapError, struct.error, ValueError) as error:
        raise DamagedError(f'{Opcode(code).name.lower()}: {_short(error)}') from error
    # mcap accepts strings whose declared length exceeds the data.
    if not content.startswith(builder.end()[HEAD.size :]):
        raise DamagedError(
            f'{Opcode(code).name.lower()}: lengths that do not fit its {len(content)} bytes'
        )
    return record


def _short(error: Exception) -> str:
    return ' '.join(str(error).split())[:80] or type(error).__name__


_FOOTER = struct.Struct('<QQI')
_CHANNEL_ID = struct.Struct('<H')


@dataclass
class Damage:
    """Damaged parts of a file: description by first byte."""

    is_truncated: bool = False
    parts: dict[int, str] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return self.is_truncated or bool(self.parts)

    def __str__(self) -> str:
        words = ['cut off'] if self.is_truncated else []
        if self.parts:
            at, reason = next(iter(self.parts.items()))
            n = len(self.parts)
            count = 'a damaged part' if n == 1 else f'{n} damaged parts, the first'
            words.append(f'{count} at byte {at}: {reason}')
        return '; '.join(words)


@dataclass
class Definitions:
    """Schemas and channels by id; the later one of equal ids counts."""

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    _bytes: int = 0

    def add(self, record: Definition) -> None:
        """Add a schema or channel. Raises InputError if their total size is too large."""
        known = self._like(record)
        if record == known.get(record.id):
            return
        known[record.id] = record
        builder = RecordBuilder()
        record.write(builder)
        self._bytes += builder.count
        if self._bytes > LOGS.definitions_bytes:
            expected = f'expected at most {LOGS.definitions_bytes} bytes'
            raise InputError(f'{self.path}: schemas and channels: {expected}')

    def add_missing(self, record: Definition) -> None:
        """As `add`, unless there is one of this id."""
        if record.id not in self._like(record):
            self.add(record)

    def _like(self, record: Definition) -> dict[int, Any]:
        return self.schemas if isinstance(record, Schema) else self.channels

    def of(self, channel_id: int) -> tuple[Schema, Channel] | None:
        """Channel and its schema; None if one of them is unknown."""
        channel = self.channels.get(channel_id)
        schema = None if channel is None else self.schemas.get(channel.schema_id)
        return None if channel is None or schema is None else (schema, channel)


@dataclass(frozen=True)
class ChunkSpan:
    """A chunk, or a range of records outside of chunks: bytes `start` to `end` of the file.

    whole: it is not truncated; first_ns: log time of its earliest message; channel_ids: channels of
    its messages, None if unknown.
    """

    start: int
    end: int
    is_chunk: bool
    whole: bool = True
    first_ns: int = 0
    channel_ids: frozenset[int] | None = None


@dataclass(frozen=True)
class Summary:
    """Summary section of a file that was closed properly.

    message_counts: by channel; empty if they are not recorded.
    """

    definitions: list[Definition]
    blocks: list[ChunkSpan]
    message_counts: dict[int, int] = field(default_factory=dict)


class McapFile:
    """An MCAP file opened for reading in log order, by its summary, or by a first pass without one.

    damage: damaged parts; with a summary, some are found only while reading. has_messages: whether
    there are any. message_counts: by topic, as recorded in the summary.
    """

    def __init__(self, path: Path) -> None:
        """Raises InputError if it is no MCAP file, OSError if it is missing."""
        self.path = path
        self.damage = Damage()
        self.definitions = Definitions(path)
        summary = summary_of(path)
        for record in summary.definitions:
            self.definitions.add(record)
        self._chunk_spans = summary.blocks if self.definitions.channels else []
        if not self._chunk_spans:
            self._chunk_spans = list(_first_pass(path, summary, self.definitions, self.damage))
        self.has_messages = bool(self._chunk_spans)
        self.message_counts = {
            channel.topic: summary.message_counts[number]
            for number, channel in self.definitions.channels.items()
            if number in summary.message_counts
        }

    def messages(self, topics: set[str] | None = None) -> Iterator[tuple[Schema, Channel, Message]]:
        """Messages of the given topics, or of all, in the order of the log."""
        chosen = {
            number: known
            for number, channel in self.definitions.channels.items()
            if (topics is None or channel.topic in topics)
            and (known := self.definitions.of(number)) is not None
        }
        for message in self._in_log_order(frozenset(chosen)):
            yield *chosen[message.channel_id], message

    def _in_log_order(self, channel_ids: frozenset[int]) -> Iterator[Message]:
        queue = _LogOrder()
        blocks = [
            b for b in self._chunk_spans if b.channel_ids is None or b.channel_ids & channel_ids
        ]
        with open_regular_file(self.path) as stream:
            for block in sorted(blocks, key=lambda b: b.first_ns):
                yield from queue.before(block.first_ns)
                records = _load_intact(stream, block, channel_ids, self.damage)
                if records is not None:
                    queue.add(records)
        yield from queue.before(None)


class _LogOrder:
    """Merges the messages of chunks by log time.

    It buffers about `LOGS.buffered_bytes` at most: beyond that, messages are out of order.
    """

    def __init__(self) -> None:
        self._loaded: dict[int, tuple[Records, NDArray[np.intp]]] = {}
        self._heap: list[tuple[int, int, int]] = []
        self._held = 0
        self._number = 0

    def add(self, records: Records) -> None:
        """Add the records of a chunk."""
        order = np.argsort(records.log_ns, kind='stable')
        if order.size:
            self._number += 1
            self._loaded[self._number] = (records, order)
            self._held += len(records.data)
            heapq.heappush(self._heap, (int(records.log_ns[order[0]]), self._number, 0))

    def before(self, log_ns: int | None) -> Iterator[Message]:
        """Messages before a log time, or all remaining ones."""
        while self._heap:
            if not (
                log_ns is None or self._heap[0][0] < log_ns or self._held > LOGS.buffered_bytes
            ):
                return
            _, number, place = self._heap[0]
            records, order = self._loaded[number]
            yield records.message(int(order[place]))
            if place + 1 < order.size:
                following = (int(records.log_ns[order[place + 1]]), number, place + 1)
                heapq.heapreplace(self._heap, following)
            else:
                heapq.heappop(self._heap)
                del self._loaded[number]
                self._held -= len(records.data)


def intact_records(path: Path, damage: Damage) -> Iterator[Definition | Message]:
    """Intact schemas, channels and messages in file order; damaged parts are added to `damage`.

    Raises InputError if the file does not begin with the magic bytes of MCAP.
    """
    summary = summary_of(path)
    yield from summary.definitions
    with _opened(path) as stream:
        for block in _chunk_spans(stream, path, summary, damage):
            records = _load_intact(stream, block, None, damage)
            if records is not None:
                yield from records.definitions
                yield from records.messages()


def _first_pass(
    path: Path, summary: Summary, definitions: Definitions, damage: Damage
) -> Iterator[ChunkSpan]:
    """Chunk spans with messages of a file; its definitions and damaged parts are added to these.

    A chunk is unpacked only if its message index names a channel that is not known yet, or if it
    has no message index; or to look for a channel that a later chunk does not define itself.
    """
    packed: list[ChunkSpan] = []
    with _opened(path) as stream:
        for block in _chunk_spans(stream, path, summary, damage):
            channel_ids = _indexed_channels(stream, block)
            if channel_ids and channel_ids <= definitions.channels.keys():
                packed.append(block)
                first_ns = _first_log_time(stream, block)
                yield replace(block, first_ns=first_ns, channel_ids=channel_ids)
                continue
            records = _load_intact(stream, block, frozenset(), damage)
            if records is None:
                continue
            for record in records.definitions:
                definitions.add(record)
            # A recorder defines a channel when it subscribes, some time before the first message.
            while packed and any(definitions.of(k) is None for k in records.channel_ids):
                earlier = _load_intact(stream, packed.pop(), frozenset(), damage)
                for record in earlier.definitions if earlier else ():
                    definitions.add_missing(record)
            if records.count:
                channel_ids = frozenset(records.channel_ids)
                yield replace(block, first_ns=records.first_ns, channel_ids=channel_ids)


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """The opened file. Raises InputError if it does not begin with the magic bytes of MCAP."""
    with open_regular_file(path) as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            raise InputError(f'{path}: no MCAP file: expected it to begin with {MAGIC!r}')
        yield stream


def _indexed_channels(stream: BinaryIO, block: ChunkSpan) -> frozenset[int]:
    """Channels of a chunk by the message indexes behind it; none if it has no index."""
    channel_ids: set[int] = set()
    at = block.end
    while block.is_chunk and block.whole:
        stream.seek(at)
        head = stream.read(HEAD.size + _CHANNEL_ID.size)
        if len(head) < HEAD.size + _CHANNEL_ID.size:
            break
        code, length = HEAD.unpack_from(head)
        if code != Opcode.MESSAGE_INDEX or length < _CHANNEL_ID.size:
            break
        channel_ids.update(_CHANNEL_ID.unpack_from(head, HEAD.size))
        at += HEAD.size + length
    return frozenset(channel_ids)


def _first_log_time(stream: BinaryIO, block: ChunkSpan) -> int:
    """Log time of the earliest message of a chunk, as its header says."""
    stream.seek(block.start + HEAD.size)
    return int.from_bytes(stream.read(8), 'little')


def _chunk_spans(
    stream: BinaryIO, path: Path, summary: Summary, damage: Damage
) -> Iterator[ChunkSpan]:
    """Chunk spans of a file in its order; damaged parts are added to `damage`.

    After a damaged part, reading continues at the next chunk of the summary. Data that a recorder
    has appended since are ignored.
    """
    size = path.stat().st_size
    chunks = sorted(block.start for block in summary.blocks)
    at = len(MAGIC)
    stretch = at
    while True:
        stream.seek(at)
        head = stream.read(HEAD.size) if at + HEAD.size <= size else b''
        code, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
        end = at + HEAD.size + length
        plain = code in _PLAIN and end <= size and length <= LOGS.chunk_bytes
        if stretch < at and (not plain or end - stretch > PIECE_BYTES):
            yield ChunkSpan(stretch, at, is_chunk=False)
            stretch = at
        if (code, length) in ((Opcode.DATA_END, 4), (Opcode.FOOTER, _FOOTER.size)):
            stream.seek(size - len(MAGIC))
            damage.is_truncated = (
                stream.read() != MAGIC
            )  # the messages are intact, the summary is not
            return
        if code == Opcode.CHUNK:
            yield ChunkSpan(at, min(end, size), is_chunk=True, whole=end <= size)
        if end <= size and (0 < code <= Opcode.DATA_END or code >= FIRST_PRIVATE_OPCODE):
            if code in _PLAIN and not plain:
                damage.parts[at] = f'record of {length} bytes: expected at most {LOGS.chunk_bytes}'
            at = end
            stretch = stretch if plain else at
            continue
        following = bisect_right(chunks, at)
        if following == len(chunks):
            damage.is_truncated = True
            return
        damage.parts.setdefault(at, 'no record')
        at = chunks[following]
        stretch = at


def _load_intact(
    stream: BinaryIO, block: ChunkSpan, wanted: frozenset[int] | None, damage: Damage
) -> Records | None:
    """Records of a chunk span, without what is damaged: this is added to `damage`."""
    try:
        records = _load(stream, block, wanted)
    except DamagedError as error:
        damage.parts[block.start] = str(error)
        return None
    if records.damaged:
        damage.parts[block.start] = records.damaged
    return records


def _load(stream: BinaryIO, block: ChunkSpan, wanted: frozenset[int] | None) -> Records:
    """Records of a chunk span; wanted: channels, None for all. Raises DamagedError."""
    stream.seek(block.start)
    if not block.is_chunk:
        return plain_records(Section(stream, block.end - block.start), wanted=wanted)
    length = block.end - block.start - HEAD.size
    if length > LOGS.chunk_bytes:
        raise DamagedError(f'chunk of {length} bytes: expected at most {LOGS.chunk_bytes}')
    head = stream.read(HEAD.size)
    if block.whole and head != HEAD.pack(Opcode.CHUNK, length):
        raise DamagedError(f'no chunk of {length} bytes')
    return chunk_records(Section(stream, length), block.whole, wanted)


def summary_of(path: Path) -> Summary:
    """Summary at the end of a file; empty if it is truncated or the summary is unreadable."""
    size = path.stat().st_size
    with open_regular_file(path) as stream:
        footer_at = size - len(MAGIC) - HEAD.size - _FOOTER.size
        stream.seek(max(footer_at, 0))
        footer = stream.read()
        if footer_at < 0 or footer[: HEAD.size] != HEAD.pack(Opcode.FOOTER, _FOOTER.size):
            return Summary([], [])
        start, _, checksum = _FOOTER.unpack_from(footer, HEAD.size)
        if not len(MAGIC) <= start <= footer_at or footer_at - start > LOGS.summary_bytes:
            return Summary([], [])
        stream.seek(start)
        content = stream.read(size - start)
    # The checksum covers the footer up to the checksum field.
    if checksum and zlib.crc32(content[: -len(MAGIC) - 4]) != checksum:
        return Summary([], [])
    try:
        return _parsed_summary(content, start)
    except (DamagedError, McapError, struct.error, ValueError):
        return Summary([], [])


def _parsed_summary(content: bytes, data_end: int) -> Summary:
    """The summary in the bytes from its begin to the end of the file."""
    summary = Summary([], [])
    reader = StreamReader(BytesIO(content), skip_magic=True, record_size_limit=len(content))
    for record in reader.records:
        if isinstance(record, Schema | Channel):
            summary.definitions.append(record)
        elif isinstance(record, ChunkIndex):
            summary.blocks.append(_indexed(record, data_end))
        elif isinstance(record, Statistics):
            summary.message_counts.update(record.channel_message_counts)
    return summary


def _indexed(index: ChunkIndex, data_end: int) -> ChunkSpan:
    end = index.chunk_start_offset + index.chunk_length
    if not len(MAGIC) <= index.chunk_start_offset <= end - HEAD.size <= data_end - HEAD.size:
        raise DamagedError(f'chunk at byte {index.chunk_start_offset}')
    # Writers may omit the channels of a chunk.
    channel_ids = frozenset(index.message_index_offsets) or None
    first_ns = index.message_start_time
    return ChunkSpan(
        index.chunk_start_offset, end, True, first_ns=first_ns, channel_ids=channel_ids
    )
