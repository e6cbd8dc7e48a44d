"""rosbag2 folders and MCAP files: raw messages, and scans with odometry."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype, Qos
from rosbags.typesys.store import Typestore

from thinmap_ros.core import errors
from thinmap_ros.core.errors import InputError, counted
from thinmap_ros.core.scan import LaserConfig
from thinmap_ros.core.se2 import Array
from thinmap_ros.files.safe import LOGS, require_regular_file
from thinmap_ros.logs import decode
from thinmap_ros.logs.frames import (
    NONE,
    TF,
    BagFrames,
    BagOdometry,
    FrameOptions,
    NoOdometry,
    OdometryByTransforms,
    OdometryOnTopic,
)
from thinmap_ros.logs.log import Event, Log, LogFormat, LogOptions, ScanEvent, SkippedRecords
from thinmap_ros.logs.mcap import DamagedError, decompress
from thinmap_ros.logs.storage import (
    DecompressedFile,
    McapStorage,
    RawMessage,
    Ros1Storage,
    SqliteStorage,
    Storage,
    bag_files,
    is_bag,
    kind_of,
)

SCAN = 'sensor_msgs/msg/LaserScan'
_ODOMETRY = 'nav_msgs/msg/Odometry'
EXPECTED = 'a rosbag2 folder, an MCAP or SQLite file, or a ROS 1 bag'
_IDL_NAMES = {
    'bool': 'boolean',
    'byte': 'octet',
    'char': 'uint8',
    'float32': 'float',
    'float64': 'double',
}
_ZSTD = b'\x28\xb5\x2f\xfd'  # begin of a message that is compressed by itself
_MAX_WARNINGS = 8
_WITHOUT_ODOMETRY = '; --odom-source none maps by scan matching alone'
_USUAL_TOPICS = {SCAN: '/scan', _ODOMETRY: '/odom'}


class Bag:
    """A bag opened for reading.

    `topics`: their types; `offers`: QoS of their publishers.
    """

    def __init__(self, path: Path) -> None:
        """Open a bag. Raises InputError with the file name if it has no intact message."""
        if not path.exists():
            raise InputError(f'{path}: no such file or folder: expected {EXPECTED}')
        if not is_bag(path):
            raise InputError(f'{path}: expected {EXPECTED}')
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
            raise InputError(f'{path}: {self.damage}: no intact message: expected {EXPECTED}')

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
            words.append(f'{counted(self._unreadable, "message")} that cannot be decompressed')
        return '; '.join(words[:_MAX_WARNINGS])

    @property
    def note(self) -> str:
        """How the files were found, in one line; empty if metadata.yaml names them."""
        return self._files.note

    @property
    def repair_hint(self) -> str:
        """Damage and how to repair it, in one line; empty if the bag is intact."""
        if not self.damage:
            return ''
        hint = f'{self.path}: {self.damage}: only the intact part is read'
        repair = self._storages[0].repair.format(self.path)
        return f'{hint}; {repair}' if repair else hint

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
                if not (self._files.compressed_messages or message.data.startswith(_ZSTD)):
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
        try:
            return self._typestore(message.topic, message.type_name).deserialize_cdr(
                message.data, message.type_name
            )
        except Exception as error:  # the deserializer raises many types
            reason = ' '.join(str(error).split())[:120] or type(error).__name__
            where = f'{self.path}: {errors.quoted_name(message.topic)}'
            raise InputError(
                f'{where}: no {errors.quoted_name(message.type_name)}: {reason}'
            ) from error

    def fields(self, topic: str) -> dict[str, str]:
        """Types of the fields of a topic's type in the bag, by name, in the words of rclpy.

        Empty if the bag does not define it.
        """
        type_name = self.topics[topic]
        definitions = self._typestore(topic, type_name).fielddefs
        if type_name not in definitions:
            return {}
        return {name: _type_words(kind) for name, kind in definitions[type_name][1]}

    def _typestore(self, topic: str, type_name: str) -> Typestore:
        holders = (s for s in self._storages if s.topics.get(topic) == type_name)
        return next(holders, self._storages[0]).typestore(type_name)

    def _opened(self, file: Path) -> Storage:
        if file.suffix != '.zstd':
            return _storage_of(file)
        unpacked = DecompressedFile(file)
        self._unpacked.append(unpacked)
        try:
            return _storage_of(unpacked.path)
        except InputError as error:
            raise InputError(str(error).replace(str(unpacked.path), str(file))) from error

    def _add(self, storage: Storage) -> None:
        self._storages.append(storage)
        self.topics |= storage.topics
        for topic, offers in storage.offers.items():
            self.offers.setdefault(
                topic, offers
            )  # the files of a bag repeat the entries of their topics


def _type_words(field: Any) -> str:
    """Type of a field, as `get_fields_and_field_types` of a message writes it."""
    kind, what = field
    if kind is Nodetype.NAME:
        return str(what).replace('/msg/', '/')
    if kind is Nodetype.BASE:
        name, limit = what
        return f'{_IDL_NAMES.get(name, name)}{f"<{limit}>" if limit else ""}'
    of, count = what
    if kind is Nodetype.ARRAY:
        return f'{_type_words(of)}[{count}]'
    return f'sequence<{_type_words(of)}{f", {count}" if count else ""}>'


def _storage_of(path: Path) -> Storage:
    """Open a file of a bag. Raises InputError if it is invalid, OSError if it is no file."""
    require_regular_file(path)
    kind = kind_of(path)
    if kind == 'ros1':
        return Ros1Storage(path)
    return SqliteStorage(path) if kind == 'sqlite' or path.suffix == '.db3' else McapStorage(path)


@dataclass
class BagLog:
    """Scans and odometry of a bag. Empty topic name: the only topic of that type, /scan or /odom.

    scan_topic: one, or those of several lasers.
    T_base_laser (3,): pose of the laser on the robot; None: from the transforms. base_frame,
    odom_frame: frames of robot and odometry; empty: those of the bag (see `BagFrames`).
    odometry_source: topic, tf or none as for the nodes; empty: the topic, or tf without one.
    laser: its parameters. expected_scans: as in `Log`, from the first event on.
    """

    path: Path
    scan_topic: str | tuple[str, ...] = ''
    odometry_topic: str = ''
    T_base_laser: Array | None = None
    base_frame: str = ''
    odometry_source: str = ''
    odom_frame: str = ''
    laser: LaserConfig = field(default_factory=LaserConfig)
    skipped: SkippedRecords = field(default_factory=SkippedRecords)
    expected_scans: int | None = field(default=None, init=False)
    is_sorted: bool = field(default=False, init=False)

    def events(self) -> Iterator[Event]:
        """Odometry and scans in the order of the log. Unusable messages are skipped and counted.

        Raises InputError if the bag has no scans or no odometry (with the list of its topics), or
        if the laser pose is unknown, or given for lasers on several topics.
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
        scan_topics = self._scan_topics(bag)
        counts = [bag.message_count(topic) for topic in scan_topics]
        self.expected_scans = None if None in counts else sum(filter(None, counts))
        frames = BagFrames(
            bag, FrameOptions(self.T_base_laser, self.base_frame, self.odom_frame), self.skipped
        )
        odometry = self._odometry(bag, frames)
        used = Counter[str]()
        for message in bag.messages({*scan_topics, *odometry.topics}):
            for event in self._of_message(bag, message, frames, odometry):
                used[message.topic if isinstance(event, ScanEvent) else odometry.name] += 1
                yield event
        if bag.repair_hint:
            self.skipped.add_first(bag.repair_hint)
        if bag.note:
            self.skipped.note(bag.note)
        for names in (scan_topics, [odometry.name]):
            unused = [name for name in names if used[name] == 0]
            if unused == names:
                first = f': {self.skipped.first}' if self.skipped.first else odometry.missing
                remedy = '' if names is scan_topics else _WITHOUT_ODOMETRY
                raise InputError(
                    f'{self.path}: {errors.quoted_names(unused)}: no usable message{first}{remedy}'
                )
            for name in unused:
                self.skipped.note(
                    f'{errors.quoted_name(name)}: no usable message: mapped by the other lasers'
                )

    def _of_message(
        self, bag: Bag, message: RawMessage, frames: BagFrames, odometry: BagOdometry
    ) -> Iterator[Event]:
        """Events of a message; none, and counted, if it is unusable."""
        try:
            decoded = bag.decode(message)
            if message.type_name != SCAN:
                yield from odometry.samples(decoded)
                return
            scan = decode.scan(decoded, decode.stamp_ns(decoded), laser=self.laser)
        except InputError as error:
            where = f'{self.path}: {errors.quoted_name(message.topic)}: '
            self.skipped.add(where + str(error).removeprefix(where))
            return
        yield from odometry.at_scan(scan.stamp_ns)
        yield ScanEvent(frames.laser_mount(decoded.header.frame_id).apply(scan))

    def _odometry(self, bag: Bag, frames: BagFrames) -> BagOdometry:
        """The source of odometry that the user chose, or that the bag has."""
        source = self.odometry_source
        has_topic = self.odometry_topic or _ODOMETRY in bag.topics.values()
        if not source and not has_topic and frames.tf_topics and frames.has_odometry():
            source = TF
            self.skipped.note(
                f'no odometry topic: odometry is the transform from "{frames.odom_frame}" to '
                f'"{frames.base_frame}" on /tf (--odom-source tf)'
            )
        if source == NONE:
            return NoOdometry()
        if source == TF:
            return OdometryByTransforms(frames)
        topic = self._topic(bag, _ODOMETRY, self.odometry_topic, 'odometry')
        return OdometryOnTopic(topic, frames.of_odometry(topic))

    def _scan_topics(self, bag: Bag) -> list[str]:
        """The topics of the lasers."""
        wanted = (self.scan_topic,) if isinstance(self.scan_topic, str) else self.scan_topic
        found = [self._topic(bag, SCAN, topic, 'laser scans') for topic in wanted]
        topics = list(dict.fromkeys(found))
        if len(topics) > 1 and self.T_base_laser is not None:
            raise InputError(
                f'{self.path}: one pose for the lasers of {errors.quoted_names(topics)}: expected '
                'their poses on /tf_static'
            )
        return topics

    def _topic(self, bag: Bag, type_name: str, wanted: str, what: str) -> str:
        found = sorted(topic for topic, name in bag.topics.items() if name == type_name)
        if wanted and wanted in found:
            return wanted
        if not wanted and len(found) == 1:
            return found[0]
        usual = _USUAL_TOPICS[type_name]
        if not wanted and usual in found:
            others = errors.quoted_names([topic for topic in found if topic != usual])
            self.skipped.note(f'{what} of {usual}, as the nodes subscribe to it; not of {others}')
            return usual
        if not found or wanted:
            has = errors.quoted_names(
                [f'{topic} ({name})' for topic, name in sorted(bag.topics.items())]
            )
            remedy = '' if type_name == SCAN else _WITHOUT_ODOMETRY
            raise InputError(
                f'{self.path}: no {what} ({wanted or type_name}); it has {has}{remedy}'
            )
        names = errors.quoted_names(found)
        several = 'give those of several lasers, or ' if type_name == SCAN else ''
        raise InputError(f'{self.path}: {what} on several topics: {several}choose one of {names}')


def _log(path: Path, options: LogOptions) -> Log:
    return BagLog(
        path,
        options.scan_topic,
        options.odometry_topic,
        options.T_base_laser,
        options.base_frame,
        options.odometry_source,
        options.odom_frame,
        options.laser,
    )


FORMAT = LogFormat(EXPECTED, is_bag, _log)
