"""The key of the stage `bounds` of scripts/test: all that its result depends on, as one word.

It runs the same examples each time, so that a text that has passed on a machine passes again.
"""

import hashlib
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from support.imports import imported

# Besides what the tests import: how they are run, with which libraries, and in which worlds.
_BESIDE = ('pyproject.toml', 'scripts/test', 'requirements/*', 'worlds/*')


def bounds_key(root: Path) -> str:
    """Word for the text of the core, of its tests, and of what they need."""
    tests = [root / 'test' / 'conftest.py', *(root / 'test' / 'core').rglob('*.py')]
    files = _with_imported(root, tests).union(*(root.glob(each) for each in _BESIDE))
    together = hashlib.sha256(sys.version.encode())
    # Without the real worlds, which do not change, their tests are skipped.
    together.update(str(any((up / 'shared' / 'data').exists() for up in root.parents)).encode())
    for file in sorted(files):
        together.update(f'{file.relative_to(root)} {file.stat().st_size}\n'.encode())
        together.update(file.read_bytes())
    return together.hexdigest()[:16]


def _with_imported(root: Path, files: Iterable[Path]) -> set[Path]:
    """Files, all that they import, and what that imports."""
    known: set[Path] = set()
    waiting = set(files)
    while waiting:
        known |= waiting
        waiting = {found for file in waiting for found in _needed(root, file)} - known
    return known


def _needed(root: Path, file: Path) -> Iterator[Path]:
    for found in imported(root, file):
        yield found
        yield from (up / '__init__.py' for up in found.parents if (up / '__init__.py').exists())


if __name__ == '__main__':
    print(bounds_key(Path(__file__).resolve().parents[2]))
