"""The line that states commit and machine of a measurement."""

import os
import re
import subprocess
from pathlib import Path

import pytest

from thinmap_ros.evaluation.parallel_jobs import commit, provenance, write_provenance

IDENTITY = {
    f'GIT_{who}_{what}': 'x' for who in ('AUTHOR', 'COMMITTER') for what in ('NAME', 'EMAIL')
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    source = tmp_path / 'thinmap_ros' / 'evaluation' / 'machine.py'
    page = tmp_path / 'docs' / 'page.md'
    for file in (source, page):
        file.parent.mkdir(parents=True)
        file.write_text('first\n')
    return tmp_path


def git(tree: Path, *words: str) -> None:
    environment = {**os.environ, **IDENTITY}
    subprocess.run(['git', '-C', tree, *words], check=True, capture_output=True, env=environment)


@pytest.mark.programs
def test_the_commit_is_marked_if_the_tree_has_changes(tree: Path) -> None:
    assert commit(tree) == ''
    git(tree, 'init')
    assert commit(tree) == ''
    git(tree, 'add', '.')
    git(tree, 'commit', '-m', 'first')
    assert re.fullmatch('[0-9a-f]{7,}', commit(tree))
    (tree / 'docs' / 'page.md').write_text('second\n')
    assert re.fullmatch('[0-9a-f]{7,}', commit(tree))
    (tree / 'thinmap_ros' / 'evaluation' / 'machine.py').write_text('second\n')
    assert re.fullmatch('[0-9a-f]{7,} with local changes', commit(tree))


@pytest.mark.programs
def test_a_folder_of_results_keeps_the_line_of_its_run(tmp_path: Path) -> None:
    assert re.search(r', \d+ cores, Python 3\.', provenance(tmp_path))
    assert '\n' not in provenance()
    write_provenance(tmp_path)
    assert provenance(tmp_path) == provenance()
    (tmp_path / 'provenance.txt').write_text(
        'Commit 1234567, a processor, 2 cores, Python 3.12.3\n'
    )
    assert provenance(tmp_path) == 'Commit 1234567, a processor, 2 cores, Python 3.12.3'
