"""rosbag2 folders and MCAP files: read as scans and odometry, read raw, and written."""

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.reader import NonSeekingReader
from mcap.records import Schema
from rosbags.highlevel import AnyReader
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from thinmap_ros.adapters import bag_messages
from thinmap_ros.adapters.events import Event, OdometryEvent, ScanEvent, Skipped
from thinmap_ros.adapters.mounts import Mount, StaticTransforms, rotation_matrix
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

_SCAN, _ODOMETRY, _TF = 'sensor_msgs/msg/LaserScan', 'nav_msgs/msg/Odometry', 'tf2_msgs/msg/TFMessage'
_FOREVER = QosTime(2147483647, 4294967295)
# Players offer what was recorded; who listens to static transforms asks for the ones of before.
_LATCHED = Qos(
    history=QosHistory.KEEP_LAST,
    depth=1,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.TRANSIENT_LOCAL,
    deadline=_FOREVER,
    lifespan=_FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_FOREVER,
    avoid_ros_namespace_conventions=False,
)


@dataclass(frozen=True)
class RawMessage:
    """A message as it lies in a bag: topic, type, log time, CDR bytes."""

    topic: str
    type_name: str
    log_ns: int
    data: bytes


class Bag:
    """A bag opened for reading. `cut_off` says that it was read only as far as it is whole, which may show late."""

    def __init__(self, path: Path) -> None:
        """Open a bag. Raises InputError naming the file where it is none."""
        if not path.exists():
            raise InputError(f'{path}: no such file or folder: expected a rosbag2 folder or an MCAP file')
        if not path.is_dir() and path.suffix != '.mcap':
            raise InputError(f'{path}: expected a rosbag2 folder or a file that ends in .mcap')
        self.path = path
        self.cut_off = False
        self.typestore: Typestore = get_typestore(Stores.ROS2_JAZZY)
        self.topics: dict[str, str] = {}
        self._without_index = False
        try:
            with AnyReader([path], default_typestore=self.typestore) as reader:
                self.topics = {c.topic: c.msgtype for c in reader.connections}
                self.typestore = reader.typestore
        except Exception as error:  # rosbags' readers raise whatever a broken file makes them stumble over
            self._look_through(error)

    def messages(self, topics: set[str] | None = None) -> Iterator[RawMessage]:
        """Messages in the order of the log, of the given topics or of all; they end where the file is broken."""
        source = self._in_file_order() if self._without_index else self._in_log_order(topics)
        try:
            for message in source:
                if topics is None or message.topic in topics:
                    yield message
        except Exception:  # as above: what came before it counts
            self.cut_off = True

    def decode(self, message: RawMessage) -> Any:
        """Message object of a raw message. Raises InputError where its bytes do not fit its type."""
        try:
            return self.typestore.deserialize_cdr(message.data, message.type_name)
        except Exception as error:  # any error of the deserializer means the same: these bytes are no such message
            reason = ' '.join(str(error).split()) or type(error).__name__
            raise InputError(f'{self.path}: {message.topic}: no {message.type_name}: {reason}') from error

    def _in_log_order(self, topics: set[str] | None) -> Iterator[RawMessage]:
        with AnyReader([self.path], default_typestore=self.typestore) as reader:
            chosen = [c for c in reader.connections if topics is None or c.topic in topics]
            for connection, log_ns, data in reader.messages(chosen) if chosen else ():
                yield RawMessage(connection.topic, connection.msgtype, log_ns, bytes(data))

    def _in_file_order(self) -> Iterator[RawMessage]:
        """Messages of MCAP files without summary, which a killed recorder leaves, to the last whole chunk."""
        for file in self._mcap_files():
            with file.open('rb') as stream:
                for schema, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
                    if schema is not None:
                        self._learn(schema)
                        self.topics.setdefault(channel.topic, schema.name)
                        yield RawMessage(channel.topic, schema.name, message.log_time, message.data)

    def _mcap_files(self) -> list[Path]:
        return sorted(self.path.glob('*.mcap')) if self.path.is_dir() else [self.path]

    def _look_through(self, reason: Exception) -> None:
        """Find the topics of a bag that ordinary readers refuse."""
        said = ' '.join(str(reason).split()) or type(reason).__name__
        self.topics, self._without_index, self.cut_off = {}, True, True
        if not sum(1 for _ in self.messages()):
            raise InputError(f'{self.path}: {said}: no whole message: expected a rosbag2 folder or an MCAP file')

    def _learn(self, schema: Schema) -> None:
        if schema.name not in self.typestore.types:
            types = get_types_from_msg(schema.data.decode(), schema.name)
            self.typestore.register({k: v for k, v in types.items() if k not in self.typestore.types})


