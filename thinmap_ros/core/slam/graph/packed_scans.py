"""Scans in little memory: ranges as 16 bit numbers of millimetres, and each laser once."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.errors import MAX_BEAMS, InputError
from thinmap_ros.core.scan import MAX_MOUNT_OFFSET_M, Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import Field, Fields, State

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
