"""Folders that only this user can read and write."""

import os
import stat
import tempfile
from pathlib import Path

_MODE = stat.S_IRWXU
_OF_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def private_folder(folder: Path) -> Path:
    """Return the folder, created if missing.

    Raises OSError if it is a link, belongs to another user, or is accessible to others.
    """
    try:
        folder.mkdir(mode=_MODE, parents=True, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise OSError(f'{folder}: {error.strerror}: expected a folder') from error
    if not stat.S_ISDIR(status.st_mode):
        raise OSError(f'{folder}: expected a folder, not a link or a file')
    if status.st_uid != os.getuid():
        raise OSError(f'{folder}: owned by user {status.st_uid}: expected a folder of this user')
    if status.st_mode & _OF_OTHERS:
        mode = stat.S_IMODE(status.st_mode)
        raise OSError(f'{folder}: mode {mode:o}: expected {_MODE:o}, closed to other users')
    return folder


def temporary_folder() -> Path:
    """Path of this user's folder among the temporary files; it may not exist yet."""
    return Path(tempfile.gettempdir()) / f'thinmap-{os.getuid()}'