@dataclass
class BagLog:
    """A bag as scans and odometry. Empty topic names: the only topic of that type.

    T_base_laser (3,): the laser on the robot; None: from /tf_static.
    """

    path: Path
    scan_topic: str = ''
    odometry_topic: str = ''
    T_base_laser: Array | None = None
    base_frame: str = 'base_link'
    skipped: Skipped = field(default_factory=Skipped)

    def events(self) -> Iterator[Event]:
        """Odometry and scans in the order of the log.

        Raises InputError where the bag has no scans or no odometry (naming the topics that it has), or nothing says
        where the laser sits. A message that cannot be used is skipped and counted.
        """
        bag = Bag(self.path)
        self.skipped = Skipped()
        used = {
            self._topic(bag, _SCAN, self.scan_topic, 'laser scans'): 0,
            self._topic(bag, _ODOMETRY, self.odometry_topic, 'odometry'): 0,
        }
        transforms = self._static_transforms(bag)
        mounts: dict[str, Mount] = {}
        for message in bag.messages(set(used)):
            event = self._event(bag, message)
            if event is None:
                continue
            frame, value = event
            if isinstance(value, Scan):
                mounts[frame] = mounts.get(frame) or self._mount(frame, transforms)
                yield ScanEvent(mounts[frame].placed(value))
            else:
                yield value
            used[message.topic] += 1
        if bag.cut_off:
            self.skipped.add(f'{self.path}: cut off: read up to its last whole chunk')
        for topic, count in used.items():
            if count == 0:
                first = f': {self.skipped.first}' if self.skipped.first else ''
                raise InputError(f'{self.path}: {topic}: no message that can be used{first}')

    def _event(self, bag: Bag, message: RawMessage) -> tuple[str, OdometryEvent | Scan] | None:
        """Frame and value of a message; None, counted, where it is unusable."""
        try:
            decoded = bag.decode(message)
            value = _odometry(decoded) if message.type_name == _ODOMETRY else _scan(decoded)
        except InputError as error:
            reason = str(error).removeprefix(f'{self.path}: {message.topic}: ')
            self.skipped.add(f'{self.path}: {message.topic}: {reason}')
            return None
        return decoded.header.frame_id, value

    def _topic(self, bag: Bag, type_name: str, wanted: str, what: str) -> str:
        found = sorted(topic for topic, name in bag.topics.items() if name == type_name)
        if wanted and wanted in found:
            return wanted
        if not wanted and len(found) == 1:
            return found[0]
        listed = ', '.join(f'{t} ({n})' for t, n in sorted(bag.topics.items())) or 'nothing'
        if not found or wanted:
            raise InputError(f'{self.path}: no {what} ({wanted or type_name}); it has {listed}')
        raise InputError(f'{self.path}: {what} on several topics, name one of {", ".join(found)}')

    def _static_transforms(self, bag: Bag) -> StaticTransforms:
        transforms = StaticTransforms()
        topics = {t for t, n in bag.topics.items() if n == _TF and t.endswith('tf_static')}
        for message in bag.messages(topics) if topics and self.T_base_laser is None else ():
            try:
                for transform in bag.decode(message).transforms:
                    transforms.add(transform)
            except InputError as error:
                self.skipped.add(f'{self.path}: {message.topic}: {error}')
        return transforms

    def _mount(self, frame: str, transforms: StaticTransforms) -> Mount:
        if self.T_base_laser is not None:
            return Mount(self.T_base_laser, upside_down=False)
        try:
            mount = transforms.mount(frame, self.base_frame)
        except InputError as error:
            raise InputError(f'{self.path}: /tf_static: {error}') from error
        if mount is None:
            known = ', '.join(transforms.frames) or 'nothing'
            raise InputError(
                f'{self.path}: /tf_static does not say where "{frame}" is on "{self.base_frame}" (it has {known}): '
                'give --base-frame, or --offset-m for a laser straight ahead'
            )
        return mount


