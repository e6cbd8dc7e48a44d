"""Tables of a graph that grows, as arrays: edges, headings, scans and the path."""

import math
from array import array
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, overload

import numpy as np
from numpy.typing import DTypeLike, NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.errors import MAX_BEAMS, InputError
from thinmap_ros.core.scan import MAX_MOUNT_OFFSET_M, Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.pose_graph import NO_SHARE, Edge, EdgeArrays, Systematic
from thinmap_ros.core.slam.wall_compass import Heading, Reference
from thinmap_ros.core.snapshot import Field, Fields, State


class Rows:
    """Rows of an array that grows; adding one takes constant time on average."""

    def __init__(self, *shape: int, dtype: DTypeLike = np.float64) -> None:
        """shape: of a row."""
        self._room: NDArray[Any] = np.zeros((8, *shape), dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, row: object) -> None:
        """Add a row."""
        if self._count == len(self._room):
            self._room = np.concatenate([self._room, np.zeros_like(self._room)])
        self._room[self._count] = row
        self._count += 1

    @property
    def values(self) -> NDArray[Any]:
        """The rows (N, ...), which may be changed in place; a view until the next one is added."""
        return self._room[: self._count]


class EdgeTable(Sequence[Edge]):
    """A sequence of edges, each made of its row of arrays: a long drive has tens of thousands."""

    def __init__(self, edges: Iterable[Edge] = ()) -> None:
        columns = [
            ('ends', np.int64, 2),
            ('T_a_b', np.float64, 3),
            ('information', np.float64, (3, 3)),
            ('robust', np.bool_),
            ('inlier_ratio', np.float64),
            ('derivative', np.float64, (3, 4)),
            ('parameters', np.float64, 4),
            ('spans', np.int64),
        ]
        self._rows = Rows(dtype=np.dtype(columns, align=True))
        self.extend(edges)

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> Edge: ...
    @overload
    def __getitem__(self, index: slice) -> list[Edge]: ...
    def __getitem__(self, index: int | slice) -> Edge | list[Edge]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        row = self._rows.values[index].copy()
        a, b = row['ends'].tolist()
        share = Systematic(row['derivative'], row['parameters'], int(row['spans']))
        return Edge(
            a,
            b,
            row['T_a_b'],
            row['information'],
            bool(row['robust']),
            share,
            float(row['inlier_ratio']),
        )

    def append(self, edge: Edge) -> None:
        """Add an edge."""
        share = edge.systematic
        self._rows.append(
            (
                (edge.a, edge.b),
                edge.T_a_b,
                edge.information,
                edge.robust,
                edge.inlier_ratio,
                share.derivative,
                share.parameters,
                share.spans,
            )
        )

    def extend(self, edges: Iterable[Edge]) -> None:
        """Add edges."""
        for edge in edges:
            self.append(edge)

    @property
    def ends(self) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
        """Keyframes a and b of each edge, (M, 2)."""
        return self._rows.values['ends']

    @property
    def information(self) -> Array:
        """Information (M, 3, 3) of each edge, which may be changed in place."""
        return self._rows.values['information']

    @property
    def derivatives(self) -> Array:
        """Derivative (M, 3, 4) of each relative pose by the calibration."""
        return self._rows.values['derivative']

    def arrays(self, parameters: Array | None = None) -> EdgeArrays:
        """The edges, as they are or would be with parameters (N, 4) of the calibration."""
        rows = self._rows.values
        a, b = rows['ends'].T.copy()
        T_a_b = rows['T_a_b'] + (0.0 if parameters is None else self._change(parameters))
        return EdgeArrays(a, b, T_a_b, self.information.copy(), rows['robust'].copy())

    def calibrate(self, parameters: Array) -> None:
        """Correct the edges by parameters (N, 4) of the calibration, by the number of spans."""
        rows = self._rows.values
        rows['T_a_b'] += self._change(parameters)
        rows['parameters'] = parameters[rows['spans']]

    def _change(self, parameters: Array) -> Array:
        """Change (M, 3) of the relative poses with parameters (N, 4), by the number of spans."""
        rows = self._rows.values
        by = parameters[rows['spans']] - rows['parameters']
        return np.asarray((self.derivatives @ by[:, :, None])[:, :, 0])


def heading_row(heading: Heading | None) -> tuple[float, ...]:
    """Yaw; its variance, infinite without one; variance and derivative (4,) of the direction."""
    return (0.0, math.inf, 0.0, 0.0, 0.0, 0.0, 0.0) if heading is None else heading.row


