"""Keyframes as bytes: what a robot sends of the map that it makes, for a joint map that bends.

A message holds one keyframe: its pose, its scan with ranges in millimetres, and edges of the pose
graph. An edge has no relative pose: it is that of the poses, at which the robot's own graph is
optimal.
"""

import struct
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.errors import MAX_BEAMS, InputError, one_line_reason
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, inverse
from thinmap_ros.core.slam.graph import tables
from thinmap_ros.core.slam.graph.keyframes import (
    MAX_EDGES,
    MAX_KEYFRAMES,
    MAX_VALUE,
    ROUNDING,
    UPPER,
    symmetric_matrices,
    with_calibration,
)
from thinmap_ros.core.slam.graph.loop_closure import LoopClosure
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.odometry import UNKNOWN
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, State

_WHAT = 'keyframe'

# Number, revision, edges, unit of the ranges, pose, laser.
_HEADER = struct.Struct('<IIIH3f10f')

_EDGE = struct.Struct('<II6f')

_MOST_BYTES = _HEADER.size + MAX_EDGES * _EDGE.size + 2 * MAX_BEAMS


@dataclass(frozen=True, eq=False)
class SentEdge:
    """Information (3, 3) on the relative pose of keyframe b in a, by their numbers, frame of a."""

    a: int
    b: int
    information: Array


@dataclass(frozen=True, eq=False)
class KeyframeMessage:
    """A keyframe of a number 0, 1, 2, ..., at a pose (3,) after so many corrections (revision).

    edges: that are known since the last message, between keyframes up to this one. A number that
    has come before brings edges only.
    """

    number: int
    revision: int
    T_map_base: Array
    scan: Scan
    edges: tuple[SentEdge, ...] = ()

    def encode(self) -> bytes:
        """The message as bytes."""
        packed = tables.packed_scans([self.scan])
        head = _HEADER.pack(
            self.number,
            self.revision,
            len(self.edges),
            int(packed['unit_mm'][0]),
            *self.T_map_base.tolist(),
            *packed['lasers'][0].tolist(),
        )
        edges = [
            _EDGE.pack(edge.a, edge.b, *edge.information[UPPER].tolist()) for edge in self.edges
        ]
        return zlib.compress(head + b''.join(edges) + _differences(packed['ranges']), 9)

    @staticmethod
    def decode(data: bytes) -> 'KeyframeMessage':
        """The message in some bytes. Raises InputError where they are none."""
        try:
            plain = zlib.decompressobj().decompress(data, _MOST_BYTES)
        except zlib.error as error:
            raise InputError(f'{_WHAT}: {one_line_reason(error)}') from error
        if len(plain) < _HEADER.size:
            raise InputError(f'{_WHAT}: {len(plain)} bytes: expected at least {_HEADER.size}')
        number, revision, count, unit_mm, *numbers = _HEADER.unpack_from(plain)
        first = _HEADER.size + count * _EDGE.size
        if len(plain) < first + 2 or (len(plain) - first) % 2:
            raise InputError(f'{_WHAT}: {len(plain)} bytes: expected {first}, and 2 for each beam')
        T_map_base = _pose(np.array(numbers[:3]))
        edges = tuple(
            _edge(_EDGE.unpack_from(plain, _HEADER.size + k * _EDGE.size), number)
            for k in range(count)
        )
        scan = _scan(np.array(numbers[3:]), unit_mm, _ranges(plain[first:]))
        if number >= MAX_KEYFRAMES:
            raise InputError(f'{_WHAT} {number}: expected at most {MAX_KEYFRAMES}')
        return KeyframeMessage(number, revision, T_map_base, scan, edges)


def checked_poses(values: Array) -> Array:
    """Poses (N, 3) of as many numbers in a row. Raises InputError where they are none."""
    if values.size % 3 or values.size > 3 * MAX_KEYFRAMES:
        raise InputError(
            f'poses of keyframes: {values.size} numbers: expected 3 for each of at most '
            f'{MAX_KEYFRAMES}'
        )
    poses = np.asarray(values, dtype=np.float64).reshape(-1, 3)
    for T in poses:
        _pose(T)
    return poses


def _differences(numbers: NDArray[np.uint16]) -> bytes:
    """Differences of neighbours, small ones as small numbers, all low bytes first."""
    steps = np.diff(numbers.astype(np.int64), prepend=0).astype(np.int16)
    folded = ((steps << 1) ^ (steps >> 15)).astype('<i2')
    return folded.view(np.uint8).reshape(-1, 2).T.tobytes()


def _ranges(data: bytes) -> NDArray[np.uint16]:
    """The numbers whose `_differences` are these bytes."""
    halves = np.frombuffer(data, dtype=np.uint8).reshape(2, -1)
    folded = np.ascontiguousarray(halves.T).view('<u2').reshape(-1).astype(np.int64)
    steps = (folded >> 1) ^ -(folded & 1)
    return (np.cumsum(steps) & 0xFFFF).astype(np.uint16)


