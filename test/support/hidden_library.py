"""A library hidden from a test's programs, to see what they say where it is not installed."""

from pathlib import Path

import pytest

# Python runs a module of this name when it starts.
_START = """
import sys
from importlib.machinery import PathFinder


class Hiding(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        hidden = name.partition('.')[0] == {library!r}
        return None if hidden else super().find_spec(name, path, target)


sys.meta_path[sys.meta_path.index(PathFinder)] = Hiding
"""


def hide(library: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide a library from the Python programs that the test starts from now on."""
    (folder / 'sitecustomize.py').write_text(_START.format(library=library))
    monkeypatch.setenv('PYTHONPATH', str(folder), prepend=':')
