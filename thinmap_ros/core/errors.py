"""Errors that thinmap reports to its user, and how their messages quote values."""

import reprlib

MAX_QUOTE_LENGTH = 200
_MAX_INTEGER = 10**30


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
