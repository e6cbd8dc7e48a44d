"""Bounds on the contents of messages and files."""

import math
from collections.abc import Iterable, Sequence
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import MAX_QUOTE_LENGTH, InputError, quoted

MAX_COORDINATE_M = se2.MAX_COORDINATE_M
MAX_ANGLE_RAD = 4.0 * np.pi
MAX_BEAMS = 200_000
# Drivers round the increment, as to 0.0175 rad for 1 degree, and some give the end of the last
# interval as angle_max.
_ROUNDING = 0.005
_INTERVALS = 1.0


def pose_of(what: str, value: object) -> se2.Array:
    """A pose (3,) of a caller: x, y (m) and heading (rad). Raises InputError for anything else."""
    try:
        pose = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape != (3,) or not se2.is_finite(pose):
        raise InputError(f'{what} = {quoted(value)}: expected x, y (m) and heading (rad), finite')
    return pose


def require_bounded(what: str, values: Iterable[float], limit: float = MAX_COORDINATE_M) -> None:
    """Raise InputError unless all values are finite and at most `limit` in magnitude."""
    for value in values:
        if not abs(value) <= limit:
            raise InputError(f'{what}: {value}: expected a number from {-limit:g} to {limit:g}')


def require_angles(angle_min_rad: float, angle_increment_rad: float, count: int) -> None:
    """Raise InputError unless first and last beam point to angles of a few turns at most."""
    last = angle_min_rad + angle_increment_rad * (count - 1)
    if not max(abs(angle_min_rad), abs(last)) <= MAX_ANGLE_RAD:
        raise InputError(
            f'{count} beams from {angle_min_rad:g} to {last:g} rad: expected angles from '
            f'-{MAX_ANGLE_RAD:.3g} to {MAX_ANGLE_RAD:.3g} rad: are they in degrees?'
        )


def angle_warning(
    angle_min_rad: float, angle_max_rad: float, angle_increment_rad: float, count: int
) -> str:
    """How angle_max contradicts the number of beams; '' where it fits.

    The beams are used as angle_min and angle_increment say.
    """
    if count < 2:
        return ''
    fitting = (angle_max_rad - angle_min_rad) / angle_increment_rad + 1.0
    if abs(fitting - count) <= _INTERVALS + _ROUNDING * count:
        return ''
    fits = f'fits {fitting:.0f} beams' if math.isfinite(fitting) else 'fits no number of beams'
    return (
        f'angle_max {angle_max_rad:g} {fits}, {count} came (angle_min {angle_min_rad:g}, '
        f'angle_increment {angle_increment_rad:g} rad): is the map bent or mirrored?'
    )


def require_lengths(what: str, lengths: Iterable[float]) -> None:
    """Raise InputError unless all lengths (m) are from 0 to MAX_COORDINATE_M."""
    for length in lengths:
        if not 0.0 <= length <= MAX_COORDINATE_M:
            raise InputError(f'{what}: {length} m: expected 0 to {MAX_COORDINATE_M:g} m')


def quoted_name(text: str, longest: int = 80) -> str:
    """Shorten a topic, type or frame of a file for an error message.

    One line of printable characters, without quotation marks.
    """
    return repr(text if len(text) <= longest else text[:longest] + '...')[1:-1]


def quoted_names(names: Sequence[str]) -> str:
    """List names of a file for an error message: the first ones, and the number of the others."""
    shown = [quoted_name(name) for name in names]
    lengths = accumulate(len(name) + 2 for name in shown)
    count = max(1, sum(length <= MAX_QUOTE_LENGTH for length in lengths))
    more = f' and {len(shown) - count} more' if len(shown) > count else ''
    return ', '.join(shown[:count]) + more or 'nothing'


def require_occupancy(cells: NDArray[np.int8]) -> None:
    """Raise InputError unless all cells are -1 (unknown) or 0 to 100 %."""
    if cells.size and (cells.min() < -1 or cells.max() > 100):
        raise InputError(
            f'map with cells from {cells.min()} to {cells.max()}: expected -1, or 0 to 100'
        )


def require_unique(what: str, ids: list[int]) -> None:
    """Raise InputError if an id occurs twice."""
    if len(set(ids)) < len(ids):
        raise InputError(
            f'{what}: {len(ids)} of them with {len(set(ids))} ids: expected an id for each'
        )
