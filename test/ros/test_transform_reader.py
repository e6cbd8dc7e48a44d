"""Serialized transforms: those that are decoded are those of the middleware; a flood is thinned."""

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from tf2_msgs.msg import TFMessage

from thinmap_ros.core.errors import InputError
from thinmap_ros.logs.transforms import TransformBuffer
from thinmap_ros.ros import messages
from thinmap_ros.ros.tf import TransformReader

FLOOD = 2000  # frames
names = st.text(st.characters(exclude_characters='\0', codec='utf-8'), max_size=12)
numbers = st.floats(width=64)


@st.composite
def transforms(draw):
    made = TransformStamped(child_frame_id=draw(names))
    made.header.frame_id = draw(names)
    made.header.stamp.sec = draw(st.integers(-(2**31), 2**31 - 1))
    made.header.stamp.nanosec = draw(st.integers(0, 2**32 - 1))
    made.transform.translation.y = draw(numbers)
    made.transform.rotation.x = draw(numbers)
    made.transform.rotation.w = draw(numbers)
    return made


def flood(stamp_s, count=FLOOD):
    """A message with many frames, the last of them that of the odometry."""
    frames = [f'frame_{k}' for k in range(count - 1)] + ['odom']
    stamp_ns = round(1e9 * stamp_s)
    return serialize_message(
        TFMessage(
            transforms=[
                messages.transform_msg(np.array([stamp_s, 0.0, 0.0]), 'map', frame, stamp_ns)
                for frame in frames
            ]
        )
    )


@given(st.lists(transforms(), max_size=5))
def test_the_transforms_are_those_that_the_middleware_decodes(sent):
    data = serialize_message(TFMessage(transforms=sent))
    read = TFMessage(transforms=list(TransformReader(lambda frame: False).read(data)))
    # Serialized, because not a number is not equal to itself.
    assert serialize_message(read) == serialize_message(deserialize_message(data, TFMessage))


def test_big_endian_messages_are_decoded_by_the_middleware():
    data = bytes([0, 0, 0, 0, 0, 0, 0, 0])
    assert list(TransformReader(lambda frame: False).read(data)) == []


@pytest.mark.parametrize('size', [6, 30, 100])
def test_a_message_that_is_cut_off_is_an_error(size):
    with pytest.raises(InputError, match='no tf2_msgs/TFMessage'):
        list(TransformReader(lambda frame: False).read(flood(1.0, 2)[:size]))


def test_in_a_flood_unused_frames_are_read_once_a_second_and_used_ones_always():
    buffer = TransformBuffer()
    now_s = [0.0]
    reader = TransformReader(buffer.is_used, lambda: now_s[0])
    counts = []
    for step in range(1, 41):
        now_s[0] = step / 20.0
        before = len(counts)
        for transform in reader.read(flood(now_s[0])):
            counts.append(transform.child_frame_id)
            buffer.add(transform, is_static=False)
        buffer.lookup('map', 'odom')
        assert 'odom' in counts[before:] and buffer.lookup('map', 'odom')[0] == now_s[0]
    assert len(counts) == 2 * (FLOOD - 1) + 40


def test_few_frames_are_read_at_each_message():
    reader = TransformReader(lambda frame: False, lambda: 0.0)
    assert [len(list(reader.read(flood(k, 50)))) for k in range(3)] == [50, 50, 50]


def test_frames_beyond_ten_thousand_are_not_read():
    reader = TransformReader(lambda frame: True, lambda: 0.0)
    assert len(list(reader.read(flood(1.0, 10_100)))) == 10_000
