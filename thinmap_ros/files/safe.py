"""Files read within limits and written as a whole: texts, YAML, arrays, states."""

import errno
import math
import os
import re
import secrets
import signal
import stat
import threading
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import IO, Any, BinaryIO, ClassVar

import numpy as np
import yaml
from numpy.lib import format as npy
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError, ThinmapError, one_line_reason, quoted
from thinmap_ros.core.snapshot import State


@dataclass(frozen=True)
class FileLimits:
    """Limits of maps, graphs, worlds, sessions and configuration files. Sizes in bytes.

    A larger file is refused before it fills the memory; the readers name the limit.
    """

    text_bytes: int = 1 << 30
    yaml_bytes: int = 4 << 20
    yaml_nodes: int = 100_000  # values, lists and mappings
    yaml_levels: int = 20
    npz_bytes: int = 512 << 20  # decompressed
    npz_arrays: int = 64
    image_pixels: int = 1 << 28  # each needs up to 24 bytes while a graph is built
    image_side: int = 1 << 14
    image_header_bytes: int = 1 << 20
    image_comments: int = 100  # of a netpbm image whose pixels are written as text
    world_cells: int = 100_000_000
    digits: int = 100  # of a number
    name_length: int = 200
    path_length: int = 1000


@dataclass(frozen=True)
class LogLimits:
    """Limits of bags and logs of sensor data, as `FileLimits`."""

    file_bytes: int = 32 << 30  # decompressed
    file_ratio: int = 200  # of decompressed to compressed bytes, beyond `small_file_bytes`
    small_file_bytes: int = 256 << 20
    line_bytes: int = 4 << 20  # of a text log
    lines: int = 1 << 23  # a day of odometry at 97 Hz
    chunk_bytes: int = 256 << 20  # uncompressed, and any other record
    summary_bytes: int = 64 << 20
    definitions_bytes: int = 64 << 20  # schemas and channels, all together
    definitions: int = 1 << 16
    schema_bytes: int = 1 << 20
    schema_fields: int = 8000  # with those of nested types, each time; and lines
    buffered_bytes: int = 512 << 20  # messages that wait to be sorted by time
    queue_depth: int = 100_000

    def unpacked_bytes(self, packed_bytes: int) -> int:
        """Largest size of a file that is compressed to a number of bytes."""
        return min(self.file_bytes, max(self.small_file_bytes, self.file_ratio * packed_bytes))


PIECE_BYTES = 1 << 20  # large files are read in pieces
FILES = FileLimits()
LOGS = LogLimits()


_ENDING = '.npy'
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_READERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def read_arrays(stream: IO[bytes]) -> dict[str, NDArray[Any]]:
    """Read all arrays of an archive (.npz) of any origin, by name.

    Members may be compressed a thousandfold, and the header of an array may declare any size. Sizes
    are therefore summed first, and each declared size is compared with that of its member. The
    limits are above the largest map of thinmap.

    Raises InputError if it is no archive of plain arrays (no pickled objects), or exceeds the
    limits; OSError as the stream.
    """
    try:
        with zipfile.ZipFile(stream) as archive:
            members = archive.infolist()
            _check_sizes(members)
            return {each.filename.removesuffix(_ENDING): _read(archive, each) for each in members}
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