def _scan(laser: Array, unit_mm: int, ranges: NDArray[np.uint16]) -> Scan:
    state: State = {
        'lasers': laser[None],
        'laser_of': np.zeros(1, dtype=np.int32),
        'beams': np.array([len(ranges)], dtype=np.int32),
        'unit_mm': np.array([unit_mm], dtype=np.uint16),
        'ranges': ranges,
    }
    checked = snapshot.validate(state, tables.FIELDS, _WHAT)
    return tables.unpacked_scans(checked, _WHAT)[0]


def _edge(values: tuple[int | float, ...], number: int) -> SentEdge:
    """An edge between keyframes up to a number."""
    a, b = (int(value) for value in values[:2])
    if a == b or max(a, b) > number:
        raise InputError(f'{_WHAT} {number}: edge from {a} to {b}: expected two up to it')
    (information,) = symmetric_matrices(np.array([values[2:]]))
    return SentEdge(a, b, _definite(information))


def _definite(information: Array) -> Array:
    """The matrix (3, 3). Raises InputError unless it is bounded and positive, but for rounding."""
    if (np.abs(information) <= MAX_VALUE).all():
        values = np.linalg.eigvalsh(information)
        if values[2] > 0.0 and values[0] > -ROUNDING * values[2]:
            return information
    raise InputError(f'{_WHAT}: information of an edge: expected a positive definite matrix')


def _pose(T: Array) -> Array:
    if not se2.is_bounded_pose(T):
        raise InputError(
            f'{_WHAT}: pose {T.tolist()}: expected finite numbers up to {MAX_COORDINATE_M:g} m'
        )
    return T


class KeyframeSender:
    """Sends each keyframe of the published map once, and the poses of all after a correction.

    Keyframes that are apart are sent after they are joined. They are numbered as they are sent.
    """

    def __init__(self, loops: LoopClosure) -> None:
        """loops: the keyframes of the robot, and their graph."""
        self.loops = loops
        self.revision = 0  # corrections that were sent
        self._seen_revision = loops.keyframes.revision
        self._is_corrected = False  # since the last message
        self._told: list[int] = []  # their numbers in the graph
        self._waiting: list[int] = []
        self._seen = 0  # keyframes of the graph
        self._open: list[Edge] = []  # those that are not sent
        self._seen_edges = 0

    def corrected_poses(self) -> Array | None:
        """Poses (N, 3) of all that are sent, if they were corrected since the last call."""
        keyframes = self.loops.keyframes
        if keyframes.revision == self._seen_revision:
            return None
        self._seen_revision = keyframes.revision
        self.revision += 1
        self._is_corrected = True
        return np.array([keyframes.frames[k].T_map_base for k in self._told]).reshape(-1, 3)

    def next_message(self) -> KeyframeMessage | None:
        """The next keyframe, or the last one again with edges; None: all are sent.

        Call `corrected_poses` before.
        """
        frames = self.loops.keyframes.frames
        self._waiting += range(self._seen, len(frames))
        self._seen = len(frames)
        pieces = self.loops.pieces
        ready = (k for k in self._waiting if pieces.is_published(frames[k].submap))
        k = next(ready, None)
        if k is None:  # edges of a loop that no new keyframe has told
            edges = self._edges() if self._is_corrected else []
            return self._last(edges) if edges else None
        self._waiting.remove(k)
        self._told.append(k)
        if k:
            self._open.append(self.loops.keyframes.steps[k - 1])
        edges = self._edges()
        last = len(self._told) - 1
        if last and not any(last in (edge.a, edge.b) for edge in edges):
            edges.append(SentEdge(last - 1, last, inverse(UNKNOWN)))
        return self._last(edges)

    def _last(self, edges: list[SentEdge]) -> KeyframeMessage:
        """The keyframe that was told last, with edges."""
        self._is_corrected = False
        frame = self.loops.keyframes.frames[self._told[-1]]
        number = len(self._told) - 1
        return KeyframeMessage(number, self.revision, frame.T_map_base, frame.scan, tuple(edges))

    def _edges(self) -> list[SentEdge]:
        """All edges that are not told yet, between keyframes that are."""
        edges = self.loops.graph.edges
        self._open += edges[self._seen_edges :]
        self._seen_edges = len(edges)
        number_of = {told: number for number, told in enumerate(self._told)}
        ready = [edge for edge in self._open if edge.a in number_of and edge.b in number_of]
        self._open = [edge for edge in self._open if edge not in ready]
        return [self._sent(edge, number_of) for edge in ready]

    def _sent(self, edge: Edge, number_of: dict[int, int]) -> SentEdge:
        """An edge with the weight and the uncertainty that it has in the robot's own graph."""
        frames = self.loops.keyframes.frames
        T = se2.between(frames[edge.a].T_map_base, frames[edge.b].T_map_base)
        weight = edge.weight_at(T)
        own = with_calibration(edge, self.loops.calibration)
        return SentEdge(number_of[edge.a], number_of[edge.b], weight * own.information)
