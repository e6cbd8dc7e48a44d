"""Keyframes as bytes: what comes is what was sent, and damage is an error."""

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.slam.joining.messages import KeyframeMessage, SentEdge, checked_poses

T = se2.pose(2.0, 2.5, 0.4)
UPPER = np.triu_indices(3)
INFORMATION = np.array([[4e4, 1e3, 5e4], [1e3, 5e4, -2e4], [5e4, -2e4, 9e5]])


def message(number=3, scan=None, edges=None):
    scan = scan or scan_in(ROOM, T, np.random.default_rng(1))
    edges = [SentEdge(0, 3, INFORMATION)] if edges is None else edges
    return KeyframeMessage(number, 2, T, scan, tuple(edges))


def test_what_comes_is_what_was_sent_to_a_millimetre():
    sent = message()
    data = sent.encode()
    found = KeyframeMessage.decode(data)
    assert (found.number, found.revision) == (3, 2)
    np.testing.assert_allclose(found.T_map_base, T, atol=1e-6)
    np.testing.assert_array_equal(found.scan.returned, sent.scan.returned)
    hit = sent.scan.returned
    off = np.abs(found.scan.ranges_m[hit] - sent.scan.ranges_m[hit])
    assert off.max() <= 0.0005 + 1e-6
    (edge,) = found.edges
    assert (edge.a, edge.b) == (0, 3)
    np.testing.assert_allclose(edge.information, INFORMATION, rtol=1e-6)
    beams = sent.scan.ranges_m.size
    assert len(data) < 2 * beams, 'smaller than its ranges in 16 bit'


def test_the_bytes_have_the_documented_layout():
    scan = Scan.create(5, [1.5, np.inf, np.nan, -np.inf, 2.0], -1.0, 0.5, 0.05, 30.0)
    plain = zlib.decompress(message(scan=scan).encode())
    number, revision, edges, unit_mm, x, y, yaw, *laser = struct.unpack_from('<3IH13f', plain)
    assert (number, revision, edges, unit_mm) == (3, 2, 1, 1)
    assert (x, y, yaw) == pytest.approx(tuple(T))
    expected = [-1.0, 0.5, 0.05, 30.0, *scan.T_base_laser, scan.max_range_m, 0.0, 0.0]
    assert laser == pytest.approx(expected)
    assert struct.unpack_from('<II', plain, 66) == (0, 3)
    assert struct.unpack_from('<6f', plain, 74) == pytest.approx(INFORMATION[UPPER].tolist())
    at = 0
    ranges = []
    for u in (a + 256 * b for a, b in zip(plain[98:103], plain[103:], strict=True)):
        at = (at + ((u >> 1) ^ -(u & 1))) % 2**16
        ranges.append(at)
    assert ranges == [1500, 65535, 65533, 65534, 2000]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.floats(0.0, 60.0),
            st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -1.0, 1e5, 29.9999]),
        ),
        min_size=1,
        max_size=50,
    )
)
def test_any_scan_is_of_the_same_kind_beam_by_beam(ranges):
    scan = Scan.create(5, ranges, -1.0, 0.1, 0.05, 30.0)
    found = KeyframeMessage.decode(message(scan=scan).encode()).scan
    for kind in ('returned', 'without_return', 'below_range_min', 'valid'):
        np.testing.assert_array_equal(getattr(found, kind), getattr(scan, kind))


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 400), st.integers(0, 255), st.integers(0, 400))
def test_damaged_bytes_are_an_error_or_a_message(at, value, cut):
    plain = bytearray(zlib.decompress(message().encode()))
    plain[at % len(plain)] = value
    try:
        found = KeyframeMessage.decode(zlib.compress(bytes(plain[: len(plain) - cut % 50])))
    except InputError as error:
        assert '\n' not in str(error)
    else:
        assert np.isfinite(found.T_map_base).all()
        assert all(np.isfinite(edge.information).all() for edge in found.edges)


@pytest.mark.parametrize(
    ('data', 'what'),
    [
        (b'', 'expected at least'),
        (b'no bytes of zlib', 'keyframe: '),
        (zlib.compress(b'short'), '5 bytes: expected at least'),
    ],
)
def test_other_bytes_are_an_error(data, what):
    with pytest.raises(InputError, match=what):
        KeyframeMessage.decode(data)


@pytest.mark.parametrize(
    ('wrong', 'what'),
    [
        (message(edges=[SentEdge(0, 4, INFORMATION)]), 'edge from 0 to 4: expected two up to it'),
        (message(edges=[SentEdge(1, 1, INFORMATION)]), 'edge from 1 to 1'),
        (message(edges=[SentEdge(0, 1, -INFORMATION)]), 'positive definite'),
        (message(edges=[SentEdge(0, 1, np.nan * INFORMATION)]), 'positive definite'),
        (message(number=1 << 20), 'keyframe 1048576: expected at most'),
        (KeyframeMessage(0, 0, np.array([np.nan, 0.0, 0.0]), message().scan), 'pose .nan, 0.0'),
    ],
)
def test_what_no_robot_sends_is_an_error(wrong, what):
    with pytest.raises(InputError, match=what):
        KeyframeMessage.decode(wrong.encode())


def test_poses_come_in_threes():
    np.testing.assert_array_equal(checked_poses(np.arange(6.0)), [[0, 1, 2], [3, 4, 5]])
    with pytest.raises(InputError, match='4 numbers: expected 3 for each'):
        checked_poses(np.arange(4.0))
    with pytest.raises(InputError, match='pose'):
        checked_poses(np.array([np.inf, 0.0, 0.0]))
