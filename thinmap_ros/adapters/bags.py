"""rosbag2 folders and MCAP files: read as scans and odometry, and read raw."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.reader import NonSeekingReader
from mcap.records import Channel, Schema
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2, Qos
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from thinmap_ros.adapters import bag_messages, bag_types
from thinmap_ros.adapters.events import Event, OdometryEvent, ScanEvent, Skipped
from thinmap_ros.adapters.mounts import Mount, StaticTransforms, rotation_matrix
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

_SCAN, _ODOMETRY, _TF = 'sensor_msgs/msg/LaserScan', 'nav_msgs/msg/Odometry', 'tf2_msgs/msg/TFMessage'


@dataclass(frozen=True)
class RawMessage:
    """A message as it lies in a bag: topic, type, log time, CDR bytes."""

    topic: str
    type_name: str
    log_ns: int
    data: bytes


class Bag:
    """A bag opened for reading: `topics` and their types, `offers` and what their publishers offered.

    `cut_off` says that it was read only as far as it is whole, which may show late.
    """

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
        self.offers: dict[str, list[Qos]] = {}
        self._without_index = False
        try:
            with AnyReader([path], default_typestore=self.typestore) as reader:
                for connection in reader.connections:
                    self.topics[connection.topic] = connection.msgtype
                    if isinstance(connection.ext, ConnectionExtRosbag2):
                        self.offers.setdefault(connection.topic, []).extend(connection.ext.offered_qos_profiles)
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
                        self._learn(schema, channel)
                        yield RawMessage(channel.topic, schema.name, message.log_time, message.data)

    def _mcap_files(self) -> list[Path]:
        return sorted(self.path.glob('*.mcap')) if self.path.is_dir() else [self.path]

    def _look_through(self, reason: Exception) -> None:
        """Find the topics of a bag that ordinary readers refuse."""
        said = ' '.join(str(reason).split()) or type(reason).__name__
        self.topics, self.offers, self._without_index, self.cut_off = {}, {}, True, True
        if not sum(1 for _ in self.messages()):
            raise InputError(f'{self.path}: {said}: no whole message: expected a rosbag2 folder or an MCAP file')

    def _learn(self, schema: Schema, channel: Channel) -> None:
        if channel.topic not in self.topics:
            self.topics[channel.topic] = schema.name
            self.offers[channel.topic] = parse_qos(channel.metadata.get('offered_qos_profiles', ''))
        bag_types.learn(self.typestore, schema)


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
