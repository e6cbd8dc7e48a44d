"""What a saved state has to look like: arrays by name, checked before any of them is used.

Each class with a state declares its fields beside it. `check` looks at names, types, shapes and
ranges; what arrays say about each other is checked by the class, with the helpers here.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from thinmap_ros.core.errors import InputError, shown
from thinmap_ros.core.se2 import FARTHEST_M

State = Mapping[str, NDArray[Any]]
FAR_M = FARTHEST_M
FAR_CELLS = 1_000_000_000  # the same in the smallest cells
LARGEST_ID = 2**31 - 1
LARGEST_COUNT = 2**62
_SIZE = re.compile(r'(\d*)([a-z]+)')


@dataclass(frozen=True)
class Field:
    """What an array of a state has to be.

    dtype: its type, or one that converts to it without loss. shape: a number, or the name of a size
    that several arrays share ('n'; '2n' is twice as much), for each axis. low, high: inclusive
    bounds, for all or one for each index of the last axis. nan: whether it may hold NaN.
    """

    dtype: DTypeLike
    shape: tuple[int | str, ...] = ()
    low: float | tuple[float, ...] = -math.inf
    high: float | tuple[float, ...] = math.inf
    nan: bool = False


Fields = Mapping[str, Field]


STAMPED: Fields = {'latest_ns': Field(np.int64, (), 0, LARGEST_COUNT)}


def check(state: State, fields: Fields, what: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of a state in their declared types; what: of what it is, for the error.

    Raises InputError where a name is missing or unknown, or an array is not what its field says.
    """
    for name in state:
        if name not in fields:
            raise InputError(f'saved {what}: {shown(name)}: expected {", ".join(fields)} only')
    sizes: dict[str, int] = {}
    checked = {}
    for name, field in fields.items():
        if name not in state:
            raise InputError(f'saved {what}: no {name}: expected {", ".join(fields)}')
        checked[name] = _checked(np.asarray(state[name]), field, sizes, f'saved {what}: {name}')
    return checked


def split_stamp(state: State) -> tuple[int, dict[str, NDArray[Any]]]:
    """Return the stamp, ns, of a node's checkpoint ('latest_ns'), and the rest of its arrays.

    Raises InputError where there is no stamp.
    """
    own = {name: array for name, array in state.items() if name in STAMPED}
    stamp_ns = int(check(own, STAMPED, 'state')['latest_ns'])
    return stamp_ns, {name: array for name, array in state.items() if name not in STAMPED}


def require(is_so: bool, what: str, expected: str) -> None:
    """Raise InputError, saying what was found and what was expected, unless it is so."""
    if not is_so:
        raise InputError(f'saved {what}: expected {expected}')


def require_unique(ids: NDArray[np.int64], what: str) -> None:
    """Raise InputError where one of the ids (N,) occurs twice."""
    values, counts = np.unique(ids, return_counts=True)
    twice = values[counts > 1]
    if twice.size:
        raise InputError(f'saved {what}: {twice[0]} occurs twice: expected each once')


def require_known(ids: NDArray[np.int64], known: NDArray[np.int64], what: str) -> None:
    """Raise InputError where one of the ids (N,) is none of those that are known (M,)."""
    unknown = ids[~np.isin(ids, known)]
    if unknown.size:
        raise InputError(
            f'saved {what}: {unknown[0]}: expected one of the {len(known)} that are there'
        )


def _checked(array: NDArray[Any], field: Field, sizes: dict[str, int], what: str) -> NDArray[Any]:
    dtype = np.dtype(field.dtype)
    shape = ', '.join(str(size) for size in field.shape)
    expected = f'expected {dtype} ({shape})'
    if array.dtype.kind not in 'biuf' or not np.can_cast(array.dtype, dtype, 'safe'):
        raise InputError(f'{what}: {shown(str(array.dtype))}: {expected}')
    if array.ndim != len(field.shape):
        raise InputError(f'{what}: of {array.ndim} dimensions: {expected}')
    for size, declared in zip(array.shape, field.shape, strict=True):
        if not _fits(size, declared, sizes):
            known = ', '.join(f'{name} = {value}' for name, value in sizes.items())
            raise InputError(f'{what}: {array.shape}: {expected}{"; " if known else ""}{known}')
    _check_range(array, field, what)
    return array.astype(dtype)


def _fits(size: int, declared: int | str, sizes: dict[str, int]) -> bool:
    """Whether an axis has its declared size; a new name stands for this size from now on."""
    if isinstance(declared, int):
        return size == declared
    match = _SIZE.fullmatch(declared)
    assert match is not None
    factor = int(match[1] or 1)
    if size % factor:
        return False
    return sizes.setdefault(match[2], size // factor) == size // factor


def _check_range(array: NDArray[Any], field: Field, what: str) -> None:
    # Written so that NaN, which is in no range, is refused as well.
    wrong = ~((array >= np.asarray(field.low)) & (array <= np.asarray(field.high)))
    if field.nan:
        wrong &= ~np.isnan(array)
    if not wrong.any():
        return
    index = tuple(np.argwhere(wrong)[0])
    low = np.broadcast_to(np.asarray(field.low), array.shape)[index]
    high = np.broadcast_to(np.asarray(field.high), array.shape)[index]
    at = f'[{", ".join(str(i) for i in index)}]' if index else ''
    raise InputError(f'{what}{at}: {array[index]}: expected {low:g} to {high:g}')
