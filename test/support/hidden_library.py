"""Hides libraries from a test's programs, as if they were not installed."""

from pathlib import Path

import pytest

# Python imports a module of this name at its start.
_START = """
import sys
from importlib.machinery import PathFinder


class Hiding(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        top = name.partition('.')[0]
        hidden = top in {libraries!r} or top.endswith({endings!r})
        return None if hidden else super().find_spec(name, path, target)


sys.meta_path[sys.meta_path.index(PathFinder)] = Hiding
"""
_ROS = ('rclpy', 'ament_index_python', 'rosidl_parser', 'rcl_interfaces', 'builtin_interfaces')


def hide(library: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide a library from Python programs that the test starts later."""
    _write((library,), (), folder, monkeypatch)


def hide_ros(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide ROS 2 and its messages from Python programs that the test starts later."""
    _write(_ROS, ('_msgs',), folder, monkeypatch)
    monkeypatch.delenv('AMENT_PREFIX_PATH', raising=False)


def _write(
    libraries: tuple[str, ...],
    endings: tuple[str, ...],
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    text = _START.format(libraries=libraries, endings=endings)
    (folder / 'sitecustomize.py').write_text(text)
    monkeypatch.setenv('PYTHONPATH', str(folder), prepend=':')
