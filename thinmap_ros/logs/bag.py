"""rosbag2 folders and MCAP files: raw messages, and scans with odometry."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.interfaces import Qos

from thinmap_ros.core import se2, validation
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.files.limits import LOGS
from thinmap_ros.logs import decode
from thinmap_ros.logs.bag_directory import DecompressedFile, bag_files
from thinmap_ros.logs.laser_mount import Mount, StaticTransforms, rotation_matrix
from thinmap_ros.logs.log import (
    Event,
    OdometryEvent,
    ScanEvent,
    SkippedRecords,
    is_mcap,
    refuse_foreign,
)
from thinmap_ros.logs.mcap_records import DamagedError, decompress
from thinmap_ros.logs.storage import RawMessage, Storage, storage_of

_SCAN = 'sensor_msgs/msg/LaserScan'
_ODOMETRY = 'nav_msgs/msg/Odometry'
_TF = 'tf2_msgs/msg/TFMessage'
_MAX_WARNINGS = 8


class Bag:
    """A bag opened for reading.

    `topics`: their types; `offers`: QoS of their publishers.
    """

    def __init__(self, path: Path) -> None:
        """Open a bag. Raises InputError with the file name if it has no intact message."""
        if not path.exists():
            raise InputError(
                f'{path}: no such file or folder: expected a rosbag2 folder or an MCAP file'
            )
        refuse_foreign(path)
        if not (path.is_dir() or path.suffix == '.mcap' or is_mcap(path)):
            raise InputError(f'{path}: expected a rosbag2 folder or a file that ends in .mcap')
        self.path = path
        self.topics: dict[str, str] = {}
        self.offers: dict[str, list[Qos]] = {}
        self._storages: list[Storage] = []
        self._unpacked: list[DecompressedFile] = []
        self._files = bag_files(path)
        self._unreadable = 0
        try:
            for file in self._files.files:
                self._add(self._opened(file))
        except OSError as error:
            raise InputError(f'{error.filename or path}: {error.strerror or error}') from error
        if self.damage and not any(storage.has_messages for storage in self._storages):
            expected = 'expected a rosbag2 folder or an MCAP file'
            raise InputError(f'{path}: {self.damage}: no intact message: {expected}')

    @property
    def is_truncated(self) -> bool:
        """Whether the bag is truncated: only its intact part is read. May become True late."""
        return bool(self.damage)

    @property
    def damage(self) -> str:
        """Description of the damage, in one line; empty if the bag is intact."""
        words = [str(storage.damage) for storage in self._storages if storage.damage]
        if self._files.without_metadata:
            words.append(self._files.without_metadata)
        if self._unreadable:
            words.append(f'{self._unreadable} messages that cannot be decompressed')
        return '; '.join(words[:_MAX_WARNINGS])

    @property
    def repair_hint(self) -> str:
        """Damage and how to repair it, in one line; empty if the bag is intact."""
        if not self.damage:
            return ''
        read = 'only the intact part is read'
        return f'{self.path}: {self.damage}: {read}; `bag_repair {self.path}` writes a repaired bag'

    def message_count(self, topic: str) -> int | None:
        """Recorded number of messages of a topic; None if a file does not record it."""
        holders = [storage for storage in self._storages if topic in storage.topics]
        counts = [storage.message_counts.get(topic) for storage in holders]
        known = [count for count in counts if count is not None]
        return sum(known) if counts and len(known) == len(counts) else None

    def messages(self, topics: set[str] | None = None) -> Iterator[RawMessage]:
        """Intact messages of the given topics, or of all, in log order."""
        for storage in self._storages:
            for message in storage.messages(topics):
                if not self._files.compressed_messages:
                    yield message
                    continue
                try:
                    data = decompress('zstd', message.data, LOGS.chunk_bytes)
                except DamagedError:
                    self._unreadable += 1
                    continue
                yield RawMessage(message.topic, message.type_name, message.log_ns, data)

    def decode(self, message: RawMessage) -> Any:
        """Decode a raw message. Raises InputError if its bytes do not fit its type."""
        holders = (s for s in self._storages if s.topics.get(message.topic) == message.type_name)
        storage = next(holders, self._storages[0])
        try:
            return storage.typestore(message.type_name).deserialize_cdr(
                message.data, message.type_name
            )
        except Exception as error:  # the deserializer raises many types
            reason = ' '.join(str(error).split())[:120] or type(error).__name__
            where = f'{self.path}: {validation.quoted_name(message.topic)}'
            raise InputError(
                f'{where}: no {validation.quoted_name(message.type_name)}: {reason}'
            ) from error

    def _opened(self, file: Path) -> Storage:
        if file.suffix != '.zstd':
            return storage_of(file)
        unpacked = DecompressedFile(file)
        self._unpacked.append(unpacked)
        try:
            return storage_of(unpacked.path)
        except InputError as error:
            raise InputError(str(error).replace(str(unpacked.path), str(file))) from error

    def _add(self, storage: Storage) -> None:
        self._storages.append(storage)
        self.topics |= storage.topics
        for topic, offers in storage.offers.items():
            self.offers.setdefault(
                topic, offers
            )  # the files of a bag repeat the entries of their topics


@dataclass
class BagLog:
    """Scans and odometry of a bag. Empty topic name: the only topic of that type.

    T_base_laser (3,): pose of the laser on the robot; None: from /tf_static. expected_scans: as in
    `Log`, from the first event on.
    """

    path: Path
    scan_topic: str = ''
    odometry_topic: str = ''
    T_base_laser: Array | None = None
    base_frame: str = 'base_link'
    skipped: SkippedRecords = field(default_factory=SkippedRecords)
    expected_scans: int | None = field(default=None, init=False)

    def events(self) -> Iterator[Event]:
        """Odometry and scans in the order of the log. Unusable messages are skipped and counted.

        Raises InputError if the bag has no scans or no odometry (with the list of its topics), or
        if the laser pose is unknown.
        """
        bag = Bag(self.path)
        self.skipped = SkippedRecords()
        try:
            yield from self._events(bag)
        except InputError as error:
            if bag.damage and bag.damage not in str(error):
                raise InputError(f'{error}; the bag is damaged: {bag.damage}') from error
            raise

    def _events(self, bag: Bag) -> Iterator[Event]:
        used = {
            self._topic(bag, _SCAN, self.scan_topic, 'laser scans'): 0,
            self._topic(bag, _ODOMETRY, self.odometry_topic, 'odometry'): 0,
        }
        self.expected_scans = bag.message_count(next(iter(used)))
        transforms = self._static_transforms(bag)
        mounts: dict[str, Mount] = {}
        for message in bag.messages(set(used)):
            event = self._event(bag, message)
            if event is None:
                continue
            frame, value = event
            if isinstance(value, Scan):
                mounts[frame] = mounts.get(frame) or self._mount(frame, transforms)
                yield ScanEvent(mounts[frame].apply(value))
            else:
                yield value
            used[message.topic] += 1
        if bag.repair_hint:
            self.skipped.add_first(bag.repair_hint)
        for topic, count in used.items():
            if count == 0:
                first = f': {self.skipped.first}' if self.skipped.first else ''
                name = validation.quoted_name(topic)
                raise InputError(f'{self.path}: {name}: no usable message{first}')

    def _event(self, bag: Bag, message: RawMessage) -> tuple[str, OdometryEvent | Scan] | None:
        """Frame and value of a message; None, and counted, if it is unusable."""
        try:
            decoded = bag.decode(message)
            value = (
                _odometry(decoded)
                if message.type_name == _ODOMETRY
                else decode.scan(decoded, decode.stamp_ns(decoded))
            )
        except InputError as error:
            where = f'{self.path}: {validation.quoted_name(message.topic)}: '
            self.skipped.add(where + str(error).removeprefix(where))
            return None
        return decoded.header.frame_id, value

    def _topic(self, bag: Bag, type_name: str, wanted: str, what: str) -> str:
        found = sorted(topic for topic, name in bag.topics.items() if name == type_name)
        if wanted and wanted in found:
            return wanted
        if not wanted and len(found) == 1:
            return found[0]
        if not found or wanted:
            has = validation.quoted_names(
                [f'{topic} ({name})' for topic, name in sorted(bag.topics.items())]
            )
            raise InputError(f'{self.path}: no {what} ({wanted or type_name}); it has {has}')
        names = validation.quoted_names(found)
        raise InputError(f'{self.path}: {what} on several topics: choose one of {names}')

    def _static_transforms(self, bag: Bag) -> StaticTransforms:
        transforms = StaticTransforms()
        topics = {t for t, n in bag.topics.items() if n == _TF and t.endswith('tf_static')}
        for message in bag.messages(topics) if topics and self.T_base_laser is None else ():
            try:
                for transform in bag.decode(message).transforms:
                    transforms.add(transform)
            except InputError as error:
                where = f'{self.path}: {validation.quoted_name(message.topic)}: '
                self.skipped.add(where + str(error).removeprefix(where))
        return transforms

    def _mount(self, frame: str, transforms: StaticTransforms) -> Mount:
        if self.T_base_laser is not None:
            return Mount(self.T_base_laser, upside_down=False)
        try:
            mount = transforms.laser_mount(frame, self.base_frame)
        except InputError as error:
            raise InputError(f'{self.path}: /tf_static: {error}') from error
        if mount is None:
            known = validation.quoted_names(transforms.frames)
            where = f'from "{validation.quoted_name(frame)}" to "{self.base_frame}"'
            raise InputError(
                f'{self.path}: /tf_static has no transform {where} (it has {known}): '
                'give --base-frame, or --offset-m for a laser straight ahead'
            )
        return mount


def _odometry(message: Any) -> OdometryEvent:
    rotation_matrix(message.pose.pose.orientation)  # raises InputError if it is invalid
    T_odom_base = decode.pose(message.pose.pose)
    if not se2.is_bounded_pose(T_odom_base):
        raise InputError(
            f'pose {T_odom_base.tolist()}: expected finite numbers, at most '
            f'{se2.MAX_COORDINATE_M:g} m'
        )
    return OdometryEvent(decode.stamp_ns(message), T_odom_base)
