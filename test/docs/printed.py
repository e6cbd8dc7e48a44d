"""Printed text in the documentation, and whether a program prints the same.

A block fenced as text, or as json, holds what the code block before it prints: commands in bash, or
Python. Each of its lines must be printed, in this order; others may come between them. `...` stands
for the rest of a line, or for lines. Numbers agree within `SHARE`, or by one unit of their last
decimal; `<!-- printed within 25 % -->` before a block gives another share, as of a simulation,
which is chaotic, and `<!-- printed with other numbers -->` none, as of rates on a busy machine.
Times of computing, as `in 20.6 s` and `5.2 ms`, stamps of logs and folders of paths are not
compared.
`<!-- printed to FILE -->` names the file that a json block is the begin of, and
`<!-- printed as a message -->` marks what is printed in a case that no command of the page makes:
test_printed.py makes it.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SHARE = 0.02
_MARK = re.compile(
    r'<!-- printed (as a message )?(?:to (\S+) )?(?:within (\d+) % |(with other numbers) )?-->'
)
_NUMBER = re.compile(r'(?<![\w.])-?\d+(?:,\d{3})*(?:\.\d*)?(?:e-?\d+)?')
_TIME = re.compile(r'\bin [\d.]+ s\b|\b[\d.]+ ms\b')
_FOLDER = re.compile(r'(?<![\w./])/(?:[\w.-]+/)+')
_STAMP = re.compile(r'^(\[\w+\]) \[[\d.]+\]')  # of a line of a node's log
_KINDS = ('text', 'json')


@dataclass(frozen=True)
class Printed:
    """A block of printed text.

    line: of its fence, from 1; of: the language and the line of the code block before it, in the
    same section. file: that it is the begin of; share: by which numbers may differ; is_message:
    whether no command of the page prints it.
    """

    document: str
    line: int
    kind: str
    text: str
    of: tuple[str, int] | None
    file: str
    share: float
    is_message: bool

    @property
    def name(self) -> str:
        """Where it is."""
        return f'{self.document}:{self.line}'

    def is_in(self, said: str) -> bool:
        """Whether a program that said this has printed the block."""
        return not self.missing(said)

    def missing(self, said: str) -> str:
        """The first line of the block that was not printed after those before it; '' for none."""
        printed = iter(said.splitlines())
        for wanted in self.text.splitlines():
            if not any(_agree(wanted, line, self.share) for line in printed):
                return wanted
        return ''

    def is_begin_of(self, content: dict[str, Any]) -> bool:
        """Whether the block, in json, is the begin of a file's content."""
        return _is_part(json.loads(self.text), content, self.share)


def blocks(path: Path) -> list[Printed]:
    """All blocks of printed text of a document, in order."""
    found = []
    mark = before = None
    lines = path.read_text().splitlines()
    number = 0
    while number < len(lines):
        line = lines[number].strip()
        number += 1
        if not line.startswith('```'):
            mark = _MARK.fullmatch(line) or (mark if not line else None)
            before = None if line.startswith('## ') else before
            continue
        end = next(k for k in range(number, len(lines)) if lines[k].strip() == '```')
        kind = line.removeprefix('```') or 'bash'
        if kind in _KINDS:
            text = '\n'.join(lines[number:end])
            message, file, within, other = mark.groups() if mark else (None,) * 4
            share = float('inf') if other else float(within) / 100.0 if within else SHARE
            is_message = message is not None
            found.append(
                Printed(path.name, number, kind, text, before, file or '', share, is_message)
            )
        elif kind in ('bash', 'python'):
            before = (kind, number)
        mark = None
        number = end + 1
    return found


def _agree(wanted: str, line: str, share: float) -> bool:
    """Whether a printed line is the wanted one, but for numbers that are nearly the same."""
    wanted_text, wanted_numbers = _parts(wanted)
    text, numbers = _parts(line)
    if wanted_text.endswith('...'):
        beginning = wanted_text.removesuffix('...').rstrip()
        text = text[: len(beginning)] if text.startswith(beginning) else ''
        wanted_text = beginning
        numbers = numbers[: len(wanted_numbers)]
    if wanted_text != text or len(wanted_numbers) != len(numbers):
        return False
    pairs = zip(wanted_numbers, numbers, strict=True)
    return all(_are_near(first, second, share) for first, second in pairs)


def _parts(line: str) -> tuple[str, list[str]]:
    """A line without its numbers, times and folders, and its numbers."""
    plain = _FOLDER.sub('/', _TIME.sub('TIME', _STAMP.sub(r'\1', line)))
    return ' '.join(_NUMBER.sub('#', plain).split()), _NUMBER.findall(plain)


def _are_near(wanted: str, number: str, share: float) -> bool:
    first = float(wanted.replace(',', ''))
    second = float(number.replace(',', ''))
    decimals = len(wanted.partition('e')[0].partition('.')[2])
    unit = 10.0**-decimals if decimals else 0.0
    return abs(first - second) <= max(share * abs(first), 1.001 * unit)


def _is_part(wanted: Any, value: Any, share: float) -> bool:
    if isinstance(wanted, dict) and isinstance(value, dict):
        return all(key in value and _is_part(wanted[key], value[key], share) for key in wanted)
    if isinstance(wanted, float) and isinstance(value, float):
        return _are_near(str(wanted), str(value), share)
    if isinstance(wanted, bool | str):
        return bool(wanted == value)
    return isinstance(value, int) and abs(wanted - value) <= share * wanted
