"""Writes rosbag2 folders and MCAP files, atomically or live."""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, cast

from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from thinmap_ros.core.errors import InputError
from thinmap_ros.logs.storage import recorded


class BagWriter:
    """Writes a rosbag2 folder with an MCAP file, or only that file if the path ends in .mcap.

    As a context manager it writes to a temporary path and renames it when the block succeeds, so
    that no partial bag is mistaken for a complete one. `live` writes under the final name from the
    start, for recorders: messages since the last `flush` may be lost. `compressed`: with zstd, by
    chunk. An older bag of that name is replaced. Raises InputError if the path is something else.
    """

    def __init__(
        self,
        path: Path,
        live: bool = False,
        definitions: dict[str, str] | None = None,
        compressed: bool = False,
    ) -> None:
        self._path = path
        self._folder = path if live else _aside(path)
        self.typestore: Typestore = get_typestore(Stores.ROS2_JAZZY)
        self.add_definitions(definitions or {})
        self._connections: dict[str, Connection] = {}
        _check_replaceable(path)
        _remove(self._folder)
        self._folder.parent.mkdir(parents=True, exist_ok=True)
        self._writer = Writer(self._folder, version=9, storage_plugin=StoragePlugin.MCAP)
        if compressed:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()

    def __enter__(self) -> 'BagWriter':
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.close()
            if kind is None and self._folder != self._path:
                _rename(self._folder, self._path)
        finally:
            if self._folder != self._path or kind is not None:
                _remove(self._folder)

    def add_definitions(self, definitions: dict[str, str]) -> None:
        """Add message definitions, texts by full name, for types outside of ROS."""
        for name, text in definitions.items():
            if name not in self.typestore.types:
                self.typestore.register(get_types_from_msg(text, name))

    def write(self, topic: str, type_name: str, log_ns: int, message: Any) -> None:
        """Write a message: its CDR bytes, or a message object of the typestore."""
        if topic not in self._connections:
            self.add_topic(
                topic, type_name, [recorded(1, True, True)] if topic.endswith('tf_static') else []
            )
        if not isinstance(message, bytes | memoryview):
            message = self.typestore.serialize_cdr(message, type_name)
        self._writer.write(self._connections[topic], log_ns, message)

    def add_topic(self, topic: str, type_name: str, offers: Sequence[Qos]) -> None:
        """Add a topic before its first message, with the QoS of its publishers.

        Raises InputError if the definition of its type is unknown.
        """
        try:
            self._connections[topic] = self._writer.add_connection(
                topic, type_name, typestore=self.typestore, offered_qos_profiles=offers
            )
        except TypesysError as error:
            raise InputError(f'{topic}: {" ".join(str(error).split())}') from error

    def flush(self) -> None:
        """Close the current chunk and sync it to disk, so that it survives a crash."""
        storage = cast(McapWriter, self._writer.storage)
        if storage.chunk.msgs:
            storage.close_chunk()
            storage.bio.flush()
            os.fdatasync(storage.bio.fileno())

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()


@contextmanager
def temporary_bag(path: Path) -> Iterator[Path]:
    """Yield an empty folder, whose content becomes the bag `path` when the block succeeds.

    Its content: NAME.mcap and metadata.yaml. An older bag of that name is replaced. Raises
    InputError if the path is something else.
    """
    _check_replaceable(path)
    folder = _aside(path)
    _remove(folder)
    folder.mkdir(parents=True)
    try:
        yield folder
        _rename(folder, path)
    finally:
        _remove(folder)


def _aside(path: Path) -> Path:
    return path.with_name(f'.{path.name}.{os.getpid()}.part')


def _rename(folder: Path, path: Path) -> None:
    (file,) = folder.glob('*.mcap')
    if path.suffix == '.mcap':
        file.replace(path)
        return
    # The file has the name of the folder, and the metadata have that of the file.
    name = file.name.replace(folder.name, path.name)
    metadata = folder / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace(file.name, name))
    file.rename(folder / name)
    _remove(path)
    folder.rename(path)


def _check_replaceable(path: Path) -> None:
    """Raise InputError if the path exists and is no bag: it would be overwritten."""
    if path.is_dir() and path.suffix != '.mcap':
        others = [
            file.name
            for file in path.iterdir()
            if file.suffix != '.mcap' and file.name != 'metadata.yaml'
        ]
        if not others:
            return
        raise InputError(
            f'{path}: a folder with {min(others)} in it: expected a new name or an older bag'
        )
    if path.exists() and not (path.is_file() and path.suffix == '.mcap'):
        raise InputError(f'{path}: exists and is no bag: expected a new name or an older bag')


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
