"""Snapshots of states as NumPy archives: sessions and checkpoints of nodes.

An archive holds the arrays of a state by name, and a label: what it is a state of, and the version
of the format. The class of the state declares the arrays and validates them (`core/snapshot.py`).
"""

import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.snapshot import State
from thinmap_ros.files.npz import read_arrays
from thinmap_ros.files.regular_files import open_regular_file

VERSION = 2
_LABEL = 'thinmap_format'


def write_snapshot(stream: IO[bytes], kind: str, state: State, compress: bool = True) -> None:
    """Write a state; compress: smaller and slower. Raises OSError."""
    arrays: dict[str, Any] = {_LABEL: np.array(_label(kind)), **state}
    (np.savez_compressed if compress else np.savez)(stream, **arrays)


def read_snapshot(stream: IO[bytes], kind: str) -> dict[str, NDArray[Any]]:
    """Read a state of a kind.

    Raises InputError where it is no archive within the limits of `read_arrays`, of another kind or
    version; OSError as the stream.
    """
    expected = f'expected a saved {kind}'
    try:
        arrays = read_arrays(stream)
    except InputError as error:
        raise InputError(f'{error}: {expected}') from error
    label = arrays.pop(_LABEL, np.empty(0))
    if label.shape or label.dtype.kind != 'U' or str(label) != _label(kind):
        raise InputError(f'holds {quoted(str(label))}: {expected} ({_label(kind)})')
    return arrays


def is_snapshot(file: Path) -> bool:
    """Whether a file is a saved state of any kind and version, by the name of its label."""
    try:
        with open_regular_file(file) as stream, zipfile.ZipFile(stream) as archive:
            return f'{_LABEL}.npy' in archive.NameToInfo
    except (OSError, ValueError, zipfile.BadZipFile):
        return False


def _label(kind: str) -> str:
    return f'{kind} {VERSION}'
