"""rosbag2 folders: their files, and how these are compressed (metadata.yaml)."""

from dataclasses import dataclass
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory, TemporaryFile
from typing import IO, Any

import zstandard

from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.files.safe import (
    FILES,
    LOGS,
    PIECE_BYTES,
    open_regular_file,
    parse_yaml,
    read_text,
)


@dataclass(frozen=True)
class BagFiles:
    """The files of a bag in the order of recording.

    compressed_messages: whether messages are compressed individually; without_metadata: why
    metadata.yaml was not used, empty if it was, or if nothing is missed with it; note: the same for
    files that need none.
    """

    files: list[Path]
    compressed_messages: bool = False
    without_metadata: str = ''
    note: str = ''


def bag_files(path: Path) -> BagFiles:
    """Files of a bag: the given file, or those of a folder.

    Files are found even if metadata.yaml is missing or unreadable: a killed recorder does not write
    it. Raises InputError if there are no files, or those of several bags.
    """
    if not path.is_dir():
        is_sqlite = path.suffixes[:1] == ['.db3']
        return BagFiles([path], note=f'{path}: read without metadata.yaml' if is_sqlite else '')
    metadata = path / 'metadata.yaml'
    found = mcap_files_in(path)
    try:
        return _listed(path, _information(metadata))
    except (InputError, KeyError, TypeError, ValueError, AttributeError) as error:
        reason = f'{metadata}: {one_line_reason(error).removeprefix(f"{metadata}: ")}'
    bare = sorted([*path.glob('*.db3'), *path.glob('*.db3.zstd')], key=_number)
    _require_one_bag(path, found or bare)
    if found:
        return BagFiles(found, without_metadata=reason)
    if bare:
        return BagFiles(bare, note=f'{reason}: its SQLite files are read without it')
    raise InputError(
        f'{path}: expected a rosbag2 folder, with metadata.yaml and MCAP or SQLite files'
    )


def mcap_files_in(folder: Path) -> list[Path]:
    """MCAP files of a folder in the order of recording."""
    return sorted(folder.glob('*.mcap'), key=_number)


def _require_one_bag(folder: Path, files: list[Path]) -> None:
    """Raises InputError where files have other names than the parts of one bag."""
    if len({_bag_name(file) for file in files}) > 1:
        first, second = (file.name for file in files[:2])
        raise InputError(
            f'{folder}: {len(files)} files of several bags ({first}, {second}, ...): expected one '
            f'bag, or the names of the files: {folder}/*{files[0].suffix}'
        )


def _bag_name(file: Path) -> str:
    """Name of the bag that a file is a part of: rosbag2 names them name_0, name_1, ..."""
    stem = Path(file.name.removesuffix('.zstd')).stem
    name, _, number = stem.rpartition('_')
    return name if number.isdecimal() else stem


def _number(file: Path) -> tuple[int, str]:
    """Number of a file of a bag: rosbag2 names them name_0, name_1, ... name_10."""
    number = Path(file.name.removesuffix('.zstd')).stem.rpartition('_')[2]
    return (int(number) if number.isdecimal() and len(number) < 10 else -1, file.name)


def _information(metadata: Path) -> Any:
    """Raises InputError, KeyError or TypeError if it is missing, or exceeds the YAML limits."""
    content: Any = parse_yaml(read_text(metadata, FILES.yaml_bytes))
    return content['rosbag2_bagfile_information']


def _listed(folder: Path, information: Any) -> BagFiles:
    """Raises KeyError, TypeError, ValueError or AttributeError if the information is invalid."""
    files = [folder / PurePath(name).name for name in information['relative_file_paths']]
    missing = [file.name for file in files if not file.is_file()]
    if missing or not files:
        raise ValueError(
            f'expected the file {missing[0][:80]}' if missing else 'expected the names of files'
        )
    mode = (information.get('compression_mode') or '').lower()
    return BagFiles(files, compressed_messages=mode == 'message')


class DecompressedFile:
    """A file that is compressed as a whole, decompressed for as long as this object exists.

    An MCAP file has no name, so that nothing of it is left, however the program ends. SQLite opens
    files by name only: that one is in a temporary folder.
    """

    def __init__(self, file: Path) -> None:
        """Raises InputError if a file is invalid, or expands to more than it may."""
        self._folder: TemporaryDirectory[str] | None = None
        if file.stem.endswith('.db3'):
            self._folder = TemporaryDirectory(prefix='thinmap_')
            self.path = Path(self._folder.name) / file.stem
            self._stream: IO[bytes] = self.path.open('w+b')
        else:
            self._stream = TemporaryFile()  # noqa: SIM115
            self.path = Path(f'/proc/self/fd/{self._stream.fileno()}')
        _unpack(file, self._stream)
        self._stream.flush()


def _unpack(file: Path, out: IO[bytes]) -> None:
    limit = LOGS.unpacked_bytes(file.stat().st_size)
    try:
        with open_regular_file(file) as packed:
            reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            while piece := reader.read(PIECE_BYTES):
                if out.tell() + len(piece) > limit:
                    raise InputError(f'{file}: expected at most {limit} bytes decompressed')
                out.write(piece)
    except zstandard.ZstdError as error:
        raise InputError(f'{file}: no zstd file: {str(error)[:120]}') from error
