"""The interface of fuzz cases, and common checks."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.core.errors import ThinmapError

LONGEST_ERROR = 1_000
NUMBERS = (
    *('nan', 'inf', '-inf', '0', '-0.0', '-1', '1', '2', '1e9', '-1e9', '1e300', '1e-300', '1e999'),
    *('2147483648', '9' * 25, '0x10', '1_000', '7', '3.5', '100000'),
)
WORDS = ('', 'null', 'true', '[]', '{}', '~', '\u5730\u56f3', 'a' * 5_000, '../x', '\0', '"', '- -')


@dataclass(frozen=True)
class Source:
    """Cases of one kind.

    prepare(folder) makes their shared data once; run(shared, rng, folder) makes a case below
    the folder and tests it. It raises an exception on failure; a ThinmapError for the user is no
    failure.
    """

    name: str
    prepare: Callable[[Path], Any]
    run: Callable[[Any, np.random.Generator, Path], None]


def nothing(folder: Path) -> None:
    """Share nothing."""


def tried(work: Callable[[], Any]) -> Any:
    """Result of a call, or None if it is rejected with a proper error message."""
    try:
        return work()
    except ThinmapError as error:
        said = str(error)
        assert said, 'an error that says nothing'
        assert len(said) <= LONGEST_ERROR, f'{len(said)} characters: {said[:200]}...'
        assert said.isprintable(), f'not one line of printable characters: {said!r}'
    return None


def finite(*values: Any) -> None:
    """Raise AssertionError unless all numbers are finite."""
    for value in values:
        assert np.isfinite(np.asarray(value, dtype=np.float64)).all(), f'not finite: {value}'


def chosen(rng: np.random.Generator, things: Any) -> Any:
    """A random choice."""
    return things[int(rng.integers(len(things)))]


def damaged_text(rng: np.random.Generator, text: str) -> str:
    """A text with up to four words or lines changed, removed, repeated or swapped."""
    for _ in range(int(rng.integers(0, 5))):
        text = chosen(rng, _DAMAGES)(rng, text)
    return text


def damaged_bytes(rng: np.random.Generator, content: bytes) -> bytes:
    """A file with up to three bytes changed, truncated, or with a part inserted again."""
    data = bytearray(content)
    if not data or rng.random() < 0.3:
        return bytes(data)
    at = int(rng.integers(len(data)))
    kind = rng.choice(['change', 'change', 'cut', 'repeat', 'zero'])
    length = int(rng.integers(1, 200))
    if kind == 'change':
        for place in rng.integers(0, len(data), int(rng.integers(1, 4))):
            data[place] = rng.integers(256)
    elif kind == 'cut':
        del data[at:]
    elif kind == 'repeat':
        data[at:at] = data[at : at + length] * int(chosen(rng, (1, 1, 50)))
    else:
        data[at : at + length] = bytes(len(data[at : at + length]))
    return bytes(data)


def _strange(rng: np.random.Generator) -> str:
    return str(chosen(rng, NUMBERS if rng.random() < 0.7 else WORDS))


def _word(rng: np.random.Generator, text: str) -> str:
    """A replacement for a word."""
    ends = [i for i, c in enumerate(text) if c in ' \n,[]{}:'] or [0]
    k = int(rng.integers(len(ends)))
    end = ends[k + 1] if k + 1 < len(ends) else len(text)
    return text[: ends[k] + 1] + _strange(rng) + text[end:]


def _less(rng: np.random.Generator, text: str) -> str:
    at = int(rng.integers(len(text) + 1))
    return text[:at] + text[at + int(rng.integers(1, 30)) :]


def _again(rng: np.random.Generator, text: str) -> str:
    lines = text.splitlines(keepends=True) or ['']
    at = int(rng.integers(len(lines)))
    lines[at:at] = [lines[at]] * int(chosen(rng, (1, 1, 2, 300)))
    return ''.join(lines)


def _exchanged(rng: np.random.Generator, text: str) -> str:
    lines = text.splitlines(keepends=True) or ['']
    one = int(rng.integers(len(lines)))
    other = int(rng.integers(len(lines)))
    lines[one], lines[other] = lines[other], lines[one]
    return ''.join(lines)


def _inserted(rng: np.random.Generator, text: str) -> str:
    at = int(rng.integers(len(text) + 1))
    return (
        text[:at]
        + chosen(rng, ('[' * 300, '{a: ' * 50, '\n', '\t', '&x ', '*x ', '!!', '"'))
        + text[at:]
    )


_DAMAGES = (_word, _word, _word, _less, _again, _exchanged, _inserted)
