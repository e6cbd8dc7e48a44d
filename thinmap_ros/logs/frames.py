"""Frames of a robot in a bag: poses of its lasers, and the frames of its odometry."""

import copy
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from thinmap_ros.core import errors, se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.logs import decode
from thinmap_ros.logs.log import OdometryEvent, SkippedRecords
from thinmap_ros.logs.storage import RawMessage
from thinmap_ros.logs.transforms import Mount, OdometryFrames, StaticTransforms, TransformOdometry

_TF = 'tf2_msgs/msg/TFMessage'
_BASE = 'base_link'
_ODOM = 'odom'


@dataclass(frozen=True, eq=False)
class FrameOptions:
    """Frames of the robot that the user gives.

    T_base_laser (3,): pose of every laser; None: from the transforms. base_frame, odom_frame: empty
    for those of the bag.
    """

    T_base_laser: Array | None = None
    base_frame: str = ''
    odom_frame: str = ''


class Messages(Protocol):
    """The messages of a bag, by topic."""

    @property
    def path(self) -> Path:
        """Path of the bag."""
        ...

    @property
    def topics(self) -> Mapping[str, str]:
        """Type of each topic."""
        ...

    def messages(self, topics: set[str]) -> Iterable[RawMessage]:
        """Messages of topics, in the order of writing."""
        ...

    def decode(self, message: RawMessage) -> Any:
        """Decode a message."""
        ...


class BagFrames:
    """The frames of the robot in a bag.

    Transforms on /tf count as static ones where /tf_static does not connect two frames: old drivers
    publish the poses of sensors there.
    """

    def __init__(self, bag: Messages, options: FrameOptions, skipped: SkippedRecords) -> None:
        """skipped: receives invalid transforms, and notes on what is assumed."""
        self.base_frame = options.base_frame or _BASE
        self.odom_frame = options.odom_frame or _ODOM
        self._bag = bag
        self._options = options
        self._skipped = skipped
        self._static = StaticTransforms()
        self._with_tf: StaticTransforms | None = None
        self._mounts: dict[str, Mount] = {}
        self._static_messages = [
            transform
            for transform in self._transforms('tf_static')
            if self._is_added(self._static, transform)
        ]

    @property
    def tf_topics(self) -> set[str]:
        """Topics of transforms that change."""
        return self._topics('tf')

    def laser_mount(self, frame: str) -> Mount:
        """Mount of the laser of a frame. Raises InputError if it is unknown, or tilted."""
        if frame not in self._mounts:
            self._mounts[frame] = self._laser_mount(frame)
        return self._mounts[frame]

    def of_odometry(self, topic: str) -> OdometryFrames:
        """Reader of the odometry on a topic, in the frames of its first message.

        Where the user does not name them, the odometry frame is that of the message, and the
        robot's frame is base_link, or that of the message where nothing names base_link.
        """
        parent, child = self._frames_of_first(topic)
        self.odom_frame = self._options.odom_frame or parent or _ODOM
        static = self._connecting(self.base_frame, child) if child else self._static
        if child and not (self._options.base_frame or static.names(self.base_frame)):
            self._assume_base(child)
        self._report_change(static, child, 'frame')
        return OdometryFrames(
            self.odom_frame, self.base_frame, lambda: None, self._note_of_odometry, static
        )

    def _frames_of_first(self, topic: str) -> tuple[str, str]:
        """Frame and child frame of the first readable odometry."""
        for message in self._bag.messages({topic}):
            try:
                first = self._bag.decode(message)
            except InputError:
                continue  # counted when it is read again
            return first.header.frame_id.lstrip('/'), first.child_frame_id.lstrip('/')
        return '', ''

    def by_transforms(self) -> TransformOdometry:
        """Odometry by the transform from the odometry frame to that of the robot."""
        if not (self._options.base_frame or self._all().names(self.base_frame)):
            child = self._all().child_of(self.odom_frame)
            if child:
                self._assume_base(child)
        odometry = TransformOdometry(self.odom_frame, self.base_frame)
        for transform in self._static_messages:
            odometry.add(transform, is_static=True)
        return odometry

    def has_odometry(self) -> bool:
        """Whether transforms connect the odometry frame and that of the robot."""
        self.by_transforms()
        return self._all().pose(self.odom_frame, self.base_frame) is not None

    def _laser_mount(self, frame: str) -> Mount:
        if self._options.T_base_laser is not None:
            return Mount(self._options.T_base_laser, upside_down=False)
        static = self._connecting(self.base_frame, frame)
        try:
            mount = static.laser_mount(frame, self.base_frame)
        except InputError as error:
            raise InputError(f'{self._bag.path}: /tf_static: {error}') from error
        if mount is None:
            known = errors.quoted_names(static.frames)
            where = f'from "{errors.quoted_name(frame)}" to "{self.base_frame}"'
            raise InputError(
                f'{self._bag.path}: /tf_static has no transform {where}, nor has /tf (they have '
                f'{known}): give --base-frame, or --laser-pose'
            )
        self._report_change(static, frame, 'laser')
        return mount

    def _report_change(self, static: StaticTransforms, frame: str, what: str) -> None:
        """Note that later transforms place a frame elsewhere on the robot."""
        change = static.change(frame, self.base_frame)
        if change:
            name = errors.quoted_name(frame)
            self._skipped.note(f'static transform of {what} {name} {change}: the first one is used')

    def _note_of_odometry(self, note: str) -> None:
        self._skipped.note(f'odometry: {note}')

    def _assume_base(self, frame: str) -> None:
        if frame == self.base_frame:
            return
        name = errors.quoted_name(frame)
        self._skipped.note(
            f'no transform names "{self.base_frame}": the frame of the robot is "{name}", as that '
            'of the odometry (--base-frame)'
        )
        self.base_frame = frame

    def _connecting(self, target_frame: str, source_frame: str) -> StaticTransforms:
        """The static transforms; with those of /tf where they do not connect two frames."""
        connected = self._static.pose(target_frame, source_frame) is not None
        return self._static if connected else self._all()

    def _all(self) -> StaticTransforms:
        """Static transforms, and the first of each other frame on /tf."""
        if self._with_tf is None:
            self._with_tf = copy.deepcopy(self._static)
            for transform in self._transforms('tf'):
                self._is_added(self._with_tf, transform)
        return self._with_tf

    def _transforms(self, name: str) -> Iterator[Any]:
        topics = self._topics(name)
        for message in self._bag.messages(topics) if topics else ():
            try:
                yield from self._bag.decode(message).transforms
            except InputError as error:
                self._skipped.add(str(error))

    def _topics(self, name: str) -> set[str]:
        """Topics of transforms with a name, in any namespace."""
        topics = self._bag.topics.items()
        return {topic for topic, kind in topics if kind == _TF and topic.split('/')[-1] == name}

    def _is_added(self, transforms: StaticTransforms, transform: Any) -> bool:
        try:
            transforms.add(transform)
        except InputError as error:
            self._skipped.add(f'{self._bag.path}: /tf: {error}')
            return False
        return True


