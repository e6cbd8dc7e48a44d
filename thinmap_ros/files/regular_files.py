"""Opens files of any origin for reading: regular ones only, as others block or never end."""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

_READ_ONLY = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK
_KINDS = {
    stat.S_IFIFO: 'a named pipe',
    stat.S_IFSOCK: 'a socket',
    stat.S_IFCHR: 'a device',
    stat.S_IFBLK: 'a device',
    stat.S_IFDIR: 'a directory',
}


@contextmanager
def open_regular_file(path: Path, flags: int = 0) -> Iterator[BinaryIO]:
    """Open a regular file for reading, symbolic links followed.

    flags: additional ones for os.open, such as O_NOFOLLOW.
    Raises OSError as open, and where it is no regular file: a pipe, a socket or a device is refused
    before it is opened.
    """
    require_regular_file(path)
    # It may have been replaced meanwhile: a pipe is opened without waiting for a writer.
    number = os.open(path, _READ_ONLY | flags)
    with os.fdopen(number, 'rb') as stream:
        _require_regular(path, os.fstat(number))
        yield stream


def require_regular_file(path: Path) -> None:
    """Raise OSError where a path names no regular file, or nothing; nothing is opened."""
    _require_regular(path, path.stat())


def _require_regular(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        kind = _KINDS.get(stat.S_IFMT(status.st_mode), 'a special file')
        raise OSError(errno.EINVAL, f'{kind}: expected a regular file', str(path))