def path_of(value: object) -> Path:
    """Path of a text or a Path. Raises InputError for anything else."""
    if isinstance(value, str | Path):
        return Path(value)
    raise InputError(f'path = {quoted(value)}: expected a text or a Path')


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
    """Open a regular file of any origin for reading; others block or never end.

    Symbolic links are followed.
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


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Have Ctrl-C wait for the end of the block, in which several files take their names."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Ctrl-C interrupts the main thread only
        return
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _frame: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        for number in came[:1]:
            signal.raise_signal(number)


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


_MERGE_TAG = 'tag:yaml.org,2002:merge'
_INTEGER_TAG = 'tag:yaml.org,2002:int'
_FLOAT_TAG = 'tag:yaml.org,2002:float'
_NUMBER_TAGS = (_INTEGER_TAG, _FLOAT_TAG)
_DECIMAL = re.compile(r'[-+]?[0-9]+\Z')
_INTEGER = re.compile(r'(?:[-+]?[0-9]+|0x[0-9a-fA-F]+)\Z')
_FLOAT = re.compile(
    r'(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?'
    r'|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))\Z'
)
_TRUE = ('y', 'yes', 'true', 'on')
_FALSE = ('n', 'no', 'false', 'off')


def parse_yaml(text: str) -> object:
    """Parse a YAML text of any origin: mappings, lists, texts, numbers, booleans, dates or nothing.

    A file of a few hundred bytes can describe billions of members by repetition (anchors and
    aliases, merge keys). No file of this project needs them, so they are rejected. The limits are
    far above any world, and checked before objects are constructed.

    Numbers are those of yaml-cpp, which reads the same files in ROS: `1e-1`, `-.5` and `1.e2` are
    numbers, `010` is ten, and `1:30` and `1_000` are texts. YAML 1.1, which PyYAML follows, says
    otherwise.

    Raises InputError, without a file name, if it is no YAML, or exceeds the limits.
    """
    return _parse(text, _BoundedLoader)


def read_mapping(path: Path, expected: str) -> dict[str, Any]:
    """Read a mapping. Raises InputError with the file name and the expectation."""
    return _read_mapping(path, expected, _BoundedLoader)


def read_texts(path: Path, expected: str) -> dict[str, Any]:
    """Read a mapping, as `read_mapping`; each value is the text that is written, or a list of such.

    The reader of a value decides on its type, as in yaml-cpp: `number_of`, `boolean_of`.
    """
    return _read_mapping(path, expected, _TextLoader)


def number_of(value: object) -> float:
    """Number that yaml-cpp reads of a text. Raises ValueError where it reads none."""
    if not isinstance(value, str) or not _FLOAT.match(value):
        raise ValueError(f'{quoted(value)}: expected a number')
    is_special = value.endswith(('f', 'F', 'n', 'N'))
    return float(value.replace('.', '') if is_special else value)


def boolean_of(value: object) -> bool:
    """Boolean that yaml-cpp reads of a text, or 0 or 1. Raises ValueError where it is neither."""
    text = value if isinstance(value, str) else ''
    if _DECIMAL.match(text) and int(text) in (0, 1):
        return bool(int(text))
    name = text.lower()
    if name in (*_TRUE, *_FALSE) and text in (name, name.upper(), name.capitalize()):
        return name in _TRUE
    raise ValueError(f'{quoted(value)}: expected 0, 1, true or false')


def _parse(text: str, loader: type['_BoundedLoader']) -> object:
    if len(text) > FILES.yaml_bytes:
        raise _YamlError(f'{len(text)} characters: expected at most {FILES.yaml_bytes}')
    try:
        return yaml.load(text, Loader=loader)
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        # ValueError, OverflowError: a date such as 2001-99-99, or 1e999 minutes.
        raise _YamlError(one_line_reason(error)) from error


# Bytes near the begin of files that are given for a YAML file, and what they are.
_BEGIN_BYTES = 64
_IMAGE = 'an image, which a YAML file beside it names'
_IMAGE_SUFFIXES = ('.pgm', '.png', '.bmp', '.jpg', '.jpeg')
_FOREIGN = (
    (
        b'serialization::archive',
        'a pose graph of slam_toolbox, whose service save_map writes a map',
    ),
    (
        bytes.fromhex('db01f55b7b1f1d7b'),
        'a state of Cartographer, of which cartographer_pbstream_to_ros_map makes a map',
    ),
    (b'#ROSBAG V', 'a ROS 1 bag, of which `replay` makes a map'),
    (b'MCAP0\r\n', 'a bag, of which `replay` makes a map'),
    (b'SQLite format 3\0', 'a bag, of which `replay` makes a map'),
    (b'PK\x03\x04', 'a NumPy archive, as of a session'),
    (b'PNG\r\n', _IMAGE),
    (b'\xff\xd8\xff', _IMAGE),
)


def _foreign_kind(path: Path) -> str:
    """What a file is that cannot be YAML, by its name or its begin; '' where it may be."""
    if path.suffix.lower() in _IMAGE_SUFFIXES:
        beside = path.with_suffix('.yaml')
        return f'{_IMAGE} (did you mean {beside}?)' if beside.is_file() else _IMAGE
    try:
        with open_regular_file(path) as stream:
            begin = stream.read(_BEGIN_BYTES)
    except (OSError, ValueError):
        return ''
    if begin[:2] in (b'P2', b'P5') and begin[2:3].isspace():
        return _IMAGE
    # A magic number is at the begin, or after a byte or a size.
    return next((kind for magic, kind in _FOREIGN if magic in begin[: 8 + len(magic)]), '')


def _read_mapping(path: Path, expected: str, loader: type['_BoundedLoader']) -> dict[str, Any]:
    if kind := _foreign_kind(path):
        raise InputError(f'{path}: {kind}: expected {expected}')
    try:
        content = _parse(read_text(path, FILES.yaml_bytes), loader)
    except _YamlError as error:
        raise InputError(f'{path}: {error}: expected {expected}') from error
    if not isinstance(content, dict):
        raise InputError(f'{path}: expected {expected}')
    for key in content:
        if not isinstance(key, str):
            raise InputError(f'{path}: key {quoted(key)}: expected a name; {expected}')
    return content


class _YamlError(InputError):
    """Error in a YAML text, without the file name."""


class _BoundedLoader(yaml.SafeLoader):
    """Counts nodes while parsing; objects are constructed after the last one."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._nodes = 0
        self._level = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose the next node. Raises _YamlError beyond the limits, or at an alias."""
        event = self.peek_event()
        self._reject_aliases(event)
        self._nodes += 1
        self._level += 1
        if self._nodes > FILES.yaml_nodes:
            expected = f'expected at most {FILES.yaml_nodes} values, lists and mappings'
            raise _YamlError(f'{_at(event)}: {expected}')
        if self._level > FILES.yaml_levels:
            raise _YamlError(f'{_at(event)}: expected at most {FILES.yaml_levels} levels')
        node = super().compose_node(parent, index)
        self._level -= 1
        self._reject_long_number(node, event)
        return node

    def _reject_aliases(self, event: yaml.Event) -> None:
        name = getattr(event, 'anchor', None)
        if name is not None:
            expected = 'expected no anchors and aliases (& and *)'
            raise _YamlError(f'{_at(event)}: {quoted(name)}: {expected}')

    def _reject_long_number(self, node: yaml.Node | None, event: yaml.Event) -> None:
        if not isinstance(node, yaml.ScalarNode):
            return
        if node.tag == _MERGE_TAG:
            raise _YamlError(f'{_at(event)}: <<: expected no merge keys')
        if node.tag in _NUMBER_TAGS and len(node.value) > FILES.digits:
            expected = f'expected at most {FILES.digits}'
            size = len(node.value)
            raise _YamlError(f'{_at(event)}: a number of {size} characters: {expected}')

    def construct_integer(self, node: yaml.ScalarNode) -> int:
        """An integer, decimal or hexadecimal."""
        text = str(self.construct_scalar(node))
        return int(text, 16 if text.startswith('0x') else 10)


_BoundedLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _NUMBER_TAGS]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}

_BoundedLoader.add_implicit_resolver(_INTEGER_TAG, _INTEGER, list('-+0123456789'))

_BoundedLoader.add_implicit_resolver(_FLOAT_TAG, _FLOAT, list('-+.0123456789'))

_BoundedLoader.add_constructor(_INTEGER_TAG, _BoundedLoader.construct_integer)


class _TextLoader(_BoundedLoader):
    """Leaves scalars as they are written, whatever their tags."""

    yaml_constructors: ClassVar[dict[Any, Any]] = {}
    yaml_multi_constructors: ClassVar[dict[Any, Any]] = {}


# Merge keys are found, and rejected.
_TextLoader.yaml_implicit_resolvers = {'<': yaml.SafeLoader.yaml_implicit_resolvers['<']}


def _at(event: yaml.Event) -> str:
    """Line and column of an event, from 1."""
    mark = event.start_mark
    return 'somewhere' if mark is None else f'line {mark.line + 1}, column {mark.column + 1}'


VERSION = 2
_LABEL = 'thinmap_format'


def write_snapshot(stream: IO[bytes], kind: str, state: State, compress: bool = True) -> None:
    """Write a state as an archive of NumPy arrays; compress: smaller and slower. Raises OSError.

    Its arrays are by name, with a label: what it is a state of, and the version of the format. The
    class of the state declares the arrays and validates them (`core/snapshot.py`).
    """
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
