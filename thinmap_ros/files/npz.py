"""Reads NumPy archives (.npz) of any origin: the size of each array is checked before it is read.

Members may be compressed a thousandfold, and the header of an array may declare any size. Sizes are
therefore summed first, and each declared size is compared with that of its member. The limits are
above the largest map of thinmap: 512 MiB in total, 64 arrays.
"""

import math
import zipfile
from typing import IO, Any

from numpy.lib import format as npy
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError, ThinmapError, one_line_reason, quoted
from thinmap_ros.files.limits import FILES

_ENDING = '.npy'
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_READERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def read_arrays(stream: IO[bytes]) -> dict[str, NDArray[Any]]:
    """Read all arrays of an archive, by name.

    Raises InputError if it is no archive of plain arrays (no pickled objects), or exceeds the
    limits; OSError as the stream.
    """
    try:
        with zipfile.ZipFile(stream) as archive:
            members = archive.infolist()
            _check_sizes(members)
            return {_name_of(member): _read(archive, member) for member in members}
    except (OSError, ThinmapError):
        raise
    except Exception as error:  # zlib and NumPy raise many types for corrupt files
        raise InputError(one_line_reason(error)) from error


def _check_sizes(members: list[zipfile.ZipInfo]) -> None:
    names = {member.filename for member in members}
    if len(members) > FILES.npz_arrays or len(names) < len(members):
        expected = f'expected at most {FILES.npz_arrays}, each once'
        raise InputError(f'{len(members)} arrays of {len(names)} names: {expected}')
    size = sum(member.file_size for member in members)
    if size > FILES.npz_bytes:
        raise InputError(f'{size} bytes decompressed: expected at most {FILES.npz_bytes}')
    for member in members:
        if not member.filename.endswith(_ENDING) or member.compress_type not in _METHODS:
            raise InputError(f'{quoted(member.filename)}: expected an array, stored or deflated')


def _name_of(member: zipfile.ZipInfo) -> str:
    return member.filename.removesuffix(_ENDING)


def _read(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(member) as stream:
        _check_header(stream, member)
    with archive.open(member) as stream:
        array: NDArray[Any] = npy.read_array(stream, allow_pickle=False)
        return array


def _check_header(stream: IO[bytes], member: zipfile.ZipInfo) -> None:
    """Raise InputError unless the size of a member is that of its header."""
    version = npy.read_magic(stream)
    if version not in _READERS:
        raise InputError(f'{quoted(member.filename)}: version {version}: expected 1.0 or 2.0')
    shape, _, dtype = _READERS[version](stream)
    declared = math.prod(shape) * dtype.itemsize
    actual = member.file_size - stream.tell()
    if min(shape, default=0) < 0 or dtype.itemsize == 0 or declared != actual:
        found = f'{quoted(shape)} of {quoted(str(dtype))}'
        raise InputError(f'{quoted(member.filename)}: {found}: expected an array of {actual} bytes')
