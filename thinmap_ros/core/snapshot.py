"""Schema and validation of saved states: arrays by name, validated before use.

Each class with a state declares its fields. `validate` checks names, types, shapes and ranges. The
class itself checks relations between arrays, with the helpers below.
"""

import math
import re
from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, quoted

State = Mapping[str, NDArray[Any]]
MAX_COORDINATE_M = se2.MAX_COORDINATE_M
MAX_CELL_INDEX = 1_000_000_000  # MAX_COORDINATE_M in the smallest cells
MAX_ID = 2**31 - 1
MAX_COUNT = 2**62
_SIZE = re.compile(r'(\d*)([a-z]+)')


@dataclass(frozen=True)
class Field:
    """Declaration of an array of a state.

    dtype: its type; types that convert to it without loss are accepted. shape: for each axis a
    number, or the name of a size that several arrays share ('n'; '2n' is twice as much). low, high:
    inclusive bounds, one for all elements or one for each index of the last axis. nan: whether NaN
    is allowed.
    """

    dtype: DTypeLike
    shape: tuple[int | str, ...] = ()
    low: float | tuple[float, ...] = -math.inf
    high: float | tuple[float, ...] = math.inf
    nan: bool = False


Fields = Mapping[str, Field]


def validate(state: State, fields: Fields, what: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of a state in their declared types; `what` names it in errors.

    Raises InputError if a name is missing or unknown, or an array does not fit its field.
    """
    return validate_arrays(state, fields, f'saved {what}')


def validate_arrays(arrays: State, fields: Fields, what: str) -> dict[str, NDArray[Any]]:
    """As `validate`, for arrays that are not those of a saved state."""
    for name in arrays:
        if name not in fields:
            raise InputError(f'{what}: {quoted(name)}: expected {", ".join(fields)} only')
    sizes: dict[str, int] = {}
    checked = {}
    for name, field in fields.items():
        if name not in arrays:
            raise InputError(f'{what}: no {name}: expected {", ".join(fields)}')
        checked[name] = _checked(np.asarray(arrays[name]), field, sizes, f'{what}: {name}')
    return checked


def split(state: State, names: Container[str]) -> tuple[State, State]:
    """Split a state into the arrays of some names, and the others."""
    own = {name: array for name, array in state.items() if name in names}
    return own, {name: array for name, array in state.items() if name not in own}


def split_prefix(state: State, prefix: str) -> tuple[State, State]:
    """Split a state into the arrays whose names have a prefix, without it, and the others."""
    own, rest = split(state, [name for name in state if name.startswith(prefix)])
    return {name.removeprefix(prefix): array for name, array in own.items()}, rest


def split_number(state: State, name: str) -> tuple[int, State]:
    """Split the state of a node into a number that is not negative, and the other arrays.

    Raises InputError if there is no such number.
    """
    own, rest = split(state, [name])
    number = validate(own, {name: Field(np.int64, (), 0, MAX_COUNT)}, 'state')[name]
    return int(number), rest


def text_array(text: str) -> NDArray[np.uint8]:
    """A text as an array (N,), for `split_text`."""
    return np.frombuffer(text.encode(), dtype=np.uint8)


def split_text(state: State, name: str) -> tuple[str, dict[str, NDArray[Any]]]:
    """Split the state of a node into a text, '' where there is none, and the other arrays.

    Raises InputError where it is none.
    """
    own = {name: np.asarray(state.get(name, np.empty(0, dtype=np.uint8)))}
    codes = validate(own, {name: Field(np.uint8, ('n',))}, 'state')[name]
    try:
        text = bytes(codes).decode()
    except UnicodeDecodeError as error:
        raise InputError(f'saved state: {name}: {error}: expected UTF-8') from error
    return text, {key: array for key, array in state.items() if key != name}


def require(is_so: bool, what: str, expected: str) -> None:
    """Raise InputError with what was found and what was expected, unless is_so."""
    if not is_so:
        raise InputError(f'saved {what}: expected {expected}')


def require_unique(ids: NDArray[np.int64], what: str) -> None:
    """Raise InputError if one of the ids (N,) occurs twice."""
    values, counts = np.unique(ids, return_counts=True)
    twice = values[counts > 1]
    if twice.size:
        raise InputError(f'saved {what}: {twice[0]} occurs twice: expected each once')


def require_known(ids: NDArray[np.int64], known: NDArray[np.int64], what: str) -> None:
    """Raise InputError if one of the ids (N,) is not among the known ones (M,)."""
    unknown = ids[~np.isin(ids, known)]
    if unknown.size:
        raise InputError(f'saved {what}: {unknown[0]}: expected one of the {len(known)} known ids')


def _checked(array: NDArray[Any], field: Field, sizes: dict[str, int], what: str) -> NDArray[Any]:
    dtype = np.dtype(field.dtype)
    shape = ', '.join(str(size) for size in field.shape)
    expected = f'expected {dtype} ({shape})'
    if array.dtype.kind not in 'biuf' or not np.can_cast(array.dtype, dtype, 'safe'):
        raise InputError(f'{what}: {quoted(str(array.dtype))}: {expected}')
    if array.ndim != len(field.shape):
        raise InputError(f'{what}: of {array.ndim} dimensions: {expected}')
    for size, declared in zip(array.shape, field.shape, strict=True):
        if not _fits(size, declared, sizes):
            known = ', '.join(f'{name} = {value}' for name, value in sizes.items())
            raise InputError(f'{what}: {array.shape}: {expected}{"; " if known else ""}{known}')
    _check_range(array, field, what)
    return array.astype(dtype)


def _fits(size: int, declared: int | str, sizes: dict[str, int]) -> bool:
    """Whether an axis has its declared size. A new size name is bound to this size."""
    if isinstance(declared, int):
        return size == declared
    match = _SIZE.fullmatch(declared)
    assert match is not None
    factor = int(match[1] or 1)
    if size % factor:
        return False
    return sizes.setdefault(match[2], size // factor) == size // factor


def _check_range(array: NDArray[Any], field: Field, what: str) -> None:
    # Written so that NaN, which is in no range, is rejected as well; a signalling one would warn.
    with np.errstate(invalid='ignore'):
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
