"""Errors that thinmap reports to its user, and the checks that raise them."""

import inspect
import math
import reprlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import wraps
from itertools import accumulate
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2

MAX_QUOTE_LENGTH = 200
_LONGEST_NAME = 80
_MAX_INTEGER = 10**30

# Bounds on the contents of messages and files.
MAX_ANGLE_RAD = 4.0 * np.pi
MAX_BEAMS = 200_000
# Drivers round the increment, as to 0.0175 rad for 1 degree, and some give the end of the last
# interval as angle_max.
_ROUNDING = 0.005
_INTERVALS = 1.0


class ThinmapError(Exception):
    """Base of all errors that thinmap raises for its user; the message is one line."""


class InputError(ThinmapError):
    """A file, topic or message that cannot be used.

    The message names it, the value, and what was expected.
    """


class ConfigError(ThinmapError):
    """A parameter outside its range: the message names it, the value, and what was expected."""


def require_type(what: str, value: object, *kinds: type) -> None:
    """Raise InputError unless a value is of one of some types; what: the value's name."""
    if not isinstance(value, kinds):
        names = ' or '.join(kind.__name__ for kind in kinds if kind is not type(None))
        raise InputError(f'{what} = {quoted(value)}: expected {with_article(names)}')


def require_known(given: Mapping[str, object], known: Collection[str]) -> None:
    """Raise ConfigError where a keyword of a caller is none of those that are known."""
    for name, value in given.items():
        if name not in known:
            longer = [other for other in known if other.startswith(f'{name}_')]
            meant = did_you_mean(longer[0] if longer else name, known)
            names = quoted_names(list(known))
            raise ConfigError(f'{name} = {quoted(value)}{meant}: expected one of {names}')


Function = TypeVar('Function', bound=Callable[..., Any])


def with_known_keywords(function: Function) -> Function:
    """Decorator: a keyword that the function does not take is a ConfigError of one line."""
    known = [name for name in inspect.signature(function).parameters if name != 'self']

    @wraps(function)
    def checked(*given: Any, **by_name: Any) -> Any:
        require_known(by_name, known)
        return function(*given, **by_name)

    return cast(Function, checked)


def did_you_mean(word: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """The known name that a word is most like, for an error message; '' where none is.

    cutoff: least similarity, 0 to 1.
    """
    likely = get_close_matches(word, sorted(known), n=1, cutoff=cutoff)
    return f' (did you mean {likely[0]}?)' if likely else ''


def with_article(noun: str) -> str:
    """A noun with its article: a Scan, an OccupancyGrid."""
    return f'{"an" if noun[:1] in "AEIOUaeiou" else "a"} {noun}'


def counted(count: int, noun: str) -> str:
    """A number and its noun, which gets an s unless there is one: 1 line, 2 lines."""
    return f'{count} {noun}{"" if count == 1 else "s"}'


def quoted(value: object) -> str:
    """Quote a foreign value in an error message: its `repr`, one line, at most 200 characters."""
    return one_line(_QUOTE.repr(value))


def one_line_reason(error: BaseException) -> str:
    """Message of another library's error, one line of at most 200 characters; else its type.

    After its notes: what was processed when it came.
    """
    # A KeyError holds the missing key. An integer of a million digits cannot even be converted.
    text = quoted(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    notes = getattr(error, '__notes__', [])
    return one_line(': '.join([*notes, text or type(error).__name__]))


def one_line(text: str) -> str:
    """Text without line breaks and shortened in its middle to at most 200 characters."""
    # Both ends are enough: splitting a long text into words takes as long as reading it.
    if len(text) > 4 * MAX_QUOTE_LENGTH:
        text = text[: 2 * MAX_QUOTE_LENGTH] + text[-2 * MAX_QUOTE_LENGTH :]
    line = ' '.join(text.split())
    line = ''.join(c if c.isprintable() else '?' for c in line)
    half = (MAX_QUOTE_LENGTH - 3) // 2
    return line if len(line) <= MAX_QUOTE_LENGTH else f'{line[:half]}...{line[-half:]}'


class _Quote(reprlib.Repr):
    """A `repr` of a few members of each collection, and of no number of thousands of digits."""

    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = MAX_QUOTE_LENGTH
        self.maxlevel = 3

    def repr_int(self, x: int, level: int) -> str:
        if abs(x) <= _MAX_INTEGER:
            return repr(x)
        return f'a whole number of {x.bit_length()} bits'


_QUOTE = _Quote()


def pose_of(what: str, value: object) -> se2.Array:
    """A pose (3,) of a caller: x, y (m) and heading (rad). Raises InputError for anything else."""
    try:
        pose = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape != (3,) or not se2.is_finite(pose):
        raise InputError(f'{what} = {quoted(value)}: expected x, y (m) and heading (rad), finite')
    return pose


def place_of(what: str, value: object) -> se2.Place:
    """A place of a caller: x and y (m), as two numbers. Raises InputError for anything else."""
    try:
        place = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        place = np.empty(0)
    if place.shape != (2,) or not np.isfinite(place).all():
        raise InputError(f'{what} = {quoted(value)}: expected x and y (m), finite')
    return float(place[0]), float(place[1])


def require_bounded(
    what: str, values: Iterable[float], limit: float = se2.MAX_COORDINATE_M
) -> None:
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


def quoted_name(text: str) -> str:
    """Shorten a topic, type or frame of a file for an error message.

    One line of printable characters, without quotation marks.
    """
    return repr(text if len(text) <= _LONGEST_NAME else text[:_LONGEST_NAME] + '...')[1:-1]


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
