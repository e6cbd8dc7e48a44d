"""Libraries hidden from a test's programs, to see what they say where they are not installed."""

from pathlib import Path

import pytest

# Python runs a module of this name when it starts.
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
    """Hide a library from the Python programs that the test starts from now on."""
    _write((library,), (), folder, monkeypatch)


def hide_ros(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide ROS 2 and its messages from the Python programs that the test starts from now on."""
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
