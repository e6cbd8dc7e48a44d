"""Reads MCAP files, also truncated or damaged ones: intact messages in log order or file order.

The `mcap` package has no recovery (`mcap recover` is a program written in Go), and neither it nor
rosbags limits the decompressed size of a chunk. Of `mcap` the record types are used, and the reader
for the summary alone. Declared sizes are checked before memory is allocated.

Source: https://mcap.dev/spec.
"""

import heapq
import struct
import zlib
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BufferedReader, BytesIO, RawIOBase
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Message, Schema, Statistics
from mcap.stream_reader import StreamReader

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import LATEST_NS
from thinmap_ros.files.safe import LOGS, PIECE_BYTES, open_regular_file

MAGIC = b'\x89MCAP0\r\n'
FIRST_PRIVATE_OPCODE = 0x80
HEAD = struct.Struct('<BQ')
_CHUNK = struct.Struct('<QQQI')
_FOOTER = struct.Struct('<QQI')
_MESSAGE = struct.Struct('<HIQQ')
_FOOTER_HEAD = HEAD.pack(Opcode.FOOTER, _FOOTER.size)
_DATA_END_HEAD = HEAD.pack(Opcode.DATA_END, 4)
_PLAIN = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_LONGEST_NAME = 1000  # of a compression
Definition = Schema | Channel


class DamagedError(Exception):
    """Damaged bytes: what was found, and what was expected."""


@dataclass(eq=False)
class Records:
    """The records of a chunk, or of a range of the file without chunks.

    definitions: schemas and channels; contents: of the messages of the wanted channels, in file
    order; first_ns, channel_ids: earliest log time and channels of all messages; damaged: why
    records were omitted, else empty.
    """

    definitions: list[Definition] = field(default_factory=list)
    contents: list[bytes] = field(default_factory=list)
    first_ns: int = LATEST_NS
    channel_ids: set[int] = field(default_factory=set)
    damaged: str = ''

    def omit(self, reason: str) -> None:
        """Something is damaged; the first reason counts."""
        self.damaged = self.damaged or reason


@dataclass(eq=False)
class Section:
    """The next bytes of a stream, at most `left`."""

    _stream: BinaryIO
    left: int

    def read(self, size: int) -> bytes:
        """Read up to `size` bytes; none at the end of the section or of the stream."""
        piece = self._stream.read(max(min(size, self.left), 0))
        self.left -= len(piece)
        return piece

    read1 = read


_UNPACK: dict[str, Callable[[Any], Any]] = {
    '': lambda packed: packed,
    'lz4': lz4.frame.open,
    'zstd': lambda packed: zstandard.ZstdDecompressor().stream_reader(
        packed, read_across_frames=True
    ),
}


class _Unpacked(RawIOBase):
    """Uncompressed bytes of a section as a stream; counts what it has read, with its checksum.

    It raises DamagedError where they are more than declared, or corrupt; in truncated data (not
    `whole`), corrupt bytes are the end.
    """

    def __init__(self, compression: str, packed: Section, declared: int, whole: bool) -> None:
        """Raises DamagedError for an unknown compression, or if more is declared than allowed."""
        if declared > LOGS.chunk_bytes:
            raise DamagedError(
                f'{declared} bytes uncompressed: expected at most {LOGS.chunk_bytes}'
            )
        if compression not in _UNPACK:
            raise DamagedError(f'compression {compression[:20]!r}: expected none, lz4 or zstd')
        self.size = 0
        self.checksum = 0
        self._compression = compression
        self._source = _UNPACK[compression](packed)
        self._declared = declared
        self._whole = whole

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        try:
            piece = self._source.read1(min(len(buffer), PIECE_BYTES))
        except (EOFError, RuntimeError, zstandard.ZstdError) as error:
            # lz4 raises EOFError where the data are truncated: their size tells.
            if self._whole and not isinstance(error, EOFError):
                raise DamagedError(f'{self._compression}: {_short(error)}') from error
            return 0
        self.size += len(piece)
        if self.size > self._declared:
            raise DamagedError(f'more than the declared {self._declared} bytes uncompressed')
        self.checksum = zlib.crc32(piece, self.checksum)
        buffer[: len(piece)] = piece
        return len(piece)


