"""Command lines in the documentation.

Each line of a code block is a command, and so is each code span in the text that starts like one.
A block fenced as anything but bash is none: output (`printed.py`), YAML, or Python, which
`python_blocks` gives.
`<!-- not run -->` on a line before a block or paragraph, or in front of a span, marks it.
"""

import re
from dataclasses import dataclass
from pathlib import Path

MARK = '<!-- not run -->'
PYTHON = '```python'
_FENCES = ('```', '```bash')  # of commands
_SPAN = re.compile(rf'({re.escape(MARK)}\s+)?`([^`]+)`')
_WHOLE = re.compile(
    r'ros2 (run \S+ \S+|-h|(topic|service|action|param|lifecycle|node|pkg|interface) \S+)'
    r'|scripts/\S+|(source|export|rosbags-convert|\S+/pip) \S+'
)
_CODE_INDENT = 4


@dataclass(frozen=True)
class Command:
    """One command, its position in the document, and whether it is marked as not run.

    line: of the fence of its code block, from 1; 0 of a command in the text.
    """

    document: str
    section: str
    text: str
    marked: bool
    line: int = 0


@dataclass
class _Part:
    """A block of code or a paragraph of text."""

    section: str
    is_code: bool
    marked: bool
    lines: list[str]
    line: int


def commands(path: Path) -> list[Command]:
    """All commands of a document, in order."""
    found = []
    for part in _parts(path.read_text().splitlines()):
        lines = _of_code(part.lines) if part.is_code else _of_text(part.lines)
        for text, marked in lines:
            is_marked = marked or part.marked
            found.append(Command(path.name, part.section, text, is_marked, part.line))
    return found


def marks(path: Path) -> int:
    """Number of marks in a document."""
    return path.read_text().count(MARK)


def python_blocks(path: Path) -> dict[int, str]:
    """Blocks of a document that are fenced as Python, by the lines of their fences, in order."""
    text = path.read_text()
    found = re.finditer(rf'^{PYTHON}\n(.*?)^```$', text, re.MULTILINE | re.DOTALL)
    return {text[: match.start()].count('\n') + 1: match[1] for match in found}


def _parts(lines: list[str]) -> list[_Part]:
    parts: list[_Part] = []
    section = ''
    marked = False
    fenced = False
    is_skipped = False
    open_part: _Part | None = None
    fence = 0
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if text.startswith('```'):
            fenced = not fenced
            is_skipped = fenced and text not in _FENCES
            fence = number if fenced else 0
            open_part = None
            continue
        if is_skipped:
            continue
        if not fenced and (not text or text == MARK):
            marked = marked or text == MARK
            open_part = None
            continue
        if not fenced and line.startswith('#'):
            section = line.lstrip('# ')
            open_part = None
            continue
        if open_part is None:
            is_code = fenced or line.startswith(' ' * _CODE_INDENT)
            open_part = _Part(section, is_code, marked, [], fence)
            parts.append(open_part)
            marked = False
        open_part.lines.append(line)
    return parts


def _of_code(lines: list[str]) -> list[tuple[str, bool]]:
    joined = '\n'.join(line.strip() for line in lines).replace('\\\n', '\\\n  ')
    texts = re.split(r'(?<!\\)\n', joined)
    return [(text, False) for text in texts if text and not text.startswith('#')]


def _of_text(lines: list[str]) -> list[tuple[str, bool]]:
    found = []
    for mark, span in _SPAN.findall(' '.join(line.strip() for line in lines)):
        if _WHOLE.match(span):
            found.append((span, bool(mark)))
    return found
