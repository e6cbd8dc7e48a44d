"""Records of MCAP files, within limits: declared sizes are checked before memory is allocated.

Source: https://mcap.dev/spec.
"""

import struct
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from numpy.typing import NDArray

from thinmap_ros.core.stamps import LATEST_NS
from thinmap_ros.files.limits import LOGS, PIECE_BYTES

MAGIC = b'\x89MCAP0\r\n'
FIRST_PRIVATE_OPCODE = 0x80

HEAD = struct.Struct('<BQ')
_CHUNK = struct.Struct('<QQQI')
_MESSAGE = struct.Struct('<HIQQ')
_IN_CHUNK = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_SLICE = 2**16

Definition = Schema | Channel


class DamagedError(Exception):
    """Damaged bytes: what was found, and what was expected."""


@dataclass(frozen=True, eq=False)
class Records:
    """The records of a chunk, or of a range of the file without chunks.

    definitions: schemas and channels; log_ns (N,), channel_ids (N,), offsets (N,): the messages in
    file order, with offsets into `data`; damaged: why records were omitted, else empty.
    """

    data: bytes
    definitions: list[Definition]
    log_ns: NDArray[np.uint64]
    channel_ids: NDArray[np.uint16]
    offsets: NDArray[np.uint64]
    damaged: str = ''

    @property
    def first_ns(self) -> int:
        """Log time of the earliest message; 0 if there are none."""
        return int(self.log_ns.min()) if self.log_ns.size else 0

    def message(self, index: int) -> Message:
        """Message by its index in `offsets`."""
        at = int(self.offsets[index])
        (_, length) = HEAD.unpack_from(self.data, at - HEAD.size)
        channel_id, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(self.data, at)
        content = self.data[at + _MESSAGE.size : at + length]
        return Message(channel_id, log_ns, content, publish_ns, sequence)

    def messages(self) -> Iterator[Message]:
        """All messages in the order of the file."""
        return (self.message(index) for index in range(self.offsets.size))


def chunk_records(content: bytes, whole: bool) -> Records:
    """Records in the content of a chunk; if it is truncated (not `whole`), those before the end.

    Raises DamagedError if it is corrupt or larger than LOGS.chunk_bytes.
    """
    try:
        _, _, size, checksum = _CHUNK.unpack_from(content)
        (n,) = struct.unpack_from('<I', content, _CHUNK.size)
        compression = content[_CHUNK.size + 4 : _CHUNK.size + 4 + n].decode('ascii')
        (length,) = struct.unpack_from('<Q', content, _CHUNK.size + 4 + n)
    except (struct.error, ValueError) as error:
        raise DamagedError(f'no chunk header: {_short(error)}') from error
    packed = content[_CHUNK.size + 12 + n : _CHUNK.size + 12 + n + length]
    if whole and len(packed) < length:
        raise DamagedError(f'{len(packed)} bytes compressed: expected {length}')
    # The length of the record itself may be damaged.
    complete = len(packed) == length
    data = decompress(compression, packed, size, complete)
    if complete and len(data) != size:
        raise DamagedError(f'{len(data)} bytes uncompressed: expected {size}')
    if complete and checksum and zlib.crc32(data) != checksum:
        raise DamagedError('wrong checksum')
    return records_of(data, complete)


def decompress(compression: str, data: bytes, size: int, whole: bool = True) -> bytes:
    """Uncompressed bytes; of truncated data (not `whole`), those before the end.

    size: declared bytes; no more is ever decompressed. Raises DamagedError if it exceeds
    LOGS.chunk_bytes, or the data expand to more than declared.
    """
    if size > LOGS.chunk_bytes:
        raise DamagedError(f'{size} bytes uncompressed: expected at most {LOGS.chunk_bytes}')
    if compression == '':
        return data
    if compression not in ('lz4', 'zstd'):
        raise DamagedError(f'compression {compression[:20]!r}: expected none, lz4 or zstd')
    pieces = _lz4_pieces(data) if compression == 'lz4' else _zstd_pieces(data)
    result = bytearray()
    try:
        for piece in pieces:
            result += piece
            if len(result) > size:
                raise DamagedError(f'more than the declared {size} bytes uncompressed')
    except (RuntimeError, zstandard.ZstdError) as error:
        if whole:
            raise DamagedError(f'{compression}: {_short(error)}') from error
    return bytes(result)


def _zstd_pieces(data: bytes) -> Iterator[bytes]:
    reader = zstandard.ZstdDecompressor().stream_reader(BytesIO(data), read_across_frames=True)
    while piece := reader.read(PIECE_BYTES):
        yield piece


def _lz4_pieces(data: bytes) -> Iterator[bytes]:
    unpacker: Any = lz4.frame.LZ4FrameDecompressor()
    for at in range(0, len(data), _SLICE):
        piece = unpacker.decompress(data[at : at + _SLICE], max_length=PIECE_BYTES)
        yield piece
        while not unpacker.needs_input and not unpacker.eof:
            yield unpacker.decompress(b'', max_length=PIECE_BYTES)
        if unpacker.eof:
            return


def records_of(data: bytes, whole: bool = True) -> Records:
    """Consecutive records in `data`, up to its end or to bytes that are no record.

    The message before such bytes is omitted, too: most likely its length is wrong. In truncated
    data (not `whole`) an incomplete last record is expected. Raises DamagedError if there are too
    many definitions.
    """
    found = _Found([], array('Q'), array('H'), array('Q'))
    at = 0
    is_record = True
    while at + HEAD.size <= len(data):
        code, length = HEAD.unpack_from(data, at)
        start = at + HEAD.size
        is_record = code in _IN_CHUNK or code >= FIRST_PRIVATE_OPCODE
        if not is_record or start + length > len(data):
            break
        found.add(code, data, start, length)
        at = start + length
    if at < len(data) and (whole or not is_record):
        found.drop_last(f'no record at byte {at} of {len(data)}')
    return Records(
        data,
        found.definitions,
        np.frombuffer(found.log_ns, dtype=np.uint64),
        np.frombuffer(found.channel_ids, dtype=np.uint16),
        np.frombuffer(found.offsets, dtype=np.uint64),
        found.damaged,
    )


@dataclass
class _Found:
    """Collects the records of some bytes, in 18 bytes per message."""

    definitions: list[Definition]
    log_ns: 'array[int]'
    channel_ids: 'array[int]'
    offsets: 'array[int]'
    damaged: str = ''

    def add(self, code: int, data: bytes, start: int, length: int) -> None:
        """Add a record by the position of its content, or store why it is invalid."""
        try:
            if code == Opcode.MESSAGE:
                self._add_message(data, start, length)
            elif code in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.definitions.append(definition(code, data[start : start + length]))
        except DamagedError as error:
            self.damaged = self.damaged or str(error)
        if len(self.definitions) > LOGS.definitions:
            raise DamagedError(f'more than {LOGS.definitions} schemas and channels')

    def drop_last(self, reason: str) -> None:
        """Omit the last message."""
        self.damaged = self.damaged or reason
        for values in (self.log_ns, self.channel_ids, self.offsets):
            del values[-1:]

    def _add_message(self, data: bytes, start: int, length: int) -> None:
        if length < _MESSAGE.size:
            raise DamagedError(f'message of {length} bytes: expected at least {_MESSAGE.size}')
        channel_id, _, log_ns, _ = _MESSAGE.unpack_from(data, start)
        if log_ns >= LATEST_NS:
            raise DamagedError(f'message logged at {log_ns} ns: expected less than {LATEST_NS}')
        self.log_ns.append(log_ns)
        self.channel_ids.append(channel_id)
        self.offsets.append(start)


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