def decompress(compression: str, data: bytes, size: int, whole: bool = True) -> bytes:
    """Uncompressed bytes; of truncated data (not `whole`), those before the end.

    size: declared bytes; no more is ever decompressed. Raises DamagedError if it exceeds
    LOGS.chunk_bytes, or the data expand to more than declared.
    """
    return _Unpacked(compression, Section(BytesIO(data), len(data)), size, whole).readall()


def chunk_records(content: Section, whole: bool, wanted: frozenset[int] | None = None) -> Records:
    """Records of a chunk; if it is truncated (not `whole`), those before the end.

    wanted: the channels whose messages are kept, None for all. Only these take memory: the chunk is
    unpacked in pieces. Raises DamagedError if it is corrupt or larger than LOGS.chunk_bytes.
    """
    record_bytes = content.left - HEAD.size
    if content.read(HEAD.size) != HEAD.pack(Opcode.CHUNK, record_bytes) and whole:
        raise DamagedError(f'no chunk of {record_bytes} bytes')
    try:
        _, _, size, checksum = _CHUNK.unpack(content.read(_CHUNK.size))
        (n,) = struct.unpack('<I', content.read(4))
        compression = content.read(min(n, _LONGEST_NAME)).decode('ascii')
        (length,) = struct.unpack('<Q', content.read(8))
    except (struct.error, ValueError) as error:
        raise DamagedError(f'no chunk header: {_short(error)}') from error
    if whole and content.left < length:
        raise DamagedError(f'{content.left} bytes compressed: expected {length}')
    # The length of the record itself may be damaged.
    complete = content.left >= length
    content.left = min(content.left, length)
    stream = _Unpacked(compression, content, size, complete)
    records = _records(stream, size, complete, wanted)
    if complete and stream.size != size:
        raise DamagedError(f'{stream.size} bytes uncompressed: expected {size}')
    if complete and checksum and stream.checksum != checksum:
        raise DamagedError('wrong checksum')
    return records


def plain_records(content: Section, wanted: frozenset[int] | None = None) -> Records:
    """Consecutive records outside of chunks, up to the end or to bytes that are no record.

    The message before such bytes is omitted, too: most likely its length is wrong. wanted: as in
    `chunk_records`. Raises DamagedError if there are too many definitions.
    """
    return _records(_Unpacked('', content, content.left, True), content.left, True, wanted)


def _records(unpacked: _Unpacked, size: int, whole: bool, wanted: frozenset[int] | None) -> Records:
    """Records of a stream of `size` bytes; in truncated data the last one may be incomplete."""
    stream = BufferedReader(unpacked)
    found = Records()
    at = 0
    message: bytes | None = None
    is_damaged = False
    while head := stream.read(HEAD.size):
        code, length = HEAD.unpack(head) if len(head) == HEAD.size else (Opcode.MESSAGE, size)
        is_record = code in _PLAIN or code >= FIRST_PRIVATE_OPCODE
        end = at + HEAD.size + length
        content = _content(stream, code, length, wanted) if is_record and end <= size else None
        if content is None:
            _skip(stream, size)
            is_damaged = whole or not is_record
            break
        _add_message(found, message, wanted)
        message = content if code == Opcode.MESSAGE else None
        if code in (Opcode.SCHEMA, Opcode.CHANNEL):
            _add_definition(found, code, content)
        at = end
    # Only what follows a message shows that its length is right.
    _add_message(found, message, wanted, is_kept=not is_damaged)
    if is_damaged:
        found.omit(f'no record at byte {at} of {unpacked.size}')
    return found


def _content(
    stream: BinaryIO, code: int, length: int, wanted: frozenset[int] | None
) -> bytes | None:
    """Content of a record that is read, and the fields of any other message; None: incomplete."""
    is_message = code == Opcode.MESSAGE
    needed = 0 if code >= FIRST_PRIVATE_OPCODE else length
    content = stream.read(min(needed, _MESSAGE.size) if is_message else needed)
    if is_message and (wanted is None or _channel_id(content) in wanted):
        content += stream.read(length - len(content))
    return content if _skip(stream, length - len(content)) else None


def _skip(stream: BinaryIO, size: int) -> bool:
    """Skip bytes, in pieces; returns whether there were as many."""
    while size > 0 and (piece := stream.read(min(size, PIECE_BYTES))):
        size -= len(piece)
    return size == 0


