"""Printed text of the documents: how it is found and compared, and messages that no command makes.

test_documented_commands.py compares what is printed by the commands and the Python of the pages.
"""

import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.carmen_log import carmen_lines

from docs import printed
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.slam.joining.team import MapLink
from thinmap_ros.files.merging import CannotTellError, NotTheSamePlaceError, merge_maps
from thinmap_ros.files.occupancy_maps import write_map
from thinmap_ros.kernels import progress_text

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / 'README.md', *sorted((ROOT / 'docs').glob('tutorials/*.md'))]
PAGES += sorted((ROOT / 'docs').glob('how_to/*.md'))
PAGE = """# Page

## One

```bash
thinmap a
```

```text
a: 100 scans, 24.2 m in 3.3 s
...: 5.2 ms, odds 2,259
```

<!-- printed to out/x.json within 25 % -->

```json
{"n": 4, "x": {"0.90": 2.0}}
```

```python
print(1)
```

<!-- printed with other numbers -->

```text
1
```

## Two

<!-- printed as a message -->

```text
/home/me/maps/office.pgm
```
"""


def replayed(*words: str) -> str:
    command = [sys.executable, '-m', 'thinmap_ros', 'replay', *words]
    return subprocess.run(command, capture_output=True, text=True).stderr.splitlines()[-1]


def two_recordings() -> str:
    lines = carmen_lines()
    Path('some.log').write_text('\n'.join(lines[:41] + lines[21:]))
    return replayed('some.log', '-o', 'out/mine', '--quiet')


def not_merged() -> str:
    places = [np.array([1.12, -0.76, 0.07]), np.array([1.71, -10.55, -1.41])]
    no = NotTheSamePlaceError('maps/west', -12.8)
    perhaps = CannotTellError('maps/room', math.log(2259.0), 1e5, places)
    return f'{no}\n{perhaps}'


def two_storeys() -> str:
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), np.zeros((20, 20), dtype=np.int8))
    write_map('maps/a', patch, 'floor_1')
    write_map('maps/b', patch, 'floor_2')
    with pytest.raises(NotTheSamePlaceError) as raised:
        merge_maps(['maps/a', 'maps/b'])
    return str(raised.value)


def joined() -> str:
    map_joiner = pytest.importorskip('thinmap_ros.nodes.map_joiner')
    pose = np.array([15.05, 9.17, -0.153])
    return map_joiner.link_text(MapLink('/robot1', '/robot2', pose, np.eye(3), 109.5, 80), True)


def first_start() -> str:
    return f'thinmap: {progress_text(0, 0, 0.0)}'


MESSAGES: dict[str, Callable[[], str]] = {
    'thinmap replay: error: clock jumped back': two_recordings,
    'thinmap replay: error: bags/nothing.mcap': lambda: replayed('bags/nothing.mcap', '-o', 'x'),
    'maps/west: not the same place': not_merged,
    'maps/b: another storey': two_storeys,
    '/robot2 is joined with /robot1': joined,
    'thinmap: compiling kernels, once: ': first_start,
}


@pytest.mark.parametrize(
    'begin',
    [
        pytest.param(begin, marks=[pytest.mark.programs] if 'replay' in begin else [])
        for begin in MESSAGES
    ],
)
def test_a_message_of_the_pages_is_what_is_printed(
    begin: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('PYTHONPATH', str(ROOT), prepend=':')
    (block,) = [b for path in PAGES for b in printed.blocks(path) if b.text.startswith(begin)]
    said = MESSAGES[begin]()
    assert block.is_in(said), said
    assert len(block.text.splitlines()) == len(said.splitlines())


def test_each_message_of_the_pages_is_made_here() -> None:
    texts = [b.text for path in PAGES for b in printed.blocks(path) if b.is_message]
    assert len(texts) == len(MESSAGES)
    assert all(text.startswith(tuple(MESSAGES)) for text in texts)


@pytest.fixture
def page(tmp_path: Path) -> list[printed.Printed]:
    (tmp_path / 'page.md').write_text(PAGE)
    return printed.blocks(tmp_path / 'page.md')


def test_blocks_belong_to_the_code_before_them(page: list[printed.Printed]) -> None:
    found = [(b.line, b.kind, b.of, b.file, b.share, b.is_message) for b in page]
    assert found == [
        (9, 'text', ('bash', 5), '', printed.SHARE, False),
        (16, 'json', ('bash', 5), 'out/x.json', 0.25, False),
        (26, 'text', ('python', 20), '', math.inf, False),
        (34, 'text', None, '', printed.SHARE, True),
    ]


@pytest.mark.parametrize(
    ('said', 'missing'),
    [
        ('a: 100 scans, 24.2 m in 3.3 s\nb: 9.1 ms, odds 2,259', '...'),
        ('x\na: 101 scans, 24.6 m in 9 s\n...: 1 ms, odds 2,300\ny', ''),
        ('a: 103 scans, 24.2 m in 3.3 s\n...: 1 ms, odds 2,259', 'a: 100'),
        ('a: 100 scans, 24.9 m in 3.3 s\n...: 1 ms, odds 2,259', 'a: 100'),
        ('a: 100 scans, 24.2 m in 3.3 s\n...: 1 ms, odds 2,359', '...'),
        ('a: 100 poses, 24.2 m in 3.3 s', 'a: 100'),
        ('a: 100 scans, 24.2 m, 3 in 3.3 s', 'a: 100'),
        ('...: 1 ms, odds 2,259\na: 100 scans, 24.2 m in 3.3 s', '...'),
    ],
)
def test_other_numbers_lines_and_orders_are_found(
    page: list[printed.Printed], said: str, missing: str
) -> None:
    assert page[0].missing(said).startswith(missing)
    assert bool(page[0].missing(said)) == bool(missing)


def test_dots_stand_for_the_rest(tmp_path: Path) -> None:
    (tmp_path / 'page.md').write_text('```text\n| 3 | x ...\n...\n```\n')
    (block,) = printed.blocks(tmp_path / 'page.md')
    assert block.is_in('| 3 | x, 7 | 8\nmore')
    assert not block.is_in('| 4 | x, 7 | 8\nmore')
    assert not block.is_in('| 3 | y, 7 | 8\nmore')


def test_one_unit_of_the_last_decimal_is_no_difference(tmp_path: Path) -> None:
    (tmp_path / 'page.md').write_text('```text\n[0.03 1.57]\n```\n')
    (block,) = printed.blocks(tmp_path / 'page.md')
    assert block.is_in('[0.04 1.57]') and block.is_in('[0.02 1.58]')
    assert not block.is_in('[0.05 1.57]') and not block.is_in('[-0.03 1.57]')


def test_the_begin_of_a_file_may_differ_by_the_share(page: list[printed.Printed]) -> None:
    assert page[1].is_begin_of({'n': 4, 'x': {'0.90': 2.4, '0.95': 3.0}, 'more': 1})
    for other in ({'n': 6, 'x': {'0.90': 2.0}}, {'n': 4, 'x': {'0.90': 2.6}}, {'n': 4, 'x': {}}):
        assert not page[1].is_begin_of(other)


def test_a_number_of_another_share_and_a_folder_of_a_path_do_not_count(
    page: list[printed.Printed],
) -> None:
    assert page[2].is_in('7') and not page[2].is_in('x')
    assert page[3].is_in('/tmp/a/office.pgm') and not page[3].is_in('/tmp/a/other.pgm')
