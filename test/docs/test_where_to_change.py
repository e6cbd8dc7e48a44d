"""The page of changes names files, names and tests that exist, and few files for each change."""

import re

import pytest
from support.node_list import ROOT

PAGE = ROOT / 'docs' / 'development' / 'where_to_change.md'
PACKAGE = ROOT / 'thinmap_ros'
MAX_FILES = 3
ROWS = [
    [cell.strip() for cell in line.strip('| ').split(' | ')]
    for line in PAGE.read_text().splitlines()
    if line.startswith('| ') and '`' in line
]
IDS = [row[0] for row in ROWS]
_QUOTED = re.compile(r'`([^`]+)`')


def place(name):
    """File or folder that the page names, or None."""
    found = [folder / name for folder in (PACKAGE, ROOT) if (folder / name).exists()]
    return found[0] if found else None


def text_of(path):
    files = [path] if path.is_file() else sorted(path.iterdir())
    return '\n'.join(file.read_text() for file in files if file.is_file())


@pytest.mark.parametrize('row', ROWS, ids=IDS)
def test_files_and_the_names_in_them_exist(row):
    _, where, _ = row
    count = 0
    for part in where.split(';'):
        quoted = _QUOTED.findall(part)
        paths = [name for name in quoted if '/' in name or name.endswith('.py')]
        places = [place(name) for name in paths]
        assert None not in places, paths
        count += len(places)
        names = [name for name in quoted if name not in paths]
        known = '\n'.join(text_of(path) for path in places)
        missing = [n for n in names if not re.search(rf'(?<!\w){re.escape(n)}(?!\w)', known)]
        assert not missing, part
    assert 1 <= count <= MAX_FILES, where


@pytest.mark.parametrize('row', ROWS, ids=IDS)
def test_the_test_of_a_change_exists(row):
    (name,) = _QUOTED.findall(row[2])
    assert (ROOT / 'test' / name).is_file()


def test_the_page_answers_what_people_ask():
    assert len(ROWS) >= 20
    assert len(set(IDS)) == len(ROWS)