def _odometry(message: Any) -> OdometryEvent:
    rotation_matrix(message.pose.pose.orientation)  # raises where it is none
    T_odom_base = bag_messages.pose(message.pose.pose)
    if not se2.is_finite(T_odom_base):
        raise InputError(f'pose {T_odom_base.tolist()}: expected finite numbers')
    return OdometryEvent(bag_messages.stamp_ns(message), T_odom_base)


def _scan(message: Any) -> Scan:
    if len(message.ranges) == 0:
        raise InputError('a scan without ranges')
    return Scan.create(
        bag_messages.stamp_ns(message),
        message.ranges,
        message.angle_min,
        message.angle_increment,
        message.range_min,
        message.range_max,
    )


class BagWriter:
    """Writes a rosbag2 folder with an MCAP file, or, where the path ends in .mcap, that file alone.

    As a context it writes aside and takes the name when the block ends well, so that no half-written bag passes for a
    good one. `live` writes under the name from the start: what a recorder wants, whose work is never "done". An older
    bag of that name gives way. Raises InputError where the path is something else.
    """

    def __init__(self, path: Path, live: bool = False, definitions: dict[str, str] | None = None) -> None:
        self._path = path
        self._folder = path if live else path.with_name(f'.{path.name}.{os.getpid()}.part')
        self.typestore: Typestore = get_typestore(Stores.ROS2_JAZZY)
        for name, text in (definitions or {}).items():
            if name not in self.typestore.types:
                self.typestore.register(get_types_from_msg(text, name))
        self._connections: dict[str, Connection] = {}
        _check_replaceable(path)
        _remove(self._folder)
        self._folder.parent.mkdir(parents=True, exist_ok=True)
        self._writer = Writer(self._folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()

    def __enter__(self) -> 'BagWriter':
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
            if kind is None and self._folder != self._path:
                self._take_name()
        finally:
            if self._folder != self._path or kind is not None:
                _remove(self._folder)

    def write(self, topic: str, type_name: str, log_ns: int, message: Any) -> None:
        """Write a message: its CDR bytes, or a message object of the typestore."""
        if topic not in self._connections:
            offered = [_LATCHED] if topic.endswith('tf_static') else []
            self._connections[topic] = self._writer.add_connection(
                topic, type_name, typestore=self.typestore, offered_qos_profiles=offered
            )
        if not isinstance(message, bytes | memoryview):
            message = self.typestore.serialize_cdr(message, type_name)
        self._writer.write(self._connections[topic], log_ns, message)

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()

    def _take_name(self) -> None:
        (file,) = self._folder.glob('*.mcap')
        if self._path.suffix == '.mcap':
            file.replace(self._path)
            return
        # The file inside carries the folder's name, and the metadata carry the file's.
        name = file.name.replace(self._folder.name, self._path.name)
        metadata = self._folder / 'metadata.yaml'
        metadata.write_text(metadata.read_text().replace(file.name, name))
        file.rename(self._folder / name)
        _remove(self._path)
        self._folder.rename(self._path)


def _check_replaceable(path: Path) -> None:
    """Refuse to write where something else is than a bag: it would be lost."""
    if path.is_dir() and path.suffix != '.mcap':
        others = [file.name for file in path.iterdir() if file.suffix != '.mcap' and file.name != 'metadata.yaml']
        if not others:
            return
        raise InputError(f'{path}: a folder with {min(others)} in it: expected a new name or an older bag')
    if path.exists() and not (path.is_file() and path.suffix == '.mcap'):
        raise InputError(f'{path}: exists and is no bag: expected a new name or an older bag')


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
