"""Atomic writing of files (temporary file, then rename), and reading of texts up to a limit."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from glob import escape
from pathlib import Path

from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.files.limits import FILES
from thinmap_ros.files.regular_files import open_regular_file

_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to; it replaces `path` when the block succeeds.

    If the block fails, the temporary file is deleted. Its name cannot be guessed and the file is
    new: no link can be planted there. Raises OSError with the name of `path` on write errors.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f'.{path.name}.{secrets.token_hex(8)}.part')
    try:
        os.close(os.open(aside, _NEW_FILE, 0o666))
        yield aside
        aside.replace(path)
    except OSError as error:
        if error.filename is not None and error.filename != str(aside):
            raise
        raise OSError(error.errno, error.strerror or one_line_reason(error), str(path)) from error
    finally:
        aside.unlink(missing_ok=True)


def partial_files(path: Path) -> list[Path]:
    """Partial files beside a file, left by an `atomic_write` that was killed."""
    return sorted(path.parent.glob(f'.{escape(path.name)}.*.part'))


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_write(path) as aside:
        aside.write_text(text, encoding='utf-8')


def read_text(path: Path, max_bytes: int = FILES.text_bytes) -> str:
    """Read a text file. Raises InputError if it is missing, not text, or above max_bytes."""
    try:
        with open_regular_file(path) as stream:
            content = stream.read(max_bytes + 1)
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        raise InputError(f'{path}: {getattr(error, "strerror", None) or error}') from error
    if len(content) > max_bytes:
        raise InputError(f'{path}: expected at most {max_bytes} bytes')
    try:
        return content.decode('utf-8').replace('\r\n', '\n')
    except UnicodeDecodeError as error:
        raise InputError(
            f'{path}: byte {error.start}: {error.reason}: expected a text file'
        ) from error