def _add_message(
    found: Records, content: bytes | None, wanted: frozenset[int] | None, is_kept: bool = True
) -> None:
    """Add a message, if there is one, or why it is invalid."""
    if content is None:
        return
    log_ns = _log_ns(content)
    channel_id = _channel_id(content)
    if len(content) < _MESSAGE.size:
        found.omit(f'message of {len(content)} bytes: expected at least {_MESSAGE.size}')
    elif log_ns >= LATEST_NS:
        found.omit(f'message logged at {log_ns} ns: expected less than {LATEST_NS}')
    elif is_kept:
        found.first_ns = min(found.first_ns, log_ns)
        found.channel_ids.add(channel_id)
        if wanted is None or channel_id in wanted:
            found.contents.append(content)


def _channel_id(content: bytes) -> int:
    return int.from_bytes(content[:2], 'little')


def _log_ns(content: bytes) -> int:
    return int.from_bytes(content[6:14], 'little')


def _message(content: bytes) -> Message:
    channel_id, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(content)
    return Message(channel_id, log_ns, content[_MESSAGE.size :], publish_ns, sequence)


def _add_definition(found: Records, code: int, content: bytes) -> None:
    """Add a schema or channel, or why it is invalid. Raises DamagedError if there are too many."""
    stream = ReadDataStream(BytesIO(content))
    builder = RecordBuilder()
    try:
        record: Definition = Schema.read(stream) if code == Opcode.SCHEMA else Channel.read(stream)
        record.write(builder)
        # mcap accepts strings whose declared length exceeds the data.
        if not content.startswith(builder.end()[HEAD.size :]):
            raise ValueError(f'lengths that do not fit its {len(content)} bytes')
        found.definitions.append(record)
    except (McapError, struct.error, ValueError) as error:
        found.omit(f'{Opcode(code).name.lower()}: {_short(error)}')
    if len(found.definitions) > LOGS.definitions:
        raise DamagedError(f'more than {LOGS.definitions} schemas and channels')


def _short(error: Exception) -> str:
    return ' '.join(str(error).split())[:80] or type(error).__name__


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
            at, reason = min(self.parts.items())
            several = f'{len(self.parts)} damaged parts, the first'
            count = several if len(self.parts) > 1 else 'a damaged part'
            words.append(f'{count} at byte {at}: {reason}')
        return '; '.join(words)


@dataclass
class Definitions:
    """Schemas and channels by id; the later one of equal ids counts."""

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    _bytes: int = 0

    def add(self, record: Definition, is_earlier: bool = False) -> None:
        """Add a schema or channel; an earlier one counts only if none of its id is known.

        Raises InputError if their total size is too large.
        """
        known: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
        if record == known.get(record.id) or (is_earlier and record.id in known):
            return
        known[record.id] = record
        builder = RecordBuilder()
        record.write(builder)
        self._bytes += builder.count
        if self._bytes > LOGS.definitions_bytes:
            expected = f'expected at most {LOGS.definitions_bytes} bytes'
            raise InputError(f'{self.path}: schemas and channels: {expected}')

    def of(self, channel_id: int) -> tuple[Schema, Channel] | None:
        """Channel and its schema; None if one of them is unknown."""
        channel = self.channels.get(channel_id)
        schema = None if channel is None else self.schemas.get(channel.schema_id)
        return None if channel is None or schema is None else (schema, channel)


@dataclass
class ChunkSpan:
    """A chunk, or a range of records outside of chunks: bytes `start` to `end` of the file.

    whole: it is not truncated; first_ns: log time of its earliest message; channel_ids: channels of
    its messages, empty if unknown.
    """

    start: int
    end: int
    is_chunk: bool
    whole: bool = True
    first_ns: int = 0
    channel_ids: set[int] = field(default_factory=set)


_END = ChunkSpan(0, 0, False, first_ns=LATEST_NS)  # it has no messages