TOPIC = 'topic'
TF = 'tf'
NONE = 'none'
SOURCES = (TOPIC, TF, NONE)


class BagOdometry:
    """Odometry of a bag, which has no sample here. name: for messages; topics: that it reads."""

    def __init__(self, name: str, topics: set[str]) -> None:
        self.name = name
        self.topics = topics

    @property
    def missing(self) -> str:
        """What is missing for a sample, after a colon; '' if unknown."""
        return ''

    def samples(self, message: Any) -> Iterator[OdometryEvent]:
        """Samples that a message of its topics completes. Raises InputError if it is unusable."""
        yield from ()

    def at_scan(self, stamp_ns: int) -> Iterator[OdometryEvent]:
        """Samples at the stamp of a scan, before it."""
        yield from ()


class OdometryOnTopic(BagOdometry):
    """nav_msgs/Odometry, in the frames of the robot or in frames connected to them."""

    def __init__(self, topic: str, frames: OdometryFrames) -> None:
        super().__init__(topic, {topic})
        self._frames = frames

    def samples(self, message: Any) -> Iterator[OdometryEvent]:
        """The sample of a message."""
        T_odom_base = self._frames.pose(message)
        if not se2.is_bounded_pose(T_odom_base):
            raise InputError(
                f'pose {T_odom_base.tolist()}: expected finite numbers, at most '
                f'{se2.MAX_COORDINATE_M:g} m'
            )
        tilt_rad = self._frames.tilt_rad(message)
        yield OdometryEvent(decode.stamp_ns(message), T_odom_base, tilt_rad=tilt_rad)


class OdometryByTransforms(BagOdometry):
    """The transform from the odometry frame to that of the robot."""

    def __init__(self, frames: BagFrames) -> None:
        super().__init__('transforms', frames.tf_topics)
        self._transforms: TransformOdometry = frames.by_transforms()

    @property
    def missing(self) -> str:
        """What is missing of the chain of transforms."""
        return f': {self._transforms.missing} (--odom-frame, --base-frame)'

    def samples(self, message: Any) -> Iterator[OdometryEvent]:
        """The sample of the newest time at which all transforms are known, if that is new."""
        invalid: InputError | None = None
        for transform in message.transforms:
            try:
                self._transforms.add(transform, is_static=False)
            except InputError as error:
                invalid = error
        sample = self._transforms.next_sample()
        if sample is not None:
            stamp_ns, T_odom_base, tilt_rad = sample
            yield OdometryEvent(stamp_ns, T_odom_base, tilt_rad=tilt_rad)
        if invalid is not None:
            raise invalid


class NoOdometry(BagOdometry):
    """The robot never moves in its odometry frame: there is a sample at each scan."""

    def __init__(self) -> None:
        super().__init__('scans', set())
        self._last_ns: int | None = None

    def at_scan(self, stamp_ns: int) -> Iterator[OdometryEvent]:
        """A sample at the origin, at each new stamp."""
        if stamp_ns == self._last_ns:
            return
        self._last_ns = stamp_ns
        yield OdometryEvent(stamp_ns, np.zeros(3), is_measured=False)
