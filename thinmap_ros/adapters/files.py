"""Files that are whole or not there (written aside, then renamed), and YAML checked at the door."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from thinmap_ros.core.errors import InputError


@contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """Give a path to write to: it takes the place of `path` when the block ends well and vanishes when not.

    Raises OSError, with the name of the file, where the disk does not take it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f'.{path.name}.{os.getpid()}.part')
    try:
        yield aside
        aside.replace(path)
    except OSError as error:
        if error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        aside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with written_aside(path) as aside:
        aside.write_text(text, encoding='utf-8')


def read_text(path: Path) -> str:
    """Read a text file. Raises InputError where there is none, or it is no text."""
    try:
        return path.read_text(encoding='utf-8')
    except OSError as error:
        raise InputError(f'{path}: {error.strerror or error}') from error
    except UnicodeDecodeError as error:
        raise InputError(f'{path}: byte {error.start}: {error.reason}: expected a text file') from error


def read_yaml(path: Path, expected: str) -> dict[str, Any]:
    """Read a YAML file that holds keys and values. Raises InputError naming the file and what was expected."""
    text = read_text(path)
    try:
        content = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError) as error:
        # ValueError: a date such as 2001-99-99.
        raise InputError(f'{path}: {" ".join(str(error).split())}: expected {expected}') from error
    if not isinstance(content, dict):
        raise InputError(f'{path}: expected {expected}')
    return content
