"""What a message may say at most: beyond that it is a mistake, whoever made it."""

from collections.abc import Iterable, Sequence
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError

MAX_COORDINATE_M = se2.MAX_COORDINATE_M
MAX_ANGLE_RAD = 4.0 * np.pi
MAX_BEAMS = 200_000
MAX_LIST_LENGTH = 200


def require_bounded(what: str, values: Iterable[float], limit: float = MAX_COORDINATE_M) -> None:
    """Raise InputError, naming what, unless all values are finite and at most `limit` in size."""
    for value in values:
        if not abs(value) <= limit:
            raise InputError(f'{what}: {value}: expected a number from {-limit:g} to {limit:g}')


def abbreviated(text: str, longest: int = 80) -> str:
    """A topic, type or frame of a file as part of a message.

    One line of printable characters, unquoted, short.
    """
    return repr(text if len(text) <= longest else text[:longest] + '...')[1:-1]


def listed(names: Sequence[str]) -> str:
    """Names of a file as part of a message.

    The first of them, in short, and how many more there are.
    """
    told = [abbreviated(name) for name in names]
    lengths = accumulate(len(name) + 2 for name in told)
    count = max(1, sum(length <= MAX_LIST_LENGTH for length in lengths))
    more = f' and {len(told) - count} more' if len(told) > count else ''
    return ', '.join(told[:count]) + more or 'nothing'


def cells_in_range(cells: NDArray[np.int8]) -> None:
    """Raise InputError unless all cells are -1 (unknown) or 0 to 100 %."""
    if cells.size and (cells.min() < -1 or cells.max() > 100):
        raise InputError(
            f'map with cells from {cells.min()} to {cells.max()}: expected -1, or 0 to 100'
        )


def unique(what: str, ids: list[int]) -> None:
    """Raise InputError where a number is given twice."""
    if len(set(ids)) < len(ids):
        raise InputError(
            f'{what}: {len(ids)} of them with {len(set(ids))} ids: expected an id for each'
        )