@dataclass(frozen=True)
class Summary:
    """Summary section of a file that was closed properly.

    message_counts: by channel; empty if they are not recorded.
    """

    definitions: list[Definition] = field(default_factory=list)
    spans: list[ChunkSpan] = field(default_factory=list)
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
        self._spans = summary.spans if self.definitions.channels else []
        if not self._spans:
            self._spans = list(_first_pass(path, summary, self.definitions, self.damage))
        self.has_messages = bool(self._spans)
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
        for content in self._in_log_order(frozenset(chosen)):
            message = _message(content)
            yield *chosen[message.channel_id], message

    def _in_log_order(self, channel_ids: frozenset[int]) -> Iterator[bytes]:
        """Contents of messages; beyond `LOGS.buffered_bytes` of them, they are out of order."""
        spans = [s for s in self._spans if not s.channel_ids or s.channel_ids & channel_ids]
        spans.sort(key=lambda span: span.first_ns)
        # The remaining messages of each chunk, by the log time of the first, and its number.
        heap: list[tuple[int, int, deque[bytes]]] = []
        held = 0
        with open_regular_file(self.path) as stream:
            for number, span in enumerate([*spans, _END]):
                while heap and (heap[0][0] < span.first_ns or held > LOGS.buffered_bytes):
                    _, place, contents = heapq.heappop(heap)
                    held -= len(contents[0])
                    yield contents.popleft()
                    _push(heap, place, contents)
                loaded = _load(stream, span, channel_ids, self.damage).contents
                held += sum(map(len, loaded))
                _push(heap, number, deque(sorted(loaded, key=_log_ns)))


def _push(heap: list[tuple[int, int, deque[bytes]]], number: int, contents: deque[bytes]) -> None:
    if contents:
        heapq.heappush(heap, (_log_ns(contents[0]), number, contents))


def intact_records(path: Path, damage: Damage) -> Iterator[Definition | Message]:
    """Intact schemas, channels and messages in file order; damaged parts are added to `damage`.

    Raises InputError if the file does not begin with the magic bytes of MCAP.
    """
    summary = summary_of(path)
    yield from summary.definitions
    with open_regular_file(path) as stream:
        for span in _chunk_spans(stream, path, summary, damage):
            records = _load(stream, span, None, damage)
            yield from records.definitions
            yield from map(_message, records.contents)


def _first_pass(
    path: Path, summary: Summary, definitions: Definitions, damage: Damage
) -> Iterator[ChunkSpan]:
    """Chunk spans with messages of a file; its definitions and damaged parts are added to these.

    A chunk is unpacked only if its message index names a channel that is not known yet, or if it
    has no message index; or to look for a channel that a later chunk does not define itself.
    """
    packed: list[ChunkSpan] = []
    with open_regular_file(path) as stream:
        for span in _chunk_spans(stream, path, summary, damage):
            if span.channel_ids and span.channel_ids <= definitions.channels.keys():
                packed.append(span)
                yield span
                continue
            records = _load(stream, span, frozenset(), damage)
            for record in records.definitions:
                definitions.add(record)
            # A recorder defines a channel when it subscribes, some time before the first message.
            while packed and any(definitions.of(k) is None for k in records.channel_ids):
                for record in _load(stream, packed.pop(), frozenset(), damage).definitions:
                    definitions.add(record, is_earlier=True)
            if records.channel_ids:
                span.first_ns = records.first_ns
                span.channel_ids = records.channel_ids
                yield span


def _chunk_spans(
    stream: BinaryIO, path: Path, summary: Summary, damage: Damage
) -> Iterator[ChunkSpan]:
    """Chunk spans of a file in its order; damaged parts are added to `damage`.

    The channels of a chunk are those of the message indexes behind it. After a damaged part,
    reading continues at the next chunk of the summary. Data that a recorder has appended since are
    ignored. Raises InputError if the file does not begin with the magic bytes of MCAP.
    """
    if stream.read(len(MAGIC)) != MAGIC:
        raise InputError(f'{path}: no MCAP file: expected it to begin with {MAGIC!r}')
    size = path.stat().st_size
    chunks = sorted(span.start for span in summary.spans)
    at = len(MAGIC)
    span: ChunkSpan | None = None
    while True:
        stream.seek(at)
        head = stream.read(HEAD.size + 8) if at + HEAD.size <= size else bytes(HEAD.size)
        code, length = HEAD.unpack_from(head)
        end = at + HEAD.size + length
        is_record = end <= size and (0 < code <= Opcode.DATA_END or code >= FIRST_PRIVATE_OPCODE)
        is_plain = is_record and code in _PLAIN
        is_index = is_record and code == Opcode.MESSAGE_INDEX
        if span is not None and not _continues(span, end, is_plain, is_index):
            if not is_record:
                span.channel_ids.clear()  # further indexes may have been cut off
            yield span
            span = None
        if head[: HEAD.size] in (_DATA_END_HEAD, _FOOTER_HEAD):
            stream.seek(size - len(MAGIC))
            # Otherwise the messages are intact, the summary is not.
            damage.is_truncated = stream.read() != MAGIC
            return
        if is_record or code == Opcode.CHUNK:
            span = _with_record(span, head, at, min(end, size), is_record)
        if is_record:
            at = end
        elif (following := bisect_right(chunks, at)) < len(chunks):
            damage.parts.setdefault(at, 'no record')
            at = chunks[following]
        else:
            break
    if span is not None:
        yield span
    damage.is_truncated = True