class HeadingTable:
    """The headings that wall directions measure, by keyframe, as arrays."""

    def __init__(self) -> None:
        columns = [
            ('row', np.float64, 7),
            ('parameters', np.float64, 4),
            ('spans', np.int64),
        ]
        self._rows = Rows(dtype=np.dtype(columns, align=True))

    def append(self, heading: Heading | None) -> None:
        """Add the heading of the next keyframe, or that it has none."""
        share = NO_SHARE if heading is None else heading.reference.systematic
        self._rows.append((heading_row(heading), share.parameters, share.spans))

    @property
    def rows(self) -> Array:
        """A row of `heading_row` for each keyframe, (N, 7)."""
        return self._rows.values['row']

    def of(self, number: int) -> Heading | None:
        """Heading of a keyframe; None without one."""
        saved = self._rows.values[number].copy()
        yaw, variance, of_reference, *by = saved['row'].tolist()
        if not math.isfinite(variance):
            return None
        derivative = np.zeros((3, 4))
        derivative[2] = by
        share = Systematic(derivative, saved['parameters'], int(saved['spans']))
        return Heading(yaw, variance, Reference(of_reference, share))

    def edges(self, first: float, parameters: Array | None = None) -> EdgeArrays:
        """The headings as edges from the first keyframe, which has a heading, rad.

        As they are, or would be with parameters (N, 4) of the calibration.
        """
        turns = 0.0 if parameters is None else self._turns(parameters)
        yaws = self.rows[:, 0] + turns
        numbers = 1 + np.flatnonzero(np.isfinite(self.rows[1:, 1]))
        rows = self.rows[numbers]
        T = np.zeros((len(rows), 3))
        T[:, 2] = yaws[numbers] - first
        information = np.zeros((len(rows), 3, 3))
        information[:, 2, 2] = 1.0 / (rows[:, 1] + rows[:, 2])
        return EdgeArrays(
            np.zeros_like(numbers), numbers, T, information, np.ones(len(rows), dtype=np.bool_)
        )

    def _turns(self, parameters: Array) -> Array:
        """Turn (N,) of each heading with parameters (N, 4), by the number of spans, rad."""
        by = parameters[self._rows.values['spans']] - self._rows.values['parameters']
        return np.asarray(np.einsum('ki,ki->k', self.rows[:, 3:], by))

    def calibrate(self, parameters: Array) -> None:
        """Correct the headings by parameters (N, 4) of the calibration, by the number of spans."""
        self.rows[:, 0] += self._turns(parameters)
        self._rows.values['parameters'] = parameters[self._rows.values['spans']]


