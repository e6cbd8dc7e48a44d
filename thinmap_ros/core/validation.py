"""Limits of the values of messages and files: beyond them they are errors."""

from collections.abc import Iterable, Sequence
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError

FARTHEST_M = se2.FARTHEST_M
LARGEST_ANGLE_RAD = 4.0 * np.pi
MOST_BEAMS = 200_000
LONGEST_LIST = 200


def require_bounded(what: str, values: Iterable[float], limit: float = FARTHEST_M) -> None:
    """Raise InputError, naming `what`, unless all values are finite and at most `limit` in size."""
    for value in values:
        if not abs(value) <= limit:
            raise InputError(f'{what}: {value}: expected a number from {-limit:g} to {limit:g}')


def abbreviated(text: str, longest: int = 80) -> str:
    """A name from a file for an error message: printable, on one line, of limited length."""
    return repr(text if len(text) <= longest else text[:longest] + '...')[1:-1]


def listed(names: Sequence[str]) -> str:
    """Names from a file for an error message: the first ones, and how many more there are."""
    shown = [abbreviated(name) for name in names]
    lengths = accumulate(len(name) + 2 for name in shown)
    count = max(1, sum(length <= LONGEST_LIST for length in lengths))
    more = f' and {len(shown) - count} more' if len(shown) > count else ''
    return ', '.join(shown[:count]) + more or 'nothing'


def cells_in_range(cells: NDArray[np.int8]) -> None:
    """Raise InputError unless all cells are -1 (unknown) or 0 to 100 %."""
    if cells.size and (cells.min() < -1 or cells.max() > 100):
        raise InputError(
            f'map with cells from {cells.min()} to {cells.max()}: expected -1, or 0 to 100'
        )


def unique(what: str, ids: list[int]) -> None:
    """Raise InputError where an id occurs twice."""
    if len(set(ids)) < len(ids):
        raise InputError(
            f'{what}: {len(ids)} of them with {len(set(ids))} ids: expected an id for each'
        )
