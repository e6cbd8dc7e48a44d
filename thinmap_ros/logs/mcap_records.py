"""Records of MCAP files, within limits: declared sizes are checked before memory is allocated.

Source: https://mcap.dev/spec.
"""

import struct
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import Any, BinaryIO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from numpy.typing import NDArray

from thinmap_ros.core.se2 import LATEST_NS
from thinmap_ros.files.safe import LOGS, PIECE_BYTES

MAGIC = b'\x89MCAP0\r\n'
FIRST_PRIVATE_OPCODE = 0x80

HEAD = struct.Struct('<BQ')
_CHUNK = struct.Struct('<QQQI')
_LENGTH = struct.Struct('<I')
_MESSAGE = struct.Struct('<HIQQ')
_IN_CHUNK = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_SLICE = 2**16
_LONGEST_NAME = 1000  # of a compression

Definition = Schema | Channel


class DamagedError(Exception):
    """Damaged bytes: what was found, and what was expected."""


@dataclass(frozen=True, eq=False)
class Records:
    """The records of a chunk, or of a range of the file without chunks.

    definitions: schemas and channels; log_ns (N,), channel_ids (N,), offsets (N,): the messages of
    the wanted channels in file order, with offsets into `data`, which holds only these; count,
    first_ns, all_channel_ids: number, earliest log time (0 if there are none) and channels of all
    messages; damaged: why records were omitted, else empty.
    """

    data: bytes | bytearray
    definitions: list[Definition]
    log_ns: NDArray[np.uint64]
    channel_ids: NDArray[np.uint16]
    offsets: NDArray[np.uint64]
    count: int
    first_ns: int
    all_channel_ids: frozenset[int]
    damaged: str = ''

    def message(self, index: int) -> Message:
        """Message by its index in `offsets`."""
        at = int(self.offsets[index])
        (_, length) = HEAD.unpack_from(self.data, at - HEAD.size)
        channel_id, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(self.data, at)
        content = bytes(self.data[at + _MESSAGE.size : at + length])
        return Message(channel_id, log_ns, content, publish_ns, sequence)

    def messages(self) -> Iterator[Message]:
        """All messages in the order of the file."""
        return (self.message(index) for index in range(self.offsets.size))


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
    found = _Found(wanted)
    checked = 0
    for piece in _pieces(compression, content, size, complete):
        checked = zlib.crc32(piece, checked)
        found.feed(piece)
    if complete and found.size != size:
        raise DamagedError(f'{found.size} bytes uncompressed: expected {size}')
    if complete and checksum and checked != checksum:
        raise DamagedError('wrong checksum')
    return found.records(complete)


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


def plain_records(
    content: Section, whole: bool = True, wanted: frozenset[int] | None = None
) -> Records:
    """Consecutive records outside of chunks, up to the end or to bytes that are no record.

    The message before such bytes is omitted, too: most likely its length is wrong. In truncated
    data (not `whole`) an incomplete last record is expected. wanted: as in `chunk_records`. Raises
    DamagedError if there are too many definitions.
    """
    found = _Found(wanted)
    for piece in _plain_pieces(content):
        found.feed(piece)
    return found.records(whole)