class KeyframeTrajectory:
    """Stamped poses, each relative to a keyframe, or to the map before the first keyframe.

    Corrections of keyframes move all poses. Needs 36 bytes per pose.
    """

    def __init__(self) -> None:
        self._stamps = array('q')
        self._anchors = array('i')
        self._from_anchor = array('d')

    def add(self, stamp_ns: int, anchor: int, T_anchor_base: Array) -> None:
        """Add a pose (3,) relative to a keyframe; anchor -1: relative to the map."""
        self._stamps.append(stamp_ns)
        self._anchors.append(anchor)
        self._from_anchor.extend(T_anchor_base.tolist())

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps (N,), ns."""
        return np.array(self._stamps, dtype=np.int64)

    def poses(self, keyframes: Array) -> Array:
        """Poses (N, 3), map frame, given the poses (M, 3) of the keyframes."""
        # The last row is the origin of the map: index -1 selects it.
        anchors = np.vstack([keyframes.reshape(-1, 3), np.zeros(3)])[
            np.array(self._anchors, dtype=np.int64)
        ]
        return se2.compose_each(anchors, np.array(self._from_anchor).reshape(-1, 3))


# Of all scans together: 16,000 scans of 1,000 beams need about 1 GB once they are keyframes.
MAX_BEAMS_IN_ALL = 1 << 24

_MILLIMETRES = 1000.0

# Numbers that are no range, and the largest that is one.
_NO_RETURN = 65535
_BELOW_RANGE_MIN = 65534
_INVALID = 65533
_MAX_NUMBER = 65532

_MAX_UNIT_MM = 1000  # for ranges up to 65 km, and shorter ones to a metre

# First angle, increment, least and greatest range, mount (3,), usable range, two truth values.
_LOW = (-math.inf, -math.inf, 0.0, 0.0, *[-MAX_MOUNT_OFFSET_M] * 2, -math.inf, 0.0, 0.0, 0.0)

_HIGH = (*[math.inf] * 4, *[MAX_MOUNT_OFFSET_M] * 2, math.inf, math.inf, 1.0, 1.0)

# n scans of b beams in all, by l lasers.
FIELDS: Fields = {
    'lasers': Field(np.float64, ('l', len(_LOW)), _LOW, _HIGH),
    'laser_of': Field(np.int32, ('n',), 0),
    'beams': Field(np.int32, ('n',), 1, MAX_BEAMS),
    'unit_mm': Field(np.uint16, ('n',), 1, _MAX_UNIT_MM),
    'ranges': Field(np.uint16, ('b',)),
}


def packed_scans(scans: Sequence[Scan]) -> State:
    """The scans as arrays by name, for `unpacked_scans`; without stamps, and the times of beams.

    Ranges are 16 bit numbers, and each laser is stored once.
    ranges: in units of unit_mm, 1 mm unless the scan has ranges beyond 65 m; 0 stays 0, and
    numbers from 65533 on are: invalid, below range_min, no return.
    """
    lasers, laser_of = np.unique(
        np.array([_laser_of(scan) for scan in scans]).reshape(-1, len(_LOW)),
        axis=0,
        return_inverse=True,
    )
    packed = [_packed_ranges(scan) for scan in scans]
    return {
        'lasers': lasers,
        'laser_of': laser_of.reshape(-1).astype(np.int32),
        'beams': np.array([scan.ranges_m.size for scan in scans], dtype=np.int32),
        'unit_mm': np.array([unit for _, unit in packed], dtype=np.uint16),
        'ranges': np.concatenate([np.empty(0, np.uint16), *(numbers for numbers, _ in packed)]),
    }


def unpacked_scans(checked: State, what: str) -> list[Scan]:
    """Scans of arrays that fit `FIELDS`; the k-th has the stamp k + 1 ns, which no robot sends.

    Raises InputError, with `what` they are saved as, for arrays that contradict each other.
    """
    counts = checked['beams']
    ends = np.cumsum(counts, dtype=np.int64)
    total = int(ends[-1]) if len(ends) else 0
    ranges = checked['ranges']
    snapshot.require(
        total == len(ranges) <= MAX_BEAMS_IN_ALL,
        f'{what}: {len(ranges)} ranges of {total} beams',
        f'as many, at most {MAX_BEAMS_IN_ALL}',
    )
    lasers = checked['lasers']
    laser_of = checked['laser_of']
    known = np.arange(len(lasers), dtype=np.int64)
    snapshot.require_known(laser_of.astype(np.int64), known, f'{what}: laser_of')
    units = checked['unit_mm'].tolist()
    pieces = np.split(ranges, ends[:-1])
    scans = []
    for k, (laser, unit) in enumerate(zip(laser_of.tolist(), units, strict=True)):
        try:
            scans.append(_unpacked(k + 1, lasers[laser], pieces[k], unit))
        except InputError as error:
            raise InputError(f'saved {what}: {error}') from error
    return scans


def _laser_of(scan: Scan) -> list[float]:
    return [
        scan.angle_min_rad,
        scan.angle_increment_rad,
        scan.range_min_m,
        scan.range_max_m,
        *scan.T_base_laser.tolist(),
        scan.max_range_m,
        float(scan.zero_is_no_return),
        float(scan.drops_out),
    ]


def _packed_ranges(scan: Scan) -> tuple[NDArray[np.uint16], int]:
    """Ranges (N,) as numbers, and their unit, mm."""
    returned = scan.returned
    ranges_mm = _MILLIMETRES * np.where(returned, scan.ranges_m, 0.0)
    unit = math.ceil(max(float(ranges_mm.max(initial=0.0)) / _MAX_NUMBER, 1.0))
    unit = min(unit, _MAX_UNIT_MM)
    numbers = np.clip(np.rint(ranges_mm / unit), 1, _MAX_NUMBER)
    others = [scan.without_return, scan.below_range_min, scan.ranges_m == 0.0]
    code = np.select(others, [_NO_RETURN, _BELOW_RANGE_MIN, 0], _INVALID)
    return np.where(returned, numbers, code).astype(np.uint16), unit


def _unpacked(stamp_ns: int, laser: Array, numbers: NDArray[np.uint16], unit: int) -> Scan:
    first, step, low, high, x, y, yaw, usable, zero_is_no_return, drops_out = laser.tolist()
    # A range beside a limit stays on its side of it.
    below_high = float(np.nextafter(np.float32(high), np.float32(0.0)))
    ranges: NDArray[Any] = np.clip(numbers * (unit / _MILLIMETRES), low, below_high)
    others = [numbers == code for code in (0, _NO_RETURN, _BELOW_RANGE_MIN, _INVALID)]
    ranges = np.select(others, [0.0, math.inf, -math.inf, math.nan], ranges)
    scan = Scan.create(stamp_ns, ranges, first, step, low, high, np.array([x, y, yaw]))
    return replace(
        scan,
        max_range_m=usable,
        zero_is_no_return=bool(zero_is_no_return),
        drops_out=bool(drops_out),
    )