def _continues(span: ChunkSpan, end: int, is_plain: bool, is_index: bool) -> bool:
    """Whether a record up to `end` continues the range of plain records, or indexes the chunk."""
    return is_index if span.is_chunk else is_plain and end - span.start <= PIECE_BYTES


def _with_record(
    span: ChunkSpan | None, head: bytes, at: int, end: int, whole: bool
) -> ChunkSpan | None:
    """The span that a record begins, or that it is added to; None if it belongs to none."""
    code, _ = HEAD.unpack_from(head)
    begin = head[HEAD.size :]
    if code == Opcode.CHUNK:
        return ChunkSpan(at, end, True, whole, int.from_bytes(begin, 'little'))
    if code in _PLAIN:
        return ChunkSpan(at if span is None else span.start, end, False)
    if code == Opcode.MESSAGE_INDEX and span is not None:
        span.channel_ids.add(_channel_id(begin))
    return span


def _load(
    stream: BinaryIO, span: ChunkSpan, wanted: frozenset[int] | None, damage: Damage
) -> Records:
    """Records of a chunk span, without what is damaged: this is added to `damage`.

    wanted: channels, None for all.
    """
    stream.seek(span.start)
    content = Section(stream, span.end - span.start)
    try:
        records = (
            chunk_records(content, span.whole, wanted)
            if span.is_chunk
            else plain_records(content, wanted)
        )
    except DamagedError as error:
        records = Records(damaged=str(error))
    if records.damaged:
        damage.parts[span.start] = records.damaged
    return records


def summary_of(path: Path) -> Summary:
    """Summary at the end of a file; empty if it is truncated or the summary is unreadable."""
    size = path.stat().st_size
    footer_at = size - len(MAGIC) - HEAD.size - _FOOTER.size
    with open_regular_file(path) as stream:
        stream.seek(max(footer_at, 0))
        footer = stream.read(HEAD.size + _FOOTER.size).ljust(HEAD.size + _FOOTER.size)
        start, _, checksum = _FOOTER.unpack_from(footer, HEAD.size)
        is_footer = footer.startswith(_FOOTER_HEAD) and len(MAGIC) <= start <= footer_at
        if not is_footer or footer_at - start > LOGS.summary_bytes:
            return Summary()
        stream.seek(start)
        content = stream.read(size - start)
    try:
        return _parsed_summary(content, start, checksum)
    except (DamagedError, McapError, struct.error, ValueError):
        return Summary()


def _parsed_summary(content: bytes, data_end: int, checksum: int) -> Summary:
    """The summary in the bytes from its begin to the end of the file."""
    # The checksum covers the footer up to the checksum field.
    if checksum and zlib.crc32(content[: -len(MAGIC) - 4]) != checksum:
        raise DamagedError('wrong checksum')
    summary = Summary()
    reader = StreamReader(BytesIO(content), skip_magic=True, record_size_limit=len(content))
    for record in reader.records:
        if isinstance(record, Schema | Channel):
            summary.definitions.append(record)
        elif isinstance(record, ChunkIndex):
            start = record.chunk_start_offset
            end = start + record.chunk_length
            if not len(MAGIC) <= start <= end - HEAD.size <= data_end - HEAD.size:
                raise DamagedError(f'chunk at byte {start}')
            # Writers may omit the channels of a chunk.
            channel_ids = set(record.message_index_offsets)
            first_ns = record.message_start_time
            summary.spans.append(ChunkSpan(start, end, True, True, first_ns, channel_ids))
        elif isinstance(record, Statistics):
            summary.message_counts.update(record.channel_message_counts)
    return summary
