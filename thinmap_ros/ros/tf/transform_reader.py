"""Serialized messages of /tf and /tf_static, of which only what is needed is decoded.

Decoding all transforms of two thousand frames at 20 Hz takes more than half of a processor, in each
node.
"""

import struct
from collections.abc import Callable, Iterator
from time import monotonic

from geometry_msgs.msg import TransformStamped
from rclpy.serialization import deserialize_message
from tf2_msgs.msg import TFMessage

from thinmap_ros.core.errors import InputError

_MANY = 200  # frames; robots with arms and heads have fewer
_MAX_FRAMES = 10_000
_PERIOD_S = 1.0
# Layout of CDR, little endian, offsets from the end of its header of four bytes.
_LITTLE_ENDIAN = b'\x00\x01'
_HEADER = 4
_COUNT = struct.Struct('<I')
_STAMP_AND_SIZE = struct.Struct('<iII')
_NUMBERS = struct.Struct('<7d')


class TransformReader:
    """Reads the transforms of serialized tf2_msgs/TFMessage.

    Of more than 200 frames, those that are not used are read once a second. Frames beyond the first
    10,000 are not read.
    """

    def __init__(
        self, is_used: Callable[[str], bool], now_s: Callable[[], float] = monotonic
    ) -> None:
        """is_used: whether each transform to a child frame is needed."""
        self._is_used = is_used
        self._now_s = now_s
        self._read_s: dict[str, float] = {}

    def read(self, data: bytes) -> Iterator[TransformStamped]:
        """Transforms of a message that are due. Raises InputError if the message is invalid."""
        if data[:2] != _LITTLE_ENDIAN:
            yield from deserialize_message(data, TFMessage).transforms
            return
        try:
            yield from self._read(data)
        except (struct.error, UnicodeDecodeError) as error:
            raise InputError(f'message that is no tf2_msgs/TFMessage: {error}') from error

    def _read(self, data: bytes) -> Iterator[TransformStamped]:
        now_s = self._now_s()
        (count,) = _COUNT.unpack_from(data, _HEADER)
        at = _HEADER + _COUNT.size
        for _ in range(count):
            start = at
            *_, size = _STAMP_AND_SIZE.unpack_from(data, at)
            parent = at + _STAMP_AND_SIZE.size
            at = -(-(parent + size) // 4) * 4
            (child_size,) = _COUNT.unpack_from(data, at)
            child = at + _COUNT.size
            at = -(-(child + child_size - _HEADER) // 8) * 8 + _HEADER
            frame = data[child : child + child_size - 1].decode()
            if self._is_due(frame, now_s):
                numbers = _NUMBERS.unpack_from(data, at)
                stamp = _STAMP_AND_SIZE.unpack_from(data, start)[:2]
                yield _transform(stamp, data[parent : parent + size - 1].decode(), frame, numbers)
            at += _NUMBERS.size

    def _is_due(self, frame: str, now_s: float) -> bool:
        count = len(self._read_s)
        last_s = self._read_s.get(frame)
        if last_s is None and count >= _MAX_FRAMES:
            return False
        is_new = last_s is None or now_s - last_s >= _PERIOD_S
        if not (is_new or count <= _MANY or self._is_used(frame)):
            return False
        self._read_s[frame] = now_s
        return True


def _transform(
    stamp: tuple[int, int], parent: str, child: str, numbers: tuple[float, ...]
) -> TransformStamped:
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    moved = message.transform.translation
    turned = message.transform.rotation
    moved.x, moved.y, moved.z = numbers[:3]
    turned.x, turned.y, turned.z, turned.w = numbers[3:]
    return message
