"""docs/reference lists messages, options of programs, and public Python names as they are.

scripts/generate rewrites the pages.
"""

import os
import re
import sys
from importlib import import_module

import pytest
from support.node_list import ROOT

import thinmap_ros
from thinmap_ros.__main__ import PROGRAMS

FOLDER = ROOT / 'docs' / 'reference'
HEADING = """# Messages

Made from `thinmap_msgs`; do not edit (see `test/docs/test_reference_pages.py`). Frames and units follow REP 103 and REP 105.
A unit in a name (`_m`, `_s`, `_rad`) is that of the field. [Nodes](nodes.md) lists the topics and services of each type.
"""  # noqa: E501
KINDS = {'msg': 'Messages', 'srv': 'Services', 'action': 'Actions'}
PARTS = {'msg': ('',), 'srv': ('Request', 'Response'), 'action': ('Goal', 'Result', 'Feedback')}
UNITS = ('m', 'm2', 's', 'ms', 'rad', 'deg')
UNIT_OF_COMMENT = re.compile(rf'(^|, )({"|".join(UNITS)})(?=$|,)|\((%)\)')

PROGRAMS_HEADING = """# Programs

Made from the programs themselves; do not edit (see `test/docs/test_reference_pages.py`).

| installation | command |
|---|---|
| ROS 2 workspace | `ros2 run thinmap_ros PROGRAM` (instead of `nodes`: `thinmap`) |
| `pip install` | `thinmap PROGRAM` |

The exit code is 0 after success, 2 after an error in the input, 130 after Ctrl-C and 141 once
nobody reads what is printed (`| head`). One line on the error stream describes the error.

"""


def table(head, rows):
    lines = [f'| {" | ".join(cells)} |' for cells in (head, ['---'] * len(head), *rows)]
    return ['\n'.join(lines), '']


def unit_of(name, comment):
    """Unit of a field: in its comment, else the end of its name."""
    found = UNIT_OF_COMMENT.search(comment)
    ending = name.rpartition('_')[2]
    if found:
        return found[2] or found[3]
    return ending if ending in UNITS and '_' in name else ''


def described(comment, unit):
    """A comment without its unit."""
    words = [word for word in comment.split(', ') if word != unit]
    return ', '.join(words).replace(' (%)', '')


def definition(text):
    """Constants and fields of one part of a message file, as tables."""
    constants = []
    fields = []
    for line in filter(None, text.splitlines()):
        code, _, comment = (part.strip() for part in line.partition('#'))
        if '=' in code:
            name, value = re.fullmatch(r'\w+ (\w+) = (\S+)', code).groups()
            constants.append((f'`{name}`', value, comment))
        elif code:
            kind, name = code.split()
            unit = unit_of(name, comment)
            fields.append((f'`{name}`', f'`{kind}`', unit, described(comment, unit)))
    return [
        *(table(('constant', 'value', 'description'), constants) if constants else ()),
        *(table(('field', 'type', 'unit', 'description'), fields) if fields else ()),
    ]


def section(path):
    """A message, service or action; the comment in its first lines is what it is."""
    text = path.read_text().strip()
    lines = [f'### {path.stem}', '']
    comment = re.match(r'(#.*\n)+', text)
    if comment:
        lines += [re.sub('^# ?', '', line) for line in comment[0].splitlines()] + ['']
        text = text[comment.end() :]
    for name, part in zip(
        PARTS[path.suffix[1:]], re.split('^---$', text, flags=re.MULTILINE), strict=True
    ):
        lines += [f'*{name}*', ''] if name else []
        lines += definition(part)
    return lines


def messages_page():
    lines = [HEADING]
    for folder, title in KINDS.items():
        lines += [f'## {title}', '']
        for path in sorted((ROOT / 'thinmap_msgs' / folder).iterdir()):
            lines += section(path)
    return '\n'.join(lines)


def compare(name, text):
    page = FOLDER / name
    if 'THINMAP_WRITE_CONFIG' in os.environ:
        page.write_text(text)
    assert page.read_text() == text, f'{name}: see the top of {__file__} for how to regenerate it'


def test_the_page_lists_the_messages():
    compare('messages.md', messages_page())


def test_units_are_found_in_comments_and_names():
    assert unit_of('width_m', 'free width there') == 'm'
    assert unit_of('position', "m, in the map's frame") == 'm'
    assert unit_of('data', 'probability of occupancy (%), row by row') == '%'
    assert unit_of('m', 'counted') == ''


@pytest.fixture
def help_of(monkeypatch, capsys):
    """What a program prints for --help, 80 columns wide."""
    monkeypatch.setenv('COLUMNS', '80')

    def read(name, program):
        monkeypatch.setattr(sys, 'argv', ['thinmap' if 'nodes' in name else name, '--help'])
        try:
            import_module(f'{thinmap_ros.__name__}.{program.module}').main()
        except SystemExit as end:
            assert not end.code, name
        return capsys.readouterr().out.strip()

    return read


def test_the_page_lists_the_options_of_the_programs(help_of):
    rows = [
        (f'[`{name}`](#{name})', program.summary, 'yes' if program.needs_ros else 'no')
        for name, program in PROGRAMS.items()
    ]
    lines = table(('program', 'task', 'needs ROS 2'), rows)
    for name, program in PROGRAMS.items():
        lines += [f'## {name}', '', '```', help_of(name, program), '```', '']
    compare('programs.md', PROGRAMS_HEADING + '\n'.join(lines))


def test_the_page_lists_the_public_names():
    text = (FOLDER / 'python_api.md').read_text()
    assert sorted(re.findall(r'^::: thinmap_ros\.(\w+)$', text, re.MULTILINE)) == sorted(
        thinmap_ros.__all__
    )