class _Found:
    """Collects the records of a stream of bytes, in 18 bytes per message that is wanted."""

    def __init__(self, wanted: frozenset[int] | None) -> None:
        self.size = 0  # bytes so far
        self._wanted = wanted
        self._definitions: list[Definition] = []
        self._messages = _Messages()
        self._buffer = bytearray()  # of the record that is not complete yet
        self._skipped = 0  # remaining bytes of a record that is not kept
        self._skipped_message: tuple[int, int] | None = None  # its channel and log time
        self._end_at: int | None = None  # of the records, where bytes follow that are none
        self._damaged = ''

    def feed(self, piece: bytes) -> None:
        """Add bytes. Raises DamagedError if there are too many definitions."""
        self.size += len(piece)
        if self._end_at is not None:
            return
        jump = min(self._skipped, len(piece))
        self._skipped -= jump
        if self._skipped == 0 and self._skipped_message is not None:
            self._messages.count(*self._skipped_message)
            self._skipped_message = None
        self._buffer += memoryview(piece)[jump:]
        del self._buffer[: self._parse()]

    def records(self, whole: bool) -> Records:
        """The records so far; whole: the bytes are complete."""
        at = self.size - len(self._buffer) if self._end_at is None else self._end_at
        is_record = self._end_at is None
        is_cut = self._skipped > 0 or at < self.size
        if is_cut and (whole or not is_record):
            self._damaged = self._damaged or f'no record at byte {at} of {self.size}'
            self._messages.drop_last()
        return self._messages.as_records(self._definitions, self._damaged)

    def _parse(self) -> int:
        """Add the complete records of the buffer; returns how many of its bytes they take."""
        data = self._buffer
        at = 0
        while at + HEAD.size <= len(data):
            code, length = HEAD.unpack_from(data, at)
            if code not in _IN_CHUNK and code < FIRST_PRIVATE_OPCODE:
                self._end_at = self.size - len(data) + at
                break
            start = at + HEAD.size
            if start + length > len(data):
                return self._skip(code, start, length) or at
            self._add(code, start, length)
            at = start + length
        return at

    def _skip(self, code: int, start: int, length: int) -> int:
        """Skip an incomplete record that is not kept; returns the bytes up to the end, or 0."""
        available = len(self._buffer) - start
        if code == Opcode.MESSAGE and min(length, available) >= _MESSAGE.size:
            channel_id, _, log_ns, _ = _MESSAGE.unpack_from(self._buffer, start)
            if self._is_wanted(channel_id) or log_ns >= LATEST_NS:
                return 0
            self._skipped_message = (channel_id, log_ns)
        elif code < FIRST_PRIVATE_OPCODE:
            return 0
        self._skipped = length - available
        return len(self._buffer)

    def _is_wanted(self, channel_id: int) -> bool:
        return self._wanted is None or channel_id in self._wanted

    def _add(self, code: int, start: int, length: int) -> None:
        """Add a record by the position of its content, or store why it is invalid."""
        data = self._buffer
        try:
            if code == Opcode.MESSAGE:
                self._add_message(start, length)
            elif code in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._definitions.append(definition(code, bytes(data[start : start + length])))
        except DamagedError as error:
            self._damaged = self._damaged or str(error)
        if len(self._definitions) > LOGS.definitions:
            raise DamagedError(f'more than {LOGS.definitions} schemas and channels')

    def _add_message(self, start: int, length: int) -> None:
        if length < _MESSAGE.size:
            raise DamagedError(f'message of {length} bytes: expected at least {_MESSAGE.size}')
        channel_id, _, log_ns, _ = _MESSAGE.unpack_from(self._buffer, start)
        if log_ns >= LATEST_NS:
            raise DamagedError(f'message logged at {log_ns} ns: expected less than {LATEST_NS}')
        self._messages.count(channel_id, log_ns)
        if self._is_wanted(channel_id):
            record = memoryview(self._buffer)[start - HEAD.size : start + length]
            self._messages.keep(channel_id, log_ns, record)
            record.release()  # the buffer can be shortened again


class _Messages:
    """Messages: the number of all, and the content of those that are kept."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._log_ns = array('Q')
        self._channel_ids = array('H')
        self._offsets = array('Q')
        self._count = 0
        self._first_ns = LATEST_NS
        self._all_channel_ids: set[int] = set()
        self._is_last_kept = False

    def count(self, channel_id: int, log_ns: int) -> None:
        """Count a message."""
        self._count += 1
        self._first_ns = min(self._first_ns, log_ns)
        self._all_channel_ids.add(channel_id)
        self._is_last_kept = False

    def keep(self, channel_id: int, log_ns: int, record: memoryview) -> None:
        """Keep the whole record of the message that was counted last."""
        self._log_ns.append(log_ns)
        self._channel_ids.append(channel_id)
        self._offsets.append(len(self._data) + HEAD.size)
        self._data += record
        self._is_last_kept = True

    def drop_last(self) -> None:
        """Omit the last message, once."""
        self._count = max(self._count - 1, 0)
        if self._is_last_kept:
            for values in (self._log_ns, self._channel_ids, self._offsets):
                del values[-1:]
        self._is_last_kept = False

    def as_records(self, definitions: list[Definition], damaged: str) -> Records:
        """The messages, with the definitions that were found among them."""
        return Records(
            self._data,
            definitions,
            np.frombuffer(self._log_ns, dtype=np.uint64),
            np.frombuffer(self._channel_ids, dtype=np.uint16),
            np.frombuffer(self._offsets, dtype=np.uint64),
            self._count,
            self._first_ns if self._count else 0,
            frozenset(self._all_channel_ids),
            damaged,
        )


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
